"""PhysiCLeAR (Yu et al., Octopi, RSS 2024): GelSight Mini videos of hand-held objects, annotated per object.

    DIR/labels.json              levels and split per object, and the names of its videos
    DIR/videos/<object>_<trial>.mov

Its "bumps" are the attribute protrusion; its materials rubber and silicone are `other`, the remaining names agree.
Hand motion is unguided (motion "free", site 0, phase 0) and no force was measured.
"""

import collections
import dataclasses
import hashlib
import json
import pathlib
import re
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Seq
from typing import Any

import numpy as np

from sensors_io.importers.holdout import hold_out
from sensors_io.importers.video import VideoError, read_video
from sensors_io.records import RecordsMeta, RecordWriter
from sensors_io.schema import ATTRIBUTES, MATERIALS, SPLITS, UNKNOWN, ContactKey, ObjectCard, Sequence

SENSOR = "gelsight_mini"
LICENCE = "not stated by its authors; local use only"
ANNOTATOR = "PhysiCLeAR, per object"
ORDINAL: Mapping[str, str] = {"hardness": "hardness", "roughness": "roughness", "bumps": "protrusion"}
MATERIAL: Mapping[str, str] = {m: m for m in MATERIALS} | {"rubber": "other", "silicone": "other"}


class ImportSourceError(ValueError):
    """A source that cannot be imported; the message names the path, the problem and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhysiclearConfig:
    """What is kept of each video, and which objects are held out.

    The defaults keep the mean over 2 × 2 pixels, just above the 112 rows of a clip, and 32 frames evenly spread over
    the about 5 s of a video, four times those of a clip: every clip decodes all frames of its entry, and more of them
    would take longer than training allows.  Keep everything with height = max_frames = 0.

    Args:
      height: rows stored, with the aspect ratio kept (INTER_AREA); 0 stores frames as they are decoded.
      stride: keep every stride-th frame.
      max_frames: of those, at most this many, evenly spaced; 0 keeps all.
      test_share: share of the labelled training objects that become the test split, see `hold_out`.
    """

    height: int = 120
    stride: int = 1
    max_frames: int = 32
    test_share: float = 0.2

    def __post_init__(self) -> None:
        for name, least in (("height", 0), ("stride", 1), ("max_frames", 0)):
            if getattr(self, name) < least:
                raise ImportSourceError(f"{name} is {getattr(self, name)}: must be ≥ {least}; raise it")
        if not 0 <= self.test_share < 1:
            raise ImportSourceError(f"test_share is {self.test_share}: must lie in 0 ≤ test_share < 1; correct it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Skip:
    """One file or object that was left out, and why."""

    name: str
    reason: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportReport:
    """What an import did; it is stored in the notes of the records' meta.

    Args:
      videos: sequences imported.
      objects: objects imported, by split.
      skipped: every file or object left out.
      unlabelled: attributes that nobody annotated on objects outside the split "unlabelled".
    """

    videos: int
    objects: Mapping[str, int]
    skipped: tuple[Skip, ...]
    unlabelled: tuple[Skip, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class LabelledObject:
    """One object of labels.json: its card, and the names of its videos."""

    card: ObjectCard
    videos: tuple[str, ...]


def import_physiclear(
    source: pathlib.Path,
    out: pathlib.Path,
    *,
    config: PhysiclearConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Write the recordings in `source` as records in `out`; an interrupted import goes on, a finished one is kept.

    A video that cannot be read whole, is not named <object>_<trial>, is listed but absent or present but not listed is
    skipped and reported.  Labels that are null become `UNKNOWN` and are reported.

    Args:
      source: directory with labels.json and videos/.
      out: directory of the records.
      config: what to keep; None is `PhysiclearConfig()`.
      progress: called with the number of videos done and their total.

    Raises:
      ImportSourceError: no labels.json or no videos there, labels that contradict themselves, or no readable video.
      RecordsExistError: `out` holds other records.
    """
    config = config or PhysiclearConfig()
    objects = read_labels(source / "labels.json")
    present = _files(source / "videos")
    cards = hold_out([entry.card for entry in objects], config.test_share)
    objects = [dataclasses.replace(entry, card=card) for entry, card in zip(objects, cards, strict=True)]
    meta = RecordsMeta(
        source="PhysiCLeAR",
        licence=LICENCE,
        config_hash=_hash(source, config, present),
        sensors=(SENSOR,),
        notes={"config": dataclasses.asdict(config)},
    )
    with RecordWriter(out, meta=meta, resume=True) as writer:
        run = _Run(writer, source / "videos", config)
        total = sum(len(entry.videos) for entry in objects)
        for entry in objects:
            for name in entry.videos:
                run.add(entry.card, name)
                if progress is not None:
                    progress(run.seen, total)
        report = run.report(objects, present)
        if not report.videos:
            raise ImportSourceError(f"{source / 'videos'}: no video can be read; the first: {report.skipped[0]}")
        writer.note(report=dataclasses.asdict(report))
    return report


