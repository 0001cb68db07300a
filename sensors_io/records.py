"""Recordings on disk: ArrayRecord shards of sequences, shards of object cards, and one index that makes them visible.

    index.json                     root of the index, see `index`: what is complete, and how much of its tables counts
    objects-00000.arrayrecord      one entry per `ObjectCard`
    contacts-00000.arrayrecord     one entry per `Sequence`: one contact seen by one sensor, all its frames

A shard is written under a temporary name, closed, counted, synced and renamed; then the index grows by its rows.  A
killed writer leaves every published contact readable, and the next one resumes after them.

Frames are stored as the differences that they want (`codec`, `deltas`) and each entry is compressed by ArrayRecord with
zstd at level 1.  `pareto_storage` chose this by a rule; one shared core, bytes as a share of the raw frames and frames
read a second: generated scenes of 112² .46 and 37,600 (without differences .86 and 30,200), GelSight Mini videos at
120 rows .26 and 16,200 (.39 and 18,800), camera stills of 240 rows .47 and 3,800 (.84 and 5,000).  PNG-1 is larger and
reads 5 to 12 times slower; WebP and FFV1 are at best a third smaller and read 2 to 27 times slower.
"""

import dataclasses
import datetime
import os
import pathlib
import zlib
from collections.abc import Callable, Container, Iterable, Mapping
from collections.abc import Sequence as Seq
from types import TracebackType
from typing import Any, Self

import numpy as np

from sensors_io.codec import CorruptRecordsError, RecordsError, decode_sequence, encode_card
from sensors_io.contents import Cards, PartWriter, convert
from sensors_io.index import INDEX, Index, MissingIndexError, Part, RecordsMeta, RecordsVersionError, read_root, settled
from sensors_io.locks import RecordsExistError, write_lock
from sensors_io.remote import at_url, place
from sensors_io.schema import SPLITS, ContactKey, ObjectCard, SchemaError, Sequence
from sensors_io.shards import Entries, ShardWriter, array_record_name, is_shard
from sensors_io.tables import ContactTable

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


