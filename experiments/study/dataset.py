"""The data of an experiment: contacts on disk, split by object into the parts that the stages use."""

import dataclasses
import hashlib
import json
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Seq
from pathlib import Path
from typing import Any

import grain
import numpy as np

from experiments.core.context import Context
from experiments.core.errors import DataError
from sensors_io.pipeline import ClipConfig, ClipMemory, clip_batches
from sensors_io.records import RecordStore
from sensors_io.schema import ATTRIBUTES, LEVELS, Sequence
from touchr1_jax.types import TouchBatch

PARTS = ("sft", "grpo", "val", "test")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dataset:
    """Contacts on disk and what the stages need to know of them.

    `parts` maps each of `PARTS` to contact indices; no object is in two of them, but for `sft` and `grpo` where both
    learn from the same contacts.  `label` is int32 [contact, A].  Every seed reads the same clips, so `memory` keeps
    them; `threads` read those of the batches to come.  `statistics` are all contacts as the statistics stem of an
    encoder reads them, by the side of its patches, once a stage has computed them.  `has_force` says whether the force
    of any contact was measured.
    """

    store: RecordStore
    clip: ClipConfig
    memory: ClipMemory
    parts: dict[str, np.ndarray]
    label: np.ndarray
    object_ids: np.ndarray
    visual_lies: np.ndarray  # bool [contact], the appearance contradicts the touch
    has_force: bool
    threads: int = 1
    content: str = ""  # hash of all that was recorded; of scenes none, as their configuration decides it
    statistics: dict[int, TouchBatch] = dataclasses.field(default_factory=dict)
    computing: threading.Lock = dataclasses.field(default_factory=threading.Lock)
    """Of the thread that computes the statistics, for which all others wait."""

    @property
    def training(self) -> np.ndarray:
        """Contacts that any stage learns from, ascending."""
        return np.union1d(self.parts["sft"], self.parts["grpo"])

    def batches(self, rows: np.ndarray, **order: Any) -> grain.IterDataset:
        """Clips of some contacts, as `clip_batches` takes the other arguments, through the memory and the threads."""
        return clip_batches(self.store, rows, self.clip, memory=self.memory, threads=self.threads, **order)

    def labels(self, part: str) -> np.ndarray:
        """Labels of the contacts of a part, int32 [n, A]."""
        return self.label[self.parts[part]]

    def levels(self) -> Iterator[str]:
        """For each attribute the number of objects of each level in each part: 0 is not learned, or not asked."""
        for a, name in enumerate(ATTRIBUTES):
            counts = []
            for part, rows in {"training": self.training, **{p: self.parts[p] for p in ("val", "test")}}.items():
                level = self.label[rows[np.unique(self.object_ids[rows], return_index=True)[1]], a]
                of_part = np.bincount(level[level >= 0], minlength=LEVELS[name])
                counts.append(f"{part} {', '.join(map(str, of_part))}")
            yield f"{name}, objects of levels 0 to {LEVELS[name] - 1}: {'; '.join(counts)}"

    def unlearned_sensors(self) -> Iterator[str]:
        """For each part that is asked the sensors in it that touched no training contact."""
        learned = {sensor for i in self.training for sensor in self.store.sensors_of(i)}
        for part in ("val", "test"):
            count = Counter(sensor for i in self.parts[part] for sensor in self.store.sensors_of(i))
            for sensor in sorted(count.keys() - learned):
                yield f"{sensor}: in {count[sensor]} of {len(self.parts[part])} contacts of {part}, in none of training"

    def prior(self) -> np.ndarray:
        """Frequency of each level among the labels of training contacts, float32 [A, K]; padding levels have 0.

        An attribute that nobody annotated has equal shares: no question asks for it.
        """
        train = self.label[self.training]
        rows = np.zeros((len(ATTRIBUTES), max(LEVELS.values())), np.float32)
        for a, name in enumerate(ATTRIBUTES):
            known = train[train[:, a] >= 0, a]
            counts = np.bincount(known, minlength=LEVELS[name]) if len(known) else np.ones(LEVELS[name])
            rows[a, : LEVELS[name]] = counts / counts.sum()
        return rows

    def digest(self) -> str:
        """First 16 hex digits of a SHA-256 of what is learned and scored: contacts, recordings, labels, the split."""
        parts = [rows.tolist() for rows in (self.training, self.parts["val"], self.parts["test"])]
        keys = [str(key) for key in self.store.contacts]
        content = json.dumps(
            [keys, self.label.tolist(), self.visual_lies.tolist(), parts, *filter(None, [self.content])]
        )
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def summary(self) -> dict[str, Any]:
        """Counts for the report."""
        counts = {f"{part}_contacts": len(rows) for part, rows in self.parts.items()}
        counts |= {f"{part}_objects": len(set(self.object_ids[rows])) for part, rows in self.parts.items()}
        test = self.parts["test"]
        return counts | {
            "source": self.store.meta.source,
            "records": self.digest(),
            "sensors": list(self.clip.sensors),
            "frames_per_clip": self.clip.frames,
            "image_px": self.clip.image_px,
            "test_visual_lie_share": float(self.visual_lies[test].mean()),
        }


