"""The index of a data set: its meta, its shards, and which entries belong to which contact.

    index.json       root: meta, counts of frames, and of each table below the bytes that are visible, with a checksum
    index.contacts   a row for each contact, see `tables`      index.contact-shards   a row for each shard of them
    index.objects    a line for each object: id and split      index.object-shards    a row for each shard of cards

A publication appends to the tables and then replaces the root in one step, so that its cost does not depend on how many
contacts there are.  What the root does not state does not exist.
"""

import collections
import dataclasses
import hashlib
import itertools
import json
import os
import pathlib
from collections.abc import Callable, Iterable, Mapping
from collections.abc import Sequence as Seq
from typing import Any, Self, TypeVar

import numpy as np

from sensors_io.codec import CorruptRecordsError, RecordsError
from sensors_io.errors import MALFORMED, name_and_text, of_system
from sensors_io.json_files import seal, unseal
from sensors_io.remote import Place, StoreError, local
from sensors_io.schema import MOTIONS
from sensors_io.shards import shard_file
from sensors_io.tables import NO_SENSOR, SHARD, ContactTable, GrowingFile, contact_dtype

FORMAT = "touchr1-records"
VERSION = 3
READABLE = (1, 2, 3)
"""Versions whose records this code reads; 1 stored camera frames as they are, 2 stores differences, 3 has tables."""

INDEX = "index.json"
JOURNALS = ".journals"  # of contacts that are being recorded

TABLES = ("contacts", "contact-shards", "objects", "object-shards")

_OLD = (1, 2)  # everything in one JSON
_BYTES = np.dtype("u1")

_T = TypeVar("_T")


class MissingIndexError(RecordsError):
    """A directory without an index."""


