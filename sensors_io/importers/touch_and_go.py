"""Touch and Go (Yang et al., NeurIPS 2022, arXiv 2211.12498): a GelSight in people's hands, material per frame.

    DIR/dataset/<YYYYMMDD_HHMMSS>/gelsight_frame/<10 digits>.jpg     as its extract_frame.py writes it
    DIR/dataset/<YYYYMMDD_HHMMSS>/video_frame/<10 digits>.jpg        the scene at the same moment
    DIR/dataset/<YYYYMMDD_HHMMSS>/time2.npy                          seconds of each GelSight frame
    DIR/label.txt, or train.txt, test.txt, pretrain.txt              lines <session>/<10 digits>.jpg,<class>

The lists name the frames in contact; frames of one class that follow each other within half a second are one touch.
Objects have no identity upstream, and one session touches many: what one session says of one class is an object here,
and splits are by session, not upstream's, which tear touches apart frame by frame.  Hardness and roughness are not
annotated in three levels (upstream derives one from the class and has two levels of the other) and stay unknown.
"""

import collections
import dataclasses
import functools
import pathlib
import re
from collections.abc import Mapping

import numpy as np

from sensors_io.arrays import load_arrays
from sensors_io.importers.catalogue import Catalogue, Listed, Taken, fingerprint, require_files
from sensors_io.importers.holdout import split_by_name
from sensors_io.importers.keep import ImportConfig, ImportSourceError, Skip, UnreadableError
from sensors_io.importers.pictures import film, nominal_ns, read_pictures, stored_ns
from sensors_io.importers.tables import read_rows
from sensors_io.schema import MATERIALS, ContactKey, ObjectCard

SENSOR = "gelsight"
RATE_HZ = 30.0
"""Nominal, for a session without time2.npy."""

CLASSES = (
    "concrete", "plastic", "glass", "wood", "metal", "brick", "tile", "leather", "synthetic_fabric", "natural_fabric",
    "rubber", "paper", "tree", "grass", "soil", "rock", "gravel", "sand", "plants", "other",
)  # fmt: skip
"""Classes by number; upstream's loader calls 7, 8, 9, 11 and 13 soft."""

MATERIAL_OF = {"synthetic_fabric": "fabric", "natural_fabric": "fabric"}
"""Classes under another name here; what is in neither is "other", bark and plants with it."""

LISTS = ("label.txt", "train.txt", "test.txt", "pretrain.txt")
_GAP_FRAMES = 15  # half a second
_LINE = re.compile(r"(\d{8}_\d{6})/(\d{10})\.jpg")


def list_touch_and_go(source: pathlib.Path, config: ImportConfig) -> Catalogue:
    """Catalogue of the lists and frames in a directory.

    A line of another form, a class without a name, and a frame with two classes are skipped.

    Raises:
      ImportSourceError: no list or no frames there.
    """
    lists = [path for name in LISTS for path in (source / name, source / "dataset" / name) if path.is_file()]
    require_files(source, lists, f"one of {', '.join(LISTS)}, and dataset/<session>/gelsight_frame/*.jpg")
    classes, skipped = _classes(lists)
    sessions = split_by_name(
        (session for session, _ in classes), val_share=config.val_share, test_share=config.test_share
    )
    cards: dict[str, ObjectCard] = {}
    contacts = []
    trials = collections.Counter[str]()
    for session, kind, frames in touches(classes):
        card = _card(session, kind, sessions[session])
        cards.setdefault(card.object_id, card)
        key = ContactKey(object_id=card.object_id, site=0, motion="free", trial=trials[card.object_id])
        trials[card.object_id] += 1
        folder = source / "dataset" / session
        contacts.append(
            Listed(
                key=key,
                name=f"{session}/{frames[0]:010d}",
                read=functools.partial(_read, folder, key, frames, config),
                view=folder / "video_frame" / f"{frames[len(frames) // 2]:010d}.jpg",
            )
        )
    pictures = [_gelsight(source / "dataset" / session, number) for session, number in classes]
    return Catalogue(
        source="Touch and Go",
        licence="that of the download",
        sensors=(SENSOR,),
        annotated=("material",),
        cards=cards,
        contacts=tuple(contacts),
        skipped=tuple(skipped),
        config=dataclasses.asdict(config),
        identity=fingerprint(source, pictures, config, lists),
    )