def require_same_records(data: Dataset, context: Context) -> None:
    """`ConfigurationError` if contacts, recordings, labels or splits changed since the run began."""
    path = str(data.store.path)
    where = hashlib.sha256(path.encode()).hexdigest()[:16]  # a run may read several
    context.require_same(
        f"records/{where}", data.digest(), f"contacts, recordings, labels or splits of {path}, the records,"
    )


def split_parts(store: RecordStore, grpo_share: float | None, left_out: Seq[int] = ()) -> dict[str, np.ndarray]:
    """Contact indices of each part; a `grpo_share` of the training objects is kept from SFT for GRPO.

    Without a share both stages learn from all of them.  `DataError` if no object has a label, or a part no contact.
    """
    train = store.contacts_of_split("train")
    ids = np.array([store.contacts[i].object_id for i in train])
    names = np.unique(ids)
    share = 0.0 if grpo_share is None else grpo_share
    kept = np.isin(ids, np.random.default_rng(0).permutation(names)[: round(share * len(names))])
    val, test = store.contacts_of_split("val"), store.contacts_of_split("test")
    parts = {"sft": train[~kept], "grpo": train if grpo_share is None else train[kept], "val": val, "test": test}
    parts = {name: rows[~np.isin(rows, left_out)] for name, rows in parts.items()}
    if not any(card.labels for card in store.objects.values()):
        raise DataError(
            f"none of the {len(store.objects)} objects has a label: label them with `python -m sensors_io label "
            "RECORDS --labels LABELS.csv --annotator NAME`, which also deals them out to train, val and test"
        )
    for name, rows in parts.items():
        if not len(rows):
            raise DataError(
                f"part {name!r} of the data set holds no contact: every part needs one; use more objects, another "
                f"grpo_share (now {grpo_share}), or splits with objects in train, val and test"
                + (f"; drop_odd leaves out {len(left_out)} contacts" if len(left_out) else "")
            )
    return parts


def has_measured_force(contact: Mapping[str, Sequence]) -> bool:
    """True if any sensor measured the force of a contact."""
    return any(sequence.force_n is not None for sequence in contact.values())


def open_dataset(
    path: Path,
    clip: ClipConfig,
    grpo_share: float | None,
    memory_gib: float = 0.0,
    threads: int = 1,
    left_out: Seq[int] = (),
    content: str = "",
    has_force: bool | None = None,
) -> Dataset:
    """Open records and split them without the contacts that are left out.

    `memory_gib` of their clips stay in memory once so many threads have read them; `content` and `has_force` as of
    `Dataset`, the latter by default as of the first contact.
    """
    store = RecordStore(path)
    clip = dataclasses.replace(clip, sensors=store.meta.sensors)
    cards = [store.objects[key.object_id] for key in store.contacts]
    return Dataset(
        store=store,
        clip=clip,
        memory=ClipMemory(clip, round(memory_gib * 2**30)),
        parts=split_parts(store, grpo_share, left_out=left_out),
        label=np.stack([card.label_row() for card in cards]),
        object_ids=np.array([card.object_id for card in cards]),
        visual_lies=np.array([bool(card.visual_lies) for card in cards]),
        has_force=has_measured_force(store.contact(0)) if has_force is None else has_force,
        threads=threads,
        content=content,
    )
