"""PhysiCLeAR (Yu et al., Octopi, RSS 2024): GelSight Mini videos of hand-held objects, annotated per object.

    DIR/labels.json              levels and split per object, and the names of its videos
    DIR/videos/<object>_<trial>.mov

Its "bumps" are the attribute protrusion; its materials rubber and silicone are `other`, the remaining names agree.
Hand motion is unguided (motion "free", site 0, phase 0) and no force was measured.
"""

import collections
import dataclasses
import functools
import json
import pathlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from sensors_io.errors import MALFORMED, name_and_text
from sensors_io.importers.catalogue import Catalogue, Listed, Taken, fingerprint
from sensors_io.importers.holdout import hold_out
from sensors_io.importers.keep import ImportSourceError, Keep, Skip, check_share
from sensors_io.importers.pictures import film, nominal_ns
from sensors_io.importers.video import VideoError, read_video
from sensors_io.json_files import distinct
from sensors_io.schema import ATTRIBUTES, MATERIALS, UNKNOWN, ContactKey, ObjectCard

SENSOR = "gelsight_mini"
LICENCE = "not stated by its authors; local use only"
ANNOTATOR = "PhysiCLeAR, per object"
ORDINAL: Mapping[str, str] = {"hardness": "hardness", "roughness": "roughness", "bumps": "protrusion"}
MATERIAL: Mapping[str, str] = {m: m for m in MATERIALS} | {"rubber": "other", "silicone": "other"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhysiclearConfig(Keep):
    """Selection within each video, and the objects of the test split.

    The defaults keep the mean over 2 × 2 pixels and 32 frames evenly spread over the about 5 s of a video.

    Args:
      test_share: share of the labelled training objects that become the test split, see `hold_out`.
    """

    test_share: float = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_share("test_share", self.test_share)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LabelledObject:
    """One object of labels.json: its card, and the names of its videos."""

    card: ObjectCard
    videos: tuple[str, ...]


def list_physiclear(source: pathlib.Path, config: PhysiclearConfig) -> Catalogue:
    """Catalogue of a directory with labels.json and videos/.

    A video that is not named <object>_<trial> or present but not listed is skipped; labels that are null are `UNKNOWN`.

    Raises:
      ImportSourceError: no labels.json or no videos there, or labels that contradict themselves.
    """
    objects = read_labels(source / "labels.json")
    present = _files(source / "videos")
    cards = hold_out([entry.card for entry in objects], config.test_share)
    contacts, skipped = [], []
    for entry in objects:
        for name in entry.videos:
            trial = re.fullmatch(re.escape(entry.card.object_id) + r"_(\d{1,9})", pathlib.PurePath(name).stem)
            if trial is None:
                skipped.append(Skip(name=name, reason=f"is not named {entry.card.object_id}_<trial>"))
                continue
            key = ContactKey(object_id=entry.card.object_id, site=0, motion="free", trial=int(trial[1]))
            read = functools.partial(_read, source / "videos" / name, key, config)
            contacts.append(Listed(key=key, name=name, read=read))
    listed = {name for entry in objects for name in entry.videos}
    skipped += [Skip(name=name, reason="is not listed in labels.json") for name in present if name not in listed]
    return Catalogue(
        source="PhysiCLeAR",
        licence=LICENCE,
        sensors=(SENSOR,),
        annotated=ATTRIBUTES,
        cards={card.object_id: card for card in cards},
        contacts=tuple(contacts),
        skipped=tuple(skipped),
        config=dataclasses.asdict(config),
        identity=fingerprint(source, [source / "videos" / name for name in present], config, (source / "labels.json",)),
    )


def read_labels(path: pathlib.Path) -> list[LabelledObject]:
    """Objects of a labels.json, in its order.

    Raises:
      ImportSourceError: no such file, an entry that is not as described, or an object or video that appears twice.
    """
    if not path.is_file():
        raise ImportSourceError(f"{path} is missing: give the directory that holds labels.json and videos/")
    try:
        entries = json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=distinct)["objects"]
        objects = [_labelled(entry) for entry in entries]
    except MALFORMED as error:
        raise ImportSourceError(f"{path}: {name_and_text(error)}; correct the entry") from error
    for what, names in (
        ("object", [entry.card.object_id for entry in objects]),
        ("video", [name for entry in objects for name in entry.videos]),
    ):
        twice = sorted(name for name, n in collections.Counter(names).items() if n > 1)
        if twice:
            raise ImportSourceError(f"{path}: {what} {twice[0]!r} appears twice; splits would share it: drop one")
    return objects


def _read(path: pathlib.Path, key: ContactKey, config: PhysiclearConfig) -> Taken:
    if not path.is_file():
        raise VideoError("is listed and absent")
    video = read_video(path, config)
    sequence = film(
        key,
        SENSOR,
        gap=np.zeros(len(video.index), np.bool_),
        host_time_ns=nominal_ns(video.index, video.rate_hz),
        camera=video.camera(path),
        frames=video.frames,
    )
    return Taken(sequences=(sequence,))


def _labelled(entry: Mapping[str, Any]) -> LabelledObject:
    """One entry of labels.json; raises KeyError, TypeError or ValueError where it is not as described."""
    labels = {name: _level(entry, key) for key, name in ORDINAL.items()}
    material = entry["material"]
    if material is not None and material not in MATERIAL:
        raise ValueError(f"{entry['object']}: material {material!r} must be one of {', '.join(MATERIAL)}")
    labels["material"] = UNKNOWN if material is None else MATERIALS.index(MATERIAL[material])
    for name in entry["videos"]:
        if pathlib.PurePath(name).name != name:
            raise ValueError(f"{entry['object']}: video {name!r} must be a file name without a directory")
    card = ObjectCard(
        object_id=entry["object"],
        split=entry["split"],
        labels=labels,
        annotator=ANNOTATOR,
        name=entry["name"] or "",
    )
    return LabelledObject(card=card, videos=tuple(entry["videos"]))


def _level(entry: Mapping[str, Any], key: str) -> int:
    value = entry[key]
    if value is not None and (isinstance(value, bool) or int(value) != value):
        raise ValueError(f"{entry['object']}: {key} is {value!r}: must be a whole number or null")
    return UNKNOWN if value is None else int(value)


def _files(folder: pathlib.Path) -> list[str]:
    names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    if not names:
        raise ImportSourceError(f"{folder} is missing or empty: put the videos there")
    return names