def read_labels(path: pathlib.Path) -> list[LabelledObject]:
    """Objects of a labels.json, in its order.

    Raises:
      ImportSourceError: no such file, an entry that is not as described, or an object or video that appears twice.
    """
    if not path.is_file():
        raise ImportSourceError(f"{path} is missing: give the directory that holds labels.json and videos/")
    try:
        entries = json.loads(path.read_text())["objects"]
        objects = [_labelled(entry) for entry in entries]
    except (ValueError, KeyError, TypeError) as error:
        raise ImportSourceError(f"{path}: {error!r}; correct the entry") from error
    for what, names in (
        ("object", [entry.card.object_id for entry in objects]),
        ("video", [name for entry in objects for name in entry.videos]),
    ):
        twice = sorted(name for name, n in collections.Counter(names).items() if n > 1)
        if twice:
            raise ImportSourceError(f"{path}: {what} {twice[0]!r} appears twice; splits would share it: drop one")
    return objects


@dataclasses.dataclass
class _Run:
    """One import under way."""

    writer: RecordWriter
    folder: pathlib.Path
    config: PhysiclearConfig
    seen: int = 0
    videos: int = 0
    skipped: list[Skip] = dataclasses.field(default_factory=list)

    def add(self, card: ObjectCard, name: str) -> None:
        """Import one listed video, or note why not."""
        self.seen += 1
        trial = re.fullmatch(re.escape(card.object_id) + r"_(\d+)", pathlib.PurePath(name).stem)
        if trial is None:
            self.skipped.append(Skip(name=name, reason=f"is not named {card.object_id}_<trial>"))
            return
        key = ContactKey(object_id=card.object_id, site=0, motion="free", trial=int(trial[1]))
        if key not in self.writer:
            try:
                sequence = _sequence(self.folder / name, key, self.config)
            except VideoError as error:
                self.skipped.append(Skip(name=name, reason=str(error)))
                return
            if card.object_id not in self.writer.objects_done:
                self.writer.write_object(card)
            self.writer.write_contact([sequence])
        self.videos += 1

    def report(self, objects: Seq[LabelledObject], present: Seq[str]) -> ImportReport:
        """What was imported and what was left out."""
        done = self.writer.objects_done
        listed = {name for entry in objects for name in entry.videos}
        unlisted = [Skip(name=name, reason="is not listed in labels.json") for name in present if name not in listed]
        empty = [
            Skip(name=entry.card.object_id, reason="object without a readable video")
            for entry in objects
            if entry.card.object_id not in done
        ]
        cards = [entry.card for entry in objects if entry.card.object_id in done]
        return ImportReport(
            videos=self.videos,
            objects={split: sum(card.split == split for card in cards) for split in SPLITS},
            skipped=(*self.skipped, *unlisted, *empty),
            unlabelled=tuple(
                Skip(name=card.object_id, reason=f"{attribute} is not annotated")
                for card in cards
                for attribute in ATTRIBUTES
                if card.split != "unlabelled" and card.labels[attribute] == UNKNOWN
            ),
        )


def _sequence(path: pathlib.Path, key: ContactKey, config: PhysiclearConfig) -> Sequence:
    if not path.is_file():
        raise VideoError("is listed and absent")
    video = read_video(path, height=config.height, stride=config.stride, max_frames=config.max_frames)
    n = len(video.index)
    return Sequence(
        key=key,
        sensor=SENSOR,
        camera={"file": path.name, "rate_hz": video.rate_hz, "size_px": video.size_px, "frames": video.total},
        frames=video.frames,
        host_time_ns=np.rint(video.index * (1e9 / video.rate_hz)).astype(np.int64),
        phase=np.zeros(n, np.uint8),
        flags=np.zeros(n, np.uint32),
    )


def _labelled(entry: Mapping[str, Any]) -> LabelledObject:
    """One entry of labels.json; raises KeyError, TypeError or ValueError where it is not as described."""
    labels = {name: UNKNOWN if entry[key] is None else int(entry[key]) for key, name in ORDINAL.items()}
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


def _files(folder: pathlib.Path) -> list[str]:
    names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    if not names:
        raise ImportSourceError(f"{folder} is missing or empty: put the videos there")
    return names


def _hash(source: pathlib.Path, config: PhysiclearConfig, present: Seq[str]) -> str:
    """Hash of everything that decides what is imported: config, labels, names and sizes of the videos."""
    sizes = [(name, (source / "videos" / name).stat().st_size) for name in present]
    text = json.dumps([dataclasses.asdict(config), sizes]).encode() + (source / "labels.json").read_bytes()
    return hashlib.sha256(text).hexdigest()[:16]