class RecordWriter:
    """Writes a data set, as a context manager; leaving the block without an exception marks it complete.

    Objects come before their contacts.  Every `contacts_per_shard` contacts a shard is published, and what is pending
    is published when an exception leaves the block, so that only a killed process loses work: at most one shard.

    Args:
      path: directory of the data set; created if need be.
      meta: what the data set is.
      contacts_per_shard: contacts per published shard.
      resume: continue after the contacts of an earlier writer; `contacts_done` and `objects_done` say which.
      kept: names of files that no index lists and that are no remains: parts that are adopted later.

    Raises:
      RecordsExistError: the directory holds records and `resume` is off, or they were made by another config or have
        another licence, or another process is writing them.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        meta: RecordsMeta,
        contacts_per_shard: int = 64,
        resume: bool = False,
        kept: Callable[[str], bool] = lambda name: False,
    ):
        if contacts_per_shard < 1:
            raise ValueError(f"contacts_per_shard is {contacts_per_shard}: must be ≥ 1; raise it")
        self._root = pathlib.Path(path)
        if at_url(path):
            raise RecordsError(f"{path} is a URL: records are written to a folder, then `push` uploads them; name one")
        array_record_name(self._root)  # before anything is recorded
        try:
            self._root.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise RecordsExistError(f"{self._root} leads to a file: must be a folder; choose another path") from error
        self._per_shard = contacts_per_shard
        self._lock = write_lock(self._root)
        try:
            self._index = _start(self._root, meta, resume, kept)
        except BaseException:
            self._lock.close()
            raise
        self._numbers = {name: n for n, name in enumerate(self._index.objects)}
        self._shards, self._entries = len(self._index.contact_shards), int(self._index.contact_shards["entries"].sum())
        self._next_card = self._index.next_objects
        self._added: dict[ContactKey, None] = {}
        self._cards: dict[str, tuple[str, bytes]] = {}
        self._part: PartWriter | None = None
        self._placed: Part | None = None  # in its place, not in the index yet

    @property
    def contacts_done(self) -> int:
        """Number of contacts written, those of earlier writers included; contacts keep the order of their writing."""
        return len(self._index.contacts) + len(self._added)

    @property
    def shards_done(self) -> int:
        """Number of published shards of contacts."""
        return self._shards

    @property
    def objects_done(self) -> frozenset[str]:
        """Objects whose card is written."""
        return frozenset(self._numbers) | self._cards.keys()

    def __contains__(self, key: ContactKey) -> bool:
        return key in self._added or self._index.contacts.find(key) is not None

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
        if card.object_id in self._numbers or card.object_id in self._cards:
            raise SchemaError(f"object_id is {card.object_id!r}: an object is stored once; drop the second card")
        self._cards[card.object_id] = card.split, encode_card(card)

    def write_contact(self, sequences: Seq[Sequence]) -> None:
        """Store one contact: its sequences by different sensors.

        Raises:
          SchemaError: no sequence, no frame, different keys, a sensor twice or unknown to the meta, a contact that is
            there already, or an object without a card.
        """
        if sequences:
            self._check_key(sequences[0].key)
        if self._placed is not None:
            self.publish()
        part = self._part or PartWriter(self._root, self._shards, self._index.meta.sensors)
        part.write(sequences)
        self._part = part
        self._added[sequences[0].key] = None
        if len(part) >= self._per_shard:
            self.publish()

    def adopt(self, part: Part) -> None:
        """Publish the next shard, which another `PartWriter` has put in its place.

        Raises:
          SchemaError: it is not the next one, or as `write_contact`.
        """
        if part.shard[0] != self._shards or self._part is not None:
            raise SchemaError(f"part {part.shard[0]} is not the next one, {self._shards}: adopt parts in order")
        added: dict[ContactKey, None] = {}
        for name, site, trial, motion, _ in part.contacts:
            key = ContactKey(object_id=name, site=site, motion=motion, trial=trial)
            self._check_key(key, added)
            added[key] = None
        self.begin()
        self._publish_cards()
        self._add(part)
        self._added |= added
        self._index.write(self._root)

    def begin(self) -> None:
        """Write the root of the index, if there is none, before the first shard: shards without one have lost it."""
        if not (self._root / INDEX).exists():
            dataclasses.replace(self._index, complete=False).write(self._root)

    def publish(self) -> None:
        """Make everything written so far visible, in a shard of its own."""
        self.begin()
        self._publish_cards()
        if self._part is not None:
            self._placed, self._part = self._part.publish(), None
        if self._placed is not None:
            self._add(self._placed)
            self._placed = None
        self._index.write(self._root)

    def _publish_cards(self) -> None:
        if not self._cards:
            return
        shard = ShardWriter(self._root, "objects", self._next_card)
        for _, data in self._cards.values():
            shard.write(data)
        splits = {name: split for name, (split, _) in self._cards.items()}
        self._index.add_objects(self._root, shard.publish(), splits)
        self._numbers |= {name: len(self._numbers) + n for n, name in enumerate(self._cards)}
        self._cards, self._next_card = {}, self._next_card + 1

    def _add(self, part: Part) -> None:
        self._index.add_part(self._root, part, self._numbers, self._entries)
        self._shards, self._entries = self._shards + 1, self._entries + part.shard[1]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._index.complete = kind is None
            if kind is None or self._cards or self._part is not None or self._placed is not None:
                self.publish()
        finally:
            self._lock.close()

    def _check_key(self, key: ContactKey, added: Container[ContactKey] = ()) -> None:
        named = f"{key.object_id}/{key.site}/{key.motion}/{key.trial}"
        if key in self or key in added:
            raise SchemaError(f"{named}: this contact is stored already; number the trials apart")
        if key.object_id not in self._numbers and key.object_id not in self._cards:
            raise SchemaError(f"{named}: object {key.object_id!r} has no card; write_object it first")


class RecordStore:
    """Reads a data set: cards in memory, sequences on demand by random access.  It can be pickled to worker processes.

    Args:
      path: directory of the data set.
      allow_incomplete: open what is published of a data set whose writing has not ended.

    Raises:
      MissingIndexError, RecordsVersionError, CorruptRecordsError, IncompleteRecordsError: naming the path and the fix.
    """

    def __init__(self, path: str | os.PathLike[str], *, allow_incomplete: bool = False):
        self.path = place(path)
        settled(self.path, self._open)
        if not self._index.complete and not allow_incomplete:
            raise IncompleteRecordsError(
                f"{self.path} holds {len(self)} contacts and its writing has not ended; "
                "resume the writing, or open it with allow_incomplete=True"
            )

    def _open(self, root: dict[str, Any], digest: str) -> None:
        self.digest = digest
        """First 16 hex digits of the SHA-256 of the root, which holds the configuration and the tables' checksums."""
        self._root, self._index = root, Index.of(self.path, root)
        self._entries = Entries(self.path, "contacts", self._index.contact_shards)
        self.contacts: ContactTable = self._index.contacts
        self.objects: Mapping[str, ObjectCard] = Cards(self.path, self._index)

    def __getstate__(self) -> Any:
        return self.path, self._root, self.digest

    def __setstate__(self, state: Any) -> None:
        self.path, *opened = state
        try:
            self._open(*opened)  # as it was, though more may have been published since
        except CorruptRecordsError as error:
            if read_root(self.path)[1] == self.digest:
                raise
            raise RecordsError(
                f"{self.path}: its objects got other labels after it was opened; start again, to read those"
            ) from error

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
    def files(self) -> tuple[str, ...]:
        """Names of all files but the root of the index, shards first; an index before version 3 has no others."""
        return (*self._index.shard_files(), *(table.file for table in self._index.tables.values() if table.size))

    @property
    def frames(self) -> dict[str, int]:
        """Number of frames of each sensor."""
        return dict(self._index.frames)

    def sensors_of(self, i: int) -> tuple[str, ...]:
        """Sensors that saw contact i, without reading it."""
        return tuple(self.contacts.entries(i))

    def contact(self, i: int, *, fields: bool = True) -> dict[str, Sequence]:
        """Contact i as each of its sensors saw it.

        Args:
          i: index into `contacts`; `contacts.find` gives that of a key.
          fields: False leaves out the fields of sequences that have camera frames.

        Raises:
          CorruptRecordsError: an entry whose checksum does not hold or that belongs to another contact.
        """
        key, contact = self.contacts[i], {}
        for sensor, entry in self.contacts.entries(i).items():
            sequence = self._entries.decode(entry, lambda data: decode_sequence(data, fields=fields))
            if sequence.key != key or sequence.sensor != sensor:
                raise CorruptRecordsError(
                    f"{self.path}: entry {entry} is {sequence.name}, the index says {key}, {sensor}"
                )
            contact[sensor] = sequence
        return contact

    def checksum(self, i: int) -> int:
        """CRC-32 of all that is stored of contact i, which `digest` does not cover.

        Raises:
          CorruptRecordsError: an entry that cannot be read.
        """
        found = [self._entries.decode(entry, zlib.crc32) for entry in self.contacts.entries(i).values()]
        return zlib.crc32(np.array(found, np.uint32).tobytes())

    def fetch_ahead(self, contacts: Iterable[int]) -> None:
        """Begin to copy the shards of contacts from a store, in the order in which these are read."""
        self._entries.fetch_ahead(int(self.contacts.rows[i]["entry"]) for i in contacts)

    def contacts_of_split(self, split: str) -> np.ndarray:
        """Indices of the contacts whose object belongs to a split, int64, ascending.

        Raises:
          SchemaError: no such split.
        """
        if split not in SPLITS:
            raise SchemaError(f"split is {split!r}: must be one of {', '.join(SPLITS)}; rename it")
        splits = self._index.splits
        of = [card.split for card in self.objects.values()] if splits is None else splits
        chosen = np.array([one == split for one in of] or [False])[self.contacts.rows["object"]]
        return np.flatnonzero(chosen)


