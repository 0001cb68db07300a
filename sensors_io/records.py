"""Recordings on disk: ArrayRecord shards of sequences, shards of object cards, and one index that makes them visible.

    index.json                     what is complete: meta, shards with their sizes, contacts → entries per sensor
    objects-00000.arrayrecord      one entry per `ObjectCard`
    contacts-00000.arrayrecord     one entry per `Sequence`: one contact seen by one sensor, all its frames

A shard is written under a temporary name, closed, counted, synced and renamed; then the index is replaced.  A killed
writer leaves every published contact readable, and the next one resumes after them.

Frames are stored as the differences that they want (`codec`, `deltas`) and each entry is compressed by ArrayRecord with
zstd at level 1.  `pareto_storage` chose this by a rule; one shared core, bytes as a share of the raw frames and frames
read a second: generated scenes of 112² .46 and 37,600 (without differences .86 and 30,200), GelSight Mini videos at
120 rows .26 and 16,200 (.39 and 18,800), camera stills of 240 rows .47 and 3,800 (.84 and 5,000).  PNG-1 is larger and
reads 5 to 12 times slower; WebP and FFV1 are at best a third smaller and read 2 to 27 times slower.
"""

import dataclasses
import datetime
import fcntl
import hashlib
import os
import pathlib
from collections.abc import Mapping
from collections.abc import Sequence as Seq
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from sensors_io.codec import (
    CorruptRecordsError,
    RecordsError,
    decode_card,
    decode_sequence,
    encode_card,
    encode_sequence,
)
from sensors_io.index import INDEX, Index, MissingIndexError, RecordsMeta, RecordsVersionError
from sensors_io.schema import ContactKey, ObjectCard, SchemaError, Sequence, contacts_of_split
from sensors_io.shards import Entries, ShardWriter

__all__ = [
    "CorruptRecordsError",
    "IncompleteRecordsError",
    "MissingIndexError",
    "RecordStore",
    "RecordWriter",
    "RecordsError",
    "RecordsExistError",
    "RecordsMeta",
    "RecordsVersionError",
]


class IncompleteRecordsError(RecordsError):
    """Records whose writing stopped before the end."""


class RecordsExistError(RecordsError):
    """Records that are already there, or that somebody else is writing."""


