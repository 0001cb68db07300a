"""YCB-Slide, its real part (Suresh et al., CoRL 2022): a DIGIT slid by hand over ten YCB objects, 60 s at a time.

    DIR/<object>/dataset_<k>/frames/frame_<7 digits>.jpg
    DIR/<object>/dataset_<k>/digit_data.npy     pickled: "timestamps", seconds since the start, one per frame
    DIR/<object>/dataset_<k>/synced_data.npy    the same, with "poses" of sensor and object (not imported)

DIR is the folder `real`, or the one above it.  A slide is cut into pieces of `max_frames` frames; site k is slide k,
the trial counts its pieces.  The hand moves freely, no force was measured, and no level was annotated.
"""

import functools
import pathlib
import re

import numpy as np

from sensors_io.importers.catalogue import Catalogue, Listed, Taken, bare_catalogue, require_files
from sensors_io.importers.keep import ImportConfig, Skip, UnreadableError
from sensors_io.importers.pickles import PickleError, read_pickle
from sensors_io.importers.pictures import film, inside, natural, nominal_ns, numbered, read_pictures, stored_ns
from sensors_io.schema import ContactKey

SENSOR = "digit"
RATE_HZ = 30.0
"""As its README states it, for a slide without readable times."""

TIMES = ("digit_data.npy", "synced_data.npy")


def list_ycb_slide(source: pathlib.Path, config: ImportConfig) -> Catalogue:
    """Catalogue of a directory of objects; a slide without frames is skipped, one without times gets nominal ones.

    Raises:
      ImportSourceError: no slide there.
    """
    root = source / "real" if (source / "real").is_dir() else source
    found = (path for path in inside(root) if path.parent.parent == root and path.name.startswith("dataset_"))
    slides = sorted(filter(pathlib.Path.is_dir, found), key=lambda path: (path.parent.name, natural(path)))
    require_files(source, slides, "<object>/dataset_<k>/frames/frame_<7 digits>.jpg")
    contacts, skipped, pictures = [], [], []
    for slide in slides:
        paths, number = numbered(slide / "frames"), re.fullmatch(r"dataset_(\d{1,9})", slide.name)
        if number is None or not paths:
            skipped.append(
                Skip(name=f"{slide.parent.name}/{slide.name}", reason="holds no frames/frame_<7 digits>.jpg")
            )
            continue
        pictures += paths
        for trial, piece in enumerate(config.pieces(len(paths))):
            key = ContactKey(object_id=slide.parent.name, site=int(number[1]), motion="free", trial=trial)
            read = functools.partial(_read, slide, key, paths, piece, config)
            contacts.append(Listed(key=key, name=f"{slide.parent.name}/{slide.name} {trial}", read=read))
    return bare_catalogue(
        source,
        contacts,
        pictures,
        config,
        source="YCB-Slide, real",
        licence="CC BY-SA 4.0",
        sensors=(SENSOR,),
        skipped=skipped,
    )


def _read(
    slide: pathlib.Path, key: ContactKey, paths: list[pathlib.Path], piece: np.ndarray, config: ImportConfig
) -> Taken:
    pictures = read_pictures(paths, piece, config)
    where = f"{slide.parent.name}/{slide.name}"
    left_out = [Skip(name=f"{where}/{skip.name}", reason=skip.reason) for skip in pictures.left_out]
    try:
        time_ns, clock = _times(slide, len(paths)), "digit_data.npy"
    except PickleError as error:
        time_ns, clock = nominal_ns(np.arange(len(paths)), RATE_HZ), f"frame number at a nominal {RATE_HZ:g} Hz"
        left_out.append(Skip(name=f"{where} {key.trial}", reason=f"times: {error}"))
    sequence = film(
        key,
        SENSOR,
        gap=pictures.after_loss(),
        host_time_ns=time_ns[pictures.index],
        camera={"slide": slide.name, "clock": clock, "size_px": pictures.size_px},
        frames=pictures.frames,
    )
    return Taken(sequences=(sequence,), left_out=tuple(left_out))


def _times(slide: pathlib.Path, count: int) -> np.ndarray:
    """Times of all frames, int64 [count].

    Raises:
      PickleError: neither file can be read.
      UnreadableError: they are not one finite time for each frame, in order.
    """
    found = next((slide / name for name in TIMES if (slide / name).is_file()), slide / TIMES[0])
    data = read_pickle(found)
    if not isinstance(data, dict) or "timestamps" not in data:
        raise PickleError(f"{found.name} has no timestamps")
    try:
        seconds = np.asarray(data["timestamps"], np.float64)
    except (TypeError, ValueError) as error:
        raise UnreadableError(f"{found.name} holds no numbers ({error})") from error
    if seconds.shape != (count,):
        raise UnreadableError(f"{found.name} has times for {seconds.size} frames, the folder has {count}")
    return stored_ns(seconds, found.name)