class RecordsVersionError(RecordsError):
    """Records written by another version of the format."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordsMeta:
    """Description of a data set: source, licence, hash of its config, sensors.

    `notes` is free JSON: the report of an import, the config of a generation.
    """

    source: str
    licence: str
    config_hash: str
    sensors: tuple[str, ...]
    notes: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """One shard of contacts and what it adds to the index.

    Attributes:
      shard: its row of `SHARD`.
      contacts: object id, site, trial, motion, sensors in the order of their entries.
      frames: of each sensor.
    """

    shard: tuple[int, int, int]
    contacts: tuple[tuple[str, int, int, str, tuple[str, ...]], ...]
    frames: Mapping[str, int]

    @classmethod
    def of(cls, tree: Mapping[str, Any]) -> Self:
        """A part that was JSON."""
        contacts = tuple((*row[:4], tuple(row[4])) for row in tree["contacts"])
        return cls(shard=tuple(tree["shard"]), contacts=contacts, frames=tree["frames"])


@dataclasses.dataclass(kw_only=True)
class Index:
    """The index as it was opened, and as it grows.

    `contacts`, `objects` and the rows of shards are those that it was opened with; what is added goes to the tables
    alone.  `splits` are those of `objects`, `None` in indexes before version 3, which are converted when first written.
    """

    meta: RecordsMeta
    complete: bool = False
    frames: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    objects: list[str] = dataclasses.field(default_factory=list)
    splits: list[str] | None = None
    contacts: ContactTable
    contact_shards: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, SHARD))
    object_shards: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, SHARD))
    tables: dict[str, GrowingFile] = dataclasses.field(default_factory=dict)

    @classmethod
    def new(cls, meta: RecordsMeta) -> Self:
        """The index of no records."""
        rows = np.zeros(0, contact_dtype(len(meta.sensors)))
        return cls(meta=meta, contacts=ContactTable(rows, [], meta.sensors), splits=[], tables=_no_tables())

    @classmethod
    def read(cls, root: Place) -> Self:
        """The index of the data set in `root`.

        Raises:
          MissingIndexError, RecordsVersionError, CorruptRecordsError: there is none, it is another version's, or it is
            damaged.
          RecordsError: it cannot be read.
        """
        return settled(root, lambda tree, _: cls.of(root, tree))

    @classmethod
    def of(cls, root: Place, tree: Mapping[str, Any]) -> Self:
        """The index whose root is `tree`.

        Raises:
          CorruptRecordsError: root or tables are damaged.
        """
        try:
            return cls._old(tree) if tree["version"] in _OLD else cls._opened(root, tree)
        except (OSError, *MALFORMED) as error:
            if isinstance(error, RecordsError) or of_system(error):
                raise
            raise CorruptRecordsError(
                f"{root}/{INDEX} is damaged ({name_and_text(error)}); delete {root} and write it again"
            ) from error

    @classmethod
    def _opened(cls, root: Place, tree: Mapping[str, Any]) -> Self:
        tables = {name: GrowingFile(**tree["tables"][name]) for name in TABLES}
        if any(pathlib.PurePath(t.file).name != t.file for t in tables.values()):
            raise ValueError(f"the file of a table in {tree['tables']} must be a name in its folder")
        meta = _meta(tree)
        types = dict(zip(TABLES, (contact_dtype(len(meta.sensors)), SHARD, _BYTES, SHARD), strict=True))
        read = {
            name: t.read(local(root, t.file), types[name]) if t.size else np.zeros(0, types[name])
            for name, t in tables.items()
        }
        words = read["objects"].tobytes().decode().split()
        return cls(
            meta=meta,
            complete=tree["complete"],
            frames=collections.Counter(tree["frames"]),
            objects=words[::2],
            splits=words[1::2],
            contacts=ContactTable(read["contacts"], words[::2], meta.sensors, tree["motions"]),
            contact_shards=np.array(read["contact-shards"]),
            object_shards=np.array(read["object-shards"]),
            tables=tables,
        )

    @classmethod
    def _old(cls, tree: Mapping[str, Any]) -> Self:
        """The content of an index of version 1 or 2, one JSON."""
        meta, objects, contacts, first = _meta(tree), list(tree["objects"]), [], []
        for name, site, motion, trial, entries in tree["contacts"]:
            contacts.append((name, site, trial, motion, tuple(entries)))
            first.append(min(entries.values()))
            if [*entries.values()] != [*range(first[-1], first[-1] + len(entries))]:
                raise ValueError(f"entries {entries} of a contact do not follow each other")
        rows = _rows(contacts, first, {name: n for n, name in enumerate(objects)}, meta.sensors)
        shards = lambda kind: np.array([(_number(x["file"]), x["entries"], x["bytes"]) for x in tree[kind]], SHARD)
        return cls(
            meta=meta,
            complete=tree["complete"],
            frames=collections.Counter(tree["frames"]),
            objects=objects,
            contacts=ContactTable(rows, objects, meta.sensors),
            contact_shards=shards("contact_shards"),
            object_shards=shards("object_shards"),
        )

    @property
    def next_objects(self) -> int:
        """Number of the next shard of cards; none comes twice, though shards of replaced cards are gone."""
        return int(self.object_shards["number"].max()) + 1 if len(self.object_shards) else 0

    def shard_files(self) -> tuple[str, ...]:
        """Names of all shards."""
        kinds = {"objects": self.object_shards, "contacts": self.contact_shards}
        return tuple(shard_file(kind, number) for kind, rows in kinds.items() for number in rows["number"].tolist())

    def convert(self, root: pathlib.Path, splits: Mapping[str, str]) -> None:
        """Write the tables of an index of an older version; the root is not replaced yet."""
        self.tables, self.splits = _no_tables(), [splits[name] for name in self.objects]
        self._append(root, {"contacts": self.contacts.rows, "contact-shards": self.contact_shards})
        self.add_objects(root, self.object_shards, dict(zip(self.objects, self.splits, strict=True)))

    def add_objects(self, root: pathlib.Path, shards: np.ndarray, splits: Mapping[str, str]) -> None:
        """Append objects, id → split, and the shards of their cards."""
        lines = "".join(f"{name} {split}\n" for name, split in splits.items())
        self._append(root, {"objects": np.frombuffer(lines.encode(), _BYTES), "object-shards": shards})

    def replace_objects(self, root: pathlib.Path, shard: np.ndarray, splits: Mapping[str, str]) -> None:
        """Tables of objects under new names, of which one shard holds all cards."""
        for name in ("objects", "object-shards"):
            self.tables[name] = GrowingFile(file=f"index.{name}-{int(shard['number']):05d}")
        self.add_objects(root, shard, splits)

    def add_part(self, root: pathlib.Path, part: Part, numbers: Mapping[str, int], entry: int) -> None:
        """Append a shard of contacts.

        Args:
          root: of the data set.
          part: the shard.
          numbers: object id → its number.
          entry: number of its first entry.
        """
        first = itertools.accumulate((len(seen) for *_, seen in part.contacts), initial=entry)
        rows = _rows(part.contacts, first, numbers, self.meta.sensors)
        self._append(root, {"contacts": rows, "contact-shards": np.array(part.shard, SHARD)})
        self.frames.update(part.frames)

    def _append(self, root: pathlib.Path, added: Mapping[str, np.ndarray]) -> None:
        """Append to tables: to all of them, or to none if a signal or a full disk comes between."""
        self.tables |= {name: self.tables[name].append(root, data.tobytes()) for name, data in added.items()}

    def write(self, root: pathlib.Path) -> None:
        """Replace the root in one step, which makes visible what was added."""
        tree = {
            "format": FORMAT,
            "version": VERSION,
            "meta": dataclasses.asdict(self.meta),
            "complete": self.complete,
            "frames": self.frames,
            "motions": MOTIONS,
            "tables": {name: dataclasses.asdict(table) for name, table in self.tables.items()},
        }
        temporary = root / f".{INDEX}.tmp"
        with temporary.open("w", encoding="utf-8") as file:
            file.write(seal(json.dumps(tree, separators=(",", ":"), allow_nan=False)))
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(root / INDEX)


def settled(root: Place, opened: Callable[[dict[str, Any], str], _T]) -> _T:
    """Open the root of an index by a function of what `read_root` gives; its value.

    Cards that are replaced go with their tables as soon as a new root names others: who read the old one reads again.
    """
    found = read_root(root)
    while True:
        try:
            return opened(*found)
        except (RecordsError, OSError):
            before, found = found, read_root(root)
            if found == before:
                raise


def looks_like_records(path: pathlib.Path) -> bool:
    """True of a folder with an index, or with the files that accompany a lost one: its pictures are no others."""
    return any((path / name).exists() for name in (INDEX, JOURNALS)) or any(path.glob("*.arrayrecord"))


def read_root(root: Place) -> tuple[dict[str, Any], str]:
    """The root of an index, of a version that this code reads, and the first 16 hex digits of its file's SHA-256.

    Raises:
      MissingIndexError, RecordsVersionError, CorruptRecordsError, RecordsError: as `Index.read`.
    """
    if isinstance(root, pathlib.Path) and not (root / INDEX).is_file():
        killed = " (a recording was killed: the same `record` brings it in)" if (root / JOURNALS).is_dir() else ""
        raise MissingIndexError(
            f"{root} has no {INDEX}: give the directory of a data set, or write one there first{killed}"
        )
    path = f"{root}/{INDEX}"
    try:
        data = local(root, INDEX).read_bytes()
        text = data.decode()
        tree = json.loads(text)
        found = (tree["format"], tree["version"])  # first: another version may have another checksum
        if found in [(FORMAT, version) for version in READABLE]:
            unsealed: dict[str, Any] = unseal(text)
            return unsealed, hashlib.sha256(data).hexdigest()[:16]
    except OSError as error:
        raise RecordsError(
            f"{path} cannot be read ({error}); make it readable, or copy it again from its source"
        ) from error
    except StoreError:
        raise
    except MALFORMED as error:
        raise CorruptRecordsError(
            f"{path} is damaged ({name_and_text(error)}); delete {root} and write it again"
        ) from error
    raise RecordsVersionError(
        f"{path} is {found[0]!r} version {found[1]!r}, this code reads {FORMAT!r} versions {READABLE}; "
        "write the records again, or read them with the code that wrote them"
    )


def _rows(
    contacts: Iterable[tuple[str, int, int, str, tuple[str, ...]]],
    first: Iterable[int],
    numbers: Mapping[str, int],
    sensors: Seq[str],
) -> np.ndarray:
    """Rows of contacts as in `Part`, whose entries follow each other from the `first` of each on."""
    places = {name: n for n, name in enumerate(sensors)}
    padded = lambda seen: [places[s] for s in seen] + [NO_SENSOR] * (len(places) - len(seen))
    rows = [
        (numbers[name], site, trial, MOTIONS.index(motion), entry, padded(seen))
        for (name, site, trial, motion, seen), entry in zip(contacts, first, strict=False)
    ]
    return np.array(rows, contact_dtype(len(places)))


def _no_tables() -> dict[str, GrowingFile]:
    return {name: GrowingFile(file=f"index.{name}") for name in TABLES}


def _meta(tree: Mapping[str, Any]) -> RecordsMeta:
    """The meta of a root, whose words and counts are ones, for they are asked for long after it was opened."""
    meta = RecordsMeta(**tree["meta"] | {"sensors": tuple(tree["meta"]["sensors"])})
    words = (meta.source, meta.licence, meta.config_hash, *meta.sensors, *tree.get("motions", ()))
    if not all(isinstance(word, str) for word in words) or not isinstance(meta.notes, Mapping):
        raise ValueError("a word of its meta or its motions is no text")
    if not all(type(count) is int for count in tree["frames"].values()) or not isinstance(tree["complete"], bool):
        raise ValueError("its frames are no counts, or complete is neither true nor false")
    return meta


def _number(file: str) -> int:
    """Number in the name of a shard."""
    return int(pathlib.Path(file).stem.rpartition("-")[2])