class RecordWriter:
    """Writes a data set, as a context manager; leaving the block without an exception marks it complete.

    Objects come before their contacts.  Every `contacts_per_shard` contacts a shard is published, and what is pending
    is published when an exception leaves the block, so that only a killed process loses work: at most one shard.

    Args:
      path: directory of the data set; created if need be.
      meta: what the data set is.
      contacts_per_shard: contacts per published shard.
      resume: continue after the contacts of an earlier writer; `contacts_done` and `objects_done` say which.

    Raises:
      RecordsExistError: the directory holds records and `resume` is off, or they were made by another config, or
        another process is writing them.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, meta: RecordsMeta, contacts_per_shard: int = 64, resume: bool = False
    ):
        if contacts_per_shard < 1:
            raise ValueError(f"contacts_per_shard is {contacts_per_shard}: must be ≥ 1; raise it")
        self._root = pathlib.Path(path)
        try:
            self._root.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise RecordsExistError(
                f"{self._root} leads to a file: must be a directory; choose another path"
            ) from error
        self._per_shard = contacts_per_shard
        self._lock = write_lock(self._root)
        try:
            self._index = _start(self._root, meta, resume)
        except BaseException:
            self._lock.close()
            raise
        self._keys = {key for key, _ in self._index.contacts}
        self._cards: dict[str, bytes] = {}
        self._pending: list[tuple[ContactKey, dict[str, int]]] = []
        self._frames: dict[str, int] = {}
        self._shard: ShardWriter | None = None

    @property
    def contacts_done(self) -> int:
        """Number of contacts written, those of earlier writers included; contacts keep the order of their writing."""
        return len(self._keys)

    @property
    def objects_done(self) -> frozenset[str]:
        """Objects whose card is written."""
        return frozenset(self._index.objects) | self._cards.keys()

    def __contains__(self, key: ContactKey) -> bool:
        return key in self._keys

    @property
    def notes(self) -> Mapping[str, Any]:
        """Notes of the meta, those of earlier writers included."""
        return self._index.meta.notes

    def note(self, **notes: Any) -> None:
        """Add JSON notes to the meta; they become visible with the next published shard."""
        self._index.meta = dataclasses.replace(self._index.meta, notes={**self._index.meta.notes, **notes})

    def write_object(self, card: ObjectCard) -> None:
        """Store one object card.

        Raises:
          SchemaError: the object is there already.
        """
        if card.object_id in self.objects_done:
            raise SchemaError(f"object_id is {card.object_id!r}: an object is stored once; drop the second card")
        self._cards[card.object_id] = encode_card(card)

    def write_contact(self, sequences: Seq[Sequence]) -> None:
        """Store one contact: its sequences by different sensors.

        Raises:
          SchemaError: no sequence, no frame, different keys, a sensor twice or unknown to the meta, a contact that is
            there already, or an object without a card.
        """
        self._check(sequences)
        data = [encode_sequence(sequence) for sequence in sequences]  # refuse bad input before anything is written
        if self._shard is None:
            self._shard = ShardWriter(self._root, f"contacts-{len(self._index.contact_shards):05d}")
        base = sum(shard.entries for shard in self._index.contact_shards)
        entries = {s.sensor: base + self._shard.write(d) for s, d in zip(sequences, data, strict=True)}
        self._pending.append((sequences[0].key, entries))
        self._keys.add(sequences[0].key)
        for sequence in sequences:
            self._frames[sequence.sensor] = self._frames.get(sequence.sensor, 0) + len(sequence)
        if len(self._pending) >= self._per_shard:
            self.publish()

    def publish(self) -> None:
        """Make everything written so far visible, in a shard of its own."""
        index = self._index
        if self._cards:
            cards = ShardWriter(self._root, index.next_objects)
            for card in self._cards.values():
                cards.write(card)
            index.object_shards.append(cards.publish())
            index.objects += self._cards
            self._cards = {}
        if self._shard is not None:
            index.contact_shards.append(self._shard.publish())
            index.contacts += self._pending
            index.frames.update(self._frames)
            self._pending, self._frames, self._shard = [], {}, None
        index.write(self._root)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._index.complete = kind is None
            if kind is None or self._cards or self._shard is not None:
                self.publish()
        finally:
            self._lock.close()

    def _check(self, sequences: Seq[Sequence]) -> None:
        if not sequences:
            raise SchemaError("sequences is []: a contact has at least one sequence; skip empty contacts")
        key, sensors = sequences[0].key, [sequence.sensor for sequence in sequences]
        if any(sequence.key != key for sequence in sequences):
            raise SchemaError(f"{sequences[0].name}: the sequences of a contact share one key; write them apart")
        if len(set(sensors)) != len(sensors) or not set(sensors) <= set(self._index.meta.sensors):
            known = ", ".join(self._index.meta.sensors)
            raise SchemaError(
                f"{sequences[0].name}: sensors are {sensors}: each once, out of {known}; correct the meta"
            )
        if not all(map(len, sequences)):
            raise SchemaError(f"{sequences[0].name}: a sequence of no frames; drop it")
        if key in self._keys:
            raise SchemaError(f"{sequences[0].name}: this contact is stored already; number the trials apart")
        if key.object_id not in self.objects_done:
            raise SchemaError(f"{sequences[0].name}: object {key.object_id!r} has no card; write_object it first")


class RecordStore:
    """Reads a data set: cards in memory, sequences on demand by random access.  It can be pickled to worker processes.

    Args:
      path: directory of the data set.
      allow_incomplete: open what is published of a data set whose writing has not ended.

    Raises:
      MissingIndexError, RecordsVersionError, CorruptRecordsError, IncompleteRecordsError: naming the path and the fix.
    """

    def __init__(self, path: str | os.PathLike[str], *, allow_incomplete: bool = False):
        self.path = pathlib.Path(path)
        self._index = Index.read(self.path)
        if not self._index.complete and not allow_incomplete:
            raise IncompleteRecordsError(
                f"{self.path} holds {len(self._index.contacts)} contacts and its writing has not ended; "
                "resume the writing, or open it with allow_incomplete=True"
            )
        self._cards = Entries(self.path, self._index.object_shards)
        self._entries = Entries(self.path, self._index.contact_shards)
        self.contacts: tuple[ContactKey, ...] = tuple(key for key, _ in self._index.contacts)
        self.objects: dict[str, ObjectCard] = {}
        for i, name in enumerate(self._index.objects):
            self.objects[name] = self._cards.decode(i, decode_card)

    def __len__(self) -> int:
        return len(self.contacts)

    @property
    def meta(self) -> RecordsMeta:
        """Description of the data set."""
        return self._index.meta

    @property
    def complete(self) -> bool:
        """True once writing has ended."""
        return self._index.complete

    @property
    def digest(self) -> str:
        """First 16 hex digits of the SHA-256 of the index: the configuration, all contacts, the size of every shard."""
        return hashlib.sha256((self.path / INDEX).read_bytes()).hexdigest()[:16]

    @property
    def frames(self) -> dict[str, int]:
        """Number of frames of each sensor."""
        return dict(self._index.frames)

    def sensors_of(self, i: int) -> tuple[str, ...]:
        """Sensors that saw contact i, without reading it."""
        return tuple(self._index.contacts[i][1])

    def contact(self, i: int, *, fields: bool = True) -> dict[str, Sequence]:
        """Contact i as each of its sensors saw it.

        Args:
          i: index into `contacts`.
          fields: False leaves out the fields of sequences that have camera frames.

        Raises:
          CorruptRecordsError: an entry whose checksum does not hold or that belongs to another contact.
        """
        key, entries = self._index.contacts[i]
        contact = {}
        for sensor, entry in entries.items():
            sequence = self._entries.decode(entry, lambda data: decode_sequence(data, fields=fields))
            if sequence.key != key or sequence.sensor != sensor:
                raise CorruptRecordsError(
                    f"{self.path}: entry {entry} is {sequence.name}, the index says {key}, {sensor}"
                )
            contact[sensor] = sequence
        return contact

    def contacts_of_split(self, split: str) -> np.ndarray:
        """Indices of the contacts whose object belongs to a split, int64, ascending.

        Raises:
          SchemaError: no such split.
        """
        return contacts_of_split(self.contacts, self.objects, split)


def write_lock(root: pathlib.Path) -> IO[str]:
    """An advisory lock on the directory, until it is closed or the process dies.

    Raises:
      RecordsExistError: another process holds it.
    """
    file = (root / ".lock").open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise RecordsExistError(
            f"{root} is being written by another process; wait for it or choose another path"
        ) from error
    return file


def _content(root: pathlib.Path, index: Index) -> str:
    """Contents of an index, for the message before it is overwritten."""
    state = "complete" if index.complete else "unfinished"
    when = datetime.datetime.fromtimestamp((root / INDEX).stat().st_mtime)
    return (
        f"{len(index.contacts)} contacts of {len(index.objects)} objects already (source: {index.meta.source}; "
        f"{state}, last written {when:%Y-%m-%d %H:%M})"
    )


def _start(root: pathlib.Path, meta: RecordsMeta, resume: bool) -> Index:
    """The index to go on from; files that no index lists are the remains of a killed writer and are removed."""
    index = Index(meta=meta)
    if (root / INDEX).exists():
        index = Index.read(root)
        if not resume:
            raise RecordsExistError(f"{root} holds {_content(root, index)}; choose another path, or resume behind them")
        if index.meta.config_hash != meta.config_hash:
            raise RecordsExistError(
                f"{root} holds {_content(root, index)}, made by config {index.meta.config_hash!r}, not "
                f"{meta.config_hash!r}: one directory holds records of one making; choose another directory, or resume "
                "with the options that made these; nothing was changed"
            )
        index.complete = False
    listed = {shard.file for shard in index.object_shards + index.contact_shards}
    for file in [*root.glob("*.arrayrecord"), *root.glob(".*.arrayrecord.tmp")]:
        if file.name not in listed:
            file.unlink()
    return index
