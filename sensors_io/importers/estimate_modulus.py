"""EstimateModulus (Burgess et al.): a GelSight Wedge in a gripper that closes on objects, force and width per frame.

    DIR/<...>/<object>_<n>.avi            the wedge on the finger that feels force, 30 Hz
    DIR/<...>/<object>_<n>_forces.pkl     grasping force in N, pressing positive, one value per frame
    DIR/<...>/<object>_<n>_widths.pkl     opening of the gripper in m, one value per frame

The gauge measures the normal force alone: force_n = (0, 0, −F), where the zeros mean "not measured"; below zero it
shows its drift.  Widths are kept in `camera`.  A grasp with another number of forces than frames is left out, and so is
the second finger's video, which has no force.  Moduli are published as a list of objects elsewhere; no level is
annotated.
"""

import collections
import functools
import pathlib
import re

import numpy as np

from sensors_io.importers.catalogue import Catalogue, Listed, Taken, bare_catalogue, require_files
from sensors_io.importers.keep import ImportConfig, Skip, UnreadableError
from sensors_io.importers.pickles import read_pickle
from sensors_io.importers.pictures import film, inside, natural, nominal_ns
from sensors_io.importers.video import read_video
from sensors_io.schema import ContactKey

SENSOR = "gelsight_wedge"
_FORCES = "_forces.pkl"
_NAME = re.compile(r"([A-Za-z0-9][A-Za-z0-9_.\-]*)_(\d+)")


def list_estimate_modulus(source: pathlib.Path, config: ImportConfig) -> Catalogue:
    """Catalogue of a directory and those below it; a video of another name is skipped.

    Raises:
      ImportSourceError: no .avi there.
    """
    found = list(inside(source))
    videos = sorted(
        (path for path in found if path.suffix.lower() == ".avi"), key=lambda path: (path.parent, natural(path))
    )
    require_files(source, videos, "<object>_<n>.avi with <object>_<n>_forces.pkl")
    filmed = {path.with_suffix("") for path in videos}
    bare = [
        path
        for path in found
        if path.name.endswith(_FORCES) and path.with_name(path.name.removesuffix(_FORCES)) not in filmed
    ]
    skipped = [Skip(name=path.relative_to(source).as_posix(), reason="has no .avi") for path in sorted(bare)]
    contacts, trials = [], collections.Counter[str]()
    for path in videos:
        match, name = _NAME.fullmatch(path.stem), path.relative_to(source).as_posix()
        if match is None:
            reason = "is the finger without force" if path.stem.endswith("_other") else "is not named <object>_<n>"
            skipped.append(Skip(name=name, reason=reason))
            continue
        key = ContactKey(object_id=match[1], site=0, motion="press", trial=trials[match[1]])
        trials[match[1]] += 1
        contacts.append(Listed(key=key, name=name, read=functools.partial(_read, path, key, config)))
    return bare_catalogue(
        source,
        contacts,
        videos,
        config,
        source="EstimateModulus",
        licence="not stated by its authors; local use only",
        sensors=(SENSOR,),
        skipped=skipped,
    )


def _read(path: pathlib.Path, key: ContactKey, config: ImportConfig) -> Taken:
    video = read_video(path, config)
    force = _series(path, "forces", video.total)
    camera = video.camera(path)
    left_out = []
    try:
        camera["gripper_width_m"] = _series(path, "widths", video.total)[video.index].tolist()
    except UnreadableError as error:
        left_out.append(Skip(name=f"{path.stem}_widths.pkl", reason=str(error)))
    normal = np.zeros((len(video.index), 3), np.float32)
    normal[:, 2] = -force[video.index]
    sequence = film(
        key,
        SENSOR,
        gap=np.zeros(len(video.index), np.bool_),
        host_time_ns=nominal_ns(video.index, video.rate_hz),
        camera=camera | {"force": "normal component alone"},
        frames=video.frames,
        force_n=normal,
    )
    return Taken(sequences=(sequence,), left_out=tuple(left_out))


def _series(video: pathlib.Path, what: str, count: int) -> np.ndarray:
    """One value per frame of the video, float64 [count].

    Raises:
      UnreadableError: the file is absent or damaged, or holds another number of values.
    """
    path = video.with_name(f"{video.stem}_{what}.pkl")
    data = read_pickle(path)
    try:
        values = np.asarray(data, np.float64)
    except (TypeError, ValueError) as error:
        raise UnreadableError(f"{path.name} holds no numbers ({error})") from error
    if values.shape != (count,) or not np.isfinite(values).all():
        raise UnreadableError(f"{path.name} holds {values.shape} values: must be {count} finite ones, one per frame")
    return values
