"""The index of a data set: its meta, its shards, and which entries belong to which contact.

What the index does not list does not exist; it is replaced as a whole, after the shards that it lists are in place.
"""

import collections
import dataclasses
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any, Self

from sensors_io.codec import CorruptRecordsError, RecordsError
from sensors_io.errors import MALFORMED
from sensors_io.json_files import seal, unseal
from sensors_io.schema import ContactKey
from sensors_io.shards import Shard

FORMAT = "touchr1-records"
VERSION = 2
READABLE = (1, 2)
"""Versions whose records this code reads; 1 stored camera frames as they are, 2 stores differences."""

INDEX = "index.json"


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


@dataclasses.dataclass(kw_only=True)
class Index:
    """The content of index.json; `contacts` maps each sensor of a contact to its entry, counted through all shards."""

    meta: RecordsMeta
    complete: bool = False
    object_shards: list[Shard] = dataclasses.field(default_factory=list)
    contact_shards: list[Shard] = dataclasses.field(default_factory=list)
    objects: list[str] = dataclasses.field(default_factory=list)
    contacts: list[tuple[ContactKey, dict[str, int]]] = dataclasses.field(default_factory=list)
    frames: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)

    @property
    def next_objects(self) -> str:
        """Name of the next shard of cards; no number comes twice, though shards of replaced cards are gone."""
        used = [int(shard.file.removeprefix("objects-").partition(".")[0]) for shard in self.object_shards]
        return f"objects-{max(used, default=-1) + 1:05d}"

    @classmethod
    def read(cls, root: pathlib.Path) -> Self:
        """The index of the data set in `root`.

        Raises:
          MissingIndexError, RecordsVersionError, CorruptRecordsError: there is none, it is another version's, or it is
            damaged.
          RecordsError: it cannot be read.
        """
        path = root / INDEX
        if not path.is_file():
            raise MissingIndexError(
                f"{root} has no {INDEX}: give the directory of a data set, or write one there first"
            )
        try:
            text = path.read_text()
            tree = json.loads(text)
            found = (tree["format"], tree["version"])  # first: another version may have another checksum
            if found in [(FORMAT, version) for version in READABLE]:
                return cls._from_tree(unseal(text))
        except OSError as error:
            raise RecordsError(
                f"{path} cannot be read ({error}); make it readable, or copy it again from its source"
            ) from error
        except MALFORMED as error:
            raise CorruptRecordsError(f"{path} is damaged ({error!r}); delete {root} and write it again") from error
        raise RecordsVersionError(
            f"{path} is {found[0]!r} version {found[1]!r}, this code reads {FORMAT!r} versions {READABLE}; "
            "write the records again, or read them with the code that wrote them"
        )

    @classmethod
    def _from_tree(cls, tree: Mapping[str, Any]) -> Self:
        contacts = [
            (ContactKey(object_id=name, site=site, motion=motion, trial=trial), entries)
            for name, site, motion, trial, entries in tree["contacts"]
        ]
        return cls(
            meta=RecordsMeta(**tree["meta"] | {"sensors": tuple(tree["meta"]["sensors"])}),
            complete=tree["complete"],
            object_shards=[Shard(**shard) for shard in tree["object_shards"]],
            contact_shards=[Shard(**shard) for shard in tree["contact_shards"]],
            objects=tree["objects"],
            contacts=contacts,
            frames=collections.Counter(tree["frames"]),
        )

    def write(self, root: pathlib.Path) -> None:
        """Replace the index in `root` in one step."""
        tree = {
            "format": FORMAT,
            "version": VERSION,
            "meta": dataclasses.asdict(self.meta),
            "complete": self.complete,
            "object_shards": [dataclasses.asdict(shard) for shard in self.object_shards],
            "contact_shards": [dataclasses.asdict(shard) for shard in self.contact_shards],
            "objects": self.objects,
            "contacts": [[k.object_id, k.site, k.motion, k.trial, entries] for k, entries in self.contacts],
            "frames": self.frames,
        }
        temporary = root / f".{INDEX}.tmp"
        with temporary.open("w") as file:
            file.write(seal(json.dumps(tree, separators=(",", ":"), allow_nan=False)))
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(root / INDEX)