def touches(classes: Mapping[tuple[str, int], int]) -> list[tuple[str, int, list[int]]]:
    """Session, class and frame numbers of each touch.

    Args:
      classes: class of each (session, frame number).
    """
    runs: list[tuple[str, int, list[int]]] = []
    for (session, number), kind in sorted(classes.items()):
        if runs and runs[-1][:2] == (session, kind) and number - runs[-1][2][-1] <= _GAP_FRAMES:
            runs[-1][2].append(number)
        else:
            runs.append((session, kind, [number]))
    return runs


def _classes(lists: list[pathlib.Path]) -> tuple[dict[tuple[str, int], int], list[Skip]]:
    """Class of each frame, and the lines that give none."""
    found: dict[tuple[str, int], set[int]] = collections.defaultdict(set)
    skipped = []
    for path in lists:
        for row in read_rows(path):
            match = _LINE.fullmatch(row[0].strip())
            label = row[1].strip() if len(row) == 2 else ""
            if match is None or not label.isdecimal() or int(label) >= len(CLASSES):
                skipped.append(
                    Skip(name=f"{path.name}: {','.join(row)}", reason="is no <session>/<10 digits>.jpg,<class>")
                )
                continue
            found[match[1], int(match[2])].add(int(label))
    if not found:
        raise ImportSourceError(f"{lists[0]} names no frame: expected lines <session>/<10 digits>.jpg,<class>")
    for (session, number), kinds in found.items():
        if len(kinds) > 1:
            skipped.append(Skip(name=f"{session}/{number:010d}.jpg", reason="is listed with several classes"))
    return {frame: kinds.pop() for frame, kinds in found.items() if len(kinds) == 1}, skipped


def _card(session: str, kind: int, split: str) -> ObjectCard:
    name = CLASSES[kind]
    material = MATERIAL_OF.get(name, name)
    return ObjectCard(
        object_id=f"{session}-{name}",
        split=split,
        labels={"material": MATERIALS.index(material if material in MATERIALS else "other")},
        annotator="Touch and Go, per frame",
        name=name.replace("_", " "),
    )


def _read(folder: pathlib.Path, key: ContactKey, frames: list[int], config: ImportConfig) -> Taken:
    paths = [_gelsight(folder, number) for number in frames]
    pictures = read_pictures(paths, config.positions(len(paths)), config)
    numbers = np.array(frames)[pictures.index]
    time_ns, clock = _times(folder, numbers)
    camera = {"session": folder.name, "clock": clock, "size_px": pictures.size_px}
    sequence = film(
        key,
        SENSOR,
        gap=pictures.after_loss(),
        host_time_ns=time_ns,
        camera=camera,
        frames=pictures.frames,
    )
    return Taken(sequences=(sequence,), left_out=pictures.left_out)


def _gelsight(folder: pathlib.Path, number: int) -> pathlib.Path:
    return folder / "gelsight_frame" / f"{number:010d}.jpg"


def _times(folder: pathlib.Path, numbers: np.ndarray) -> tuple[np.ndarray, str]:
    """Times of frame numbers, int64 [N], since the first frame of the session, and what they were read from."""
    path = folder / "time2.npy"
    if not path.is_file():
        return nominal_ns(numbers, RATE_HZ), f"frame number at a nominal {RATE_HZ:g} Hz"
    try:
        seconds = load_arrays(path)[path.stem].astype(np.float64).ravel()
    except ValueError as error:
        raise UnreadableError(f"time2.npy is damaged ({error})") from error
    if numbers[-1] >= len(seconds):
        raise UnreadableError(f"time2.npy has {len(seconds)} times and frame {numbers[-1]} is listed")
    return stored_ns(seconds[numbers] - seconds[0], path.name), "time2.npy"