def _content(root: pathlib.Path, index: Index) -> str:
    """Contents of an index, for the message before it is overwritten."""
    state = "complete" if index.complete else "unfinished"
    when = datetime.datetime.fromtimestamp((root / INDEX).stat().st_mtime)
    return (
        f"{len(index.contacts)} contacts of {len(index.objects)} objects already (source: {index.meta.source}; "
        f"{state}, last written {when:%Y-%m-%d %H:%M})"
    )


def _start(root: pathlib.Path, meta: RecordsMeta, resume: bool, kept: Callable[[str], bool]) -> Index:
    """The index to go on from; files that it does not list are the remains of a killed writer and are removed."""
    index = Index.new(meta)
    remains = [file for file in sorted(root.glob("*.arrayrecord")) if is_shard(file.name) and not kept(file.name)]
    if not (root / INDEX).exists() and remains:
        raise RecordsExistError(
            f"{remains[0]} is there, but no {INDEX}, which is written first: copy it back, or move the shards away"
        )
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
        if index.meta.licence != meta.licence:
            raise RecordsExistError(
                f"{root} holds records of licence {index.meta.licence!r}, not {meta.licence!r}: one directory has one "
                "licence; choose another directory, or give the licence that is there; nothing was changed"
            )
        convert(root, index)
        index.complete = False
    listed = {*index.shard_files()}
    for file in [*remains, *root.glob(".*.arrayrecord.*tmp")]:
        if file.name not in listed:
            file.unlink()
    return index
