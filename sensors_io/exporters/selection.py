"""Contacts of records that are exported, and what of them JSON can say.

The libraries that write exports find no flipped bit, and read an array that is missing as zeros; so the JSON of each
part states the checksum of its arrays, and that of the whole the number of sequences.
"""

import contextlib
import dataclasses
import hashlib
import importlib
import json
import os
import pathlib
import shutil
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import numpy as np

from sensors_io.codec import encode_sequence
from sensors_io.contents import put_rest_pictures, rest_pictures
from sensors_io.errors import MALFORMED, UserError, name_and_text
from sensors_io.index import RecordsMeta
from sensors_io.json_files import seal, unseal
from sensors_io.records import RecordsExistError, RecordStore, RecordWriter
from sensors_io.schema import FRAME_ARRAYS, ContactKey, ObjectCard, Sequence

FORMAT = "touchr1-export"
"""Says in every export that can be imported again what it is."""

SEQUENCE_PLAIN = ("sensor", "serial", "calibration", "camera", "contact_region_px", "mm_per_px")
ARRAYS = "arrays"
"""Key of the checksum of a part's arrays; exports of earlier versions have none."""

UNREADABLE = (*MALFORMED, OSError, RuntimeError, EOFError, zlib.error)
"""What h5py, zarr, pyarrow and PyAV raise for damaged files."""

_T = TypeVar("_T")
VIEWS = ("view", "view_depth_mm")
_CARD_PLAIN = ("object_id", "split", "labels", "annotator", "visual_lies", "truth", "name")

Progress = Callable[[int, int], None]


class ExportError(UserError, ValueError):
    """Records that a format cannot hold, or an export that cannot be read; the message says why and what to do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Selected:
    """Contacts and sensors of records, in order.

    Args:
      store: the records.
      rows: numbers of the contacts; empty for all.
      sensors: by name; empty for all.

    Raises:
      ExportError: a contact or sensor that the records do not have, or none at all.
    """

    store: RecordStore
    rows: tuple[int, ...] = ()
    sensors: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        have = self.store.meta.sensors
        wrong = sorted(set(self.sensors) - set(have))
        if wrong:
            raise ExportError(f"sensors is {', '.join(wrong)}: must be of {', '.join(have)}; correct it")
        outside = [row for row in self.rows if not 0 <= row < len(self.store)]
        if len(set(self.rows)) < len(self.rows):
            raise ExportError(
                f"contacts is {list(self.rows)}: must name each contact once; leave out what is named again"
            )
        if outside or not len(self.store):
            raise ExportError(
                f"contacts is {outside or 'empty'}: must lie in 0..{len(self.store) - 1}; `list` shows the records"
            )

    @property
    def meta(self) -> RecordsMeta:
        """That of the records; a part of them is known by another hash."""
        whole = self.store.meta
        sensors = tuple(s for s in whole.sensors if not self.sensors or s in self.sensors)
        if not self.rows and sensors == whole.sensors:
            return whole
        part = hashlib.sha256(f"{whole.config_hash} {self.rows} {sensors}".encode()).hexdigest()[:16]
        return dataclasses.replace(whole, sensors=sensors, config_hash=part)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Contacts that one of the sensors saw."""
        rows = self.rows or range(len(self.store))
        return tuple(i for i in rows if set(self.meta.sensors) & set(self.store.sensors_of(i)))

    def cards(self) -> list[ObjectCard]:
        """Cards of the objects that are touched."""
        touched = {self.store.contacts[i].object_id for i in self.numbers}
        return [card for name, card in self.store.objects.items() if name in touched]

    def contacts(self, progress: Progress = lambda done, total: None) -> Iterator[tuple[int, dict[str, Sequence]]]:
        """Number and sequences of each contact."""
        for done, i in enumerate(self.numbers, 1):
            contact = self.store.contact(i)
            yield i, {sensor: contact[sensor] for sensor in self.meta.sensors if sensor in contact}
            progress(done, len(self.numbers))


def sequence_text(sequence: Sequence) -> str:
    """A sequence without its arrays, as JSON."""
    plain = {name: getattr(sequence, name) for name in SEQUENCE_PLAIN} | {"key": dataclasses.asdict(sequence.key)}
    return seal(json.dumps(plain | {ARRAYS: _checksum({name: getattr(sequence, name) for name in FRAME_ARRAYS})}))


def sequence_of(text: str, arrays: Mapping[str, Any]) -> Sequence:
    """The sequence that `sequence_text` and its arrays describe.

    Raises:
      ExportError: the arrays are others than were exported.
    """
    plain, own = unseal(text), {name: arrays[name] for name in FRAME_ARRAYS if name in arrays}
    key, region = ContactKey(**plain["key"]), plain["contact_region_px"]
    _require_same(plain, own, f"{key} by {plain['sensor']}")
    plain |= {"key": key, "contact_region_px": None if region is None else tuple(region)}
    return Sequence(**plain, **own)


def card_text(card: ObjectCard) -> str:
    """A card without its view, as JSON."""
    plain = {name: getattr(card, name) for name in _CARD_PLAIN}
    plain |= {"labels": dict(card.labels), "truth": dict(card.truth)}
    return seal(json.dumps(plain | {ARRAYS: _checksum({name: getattr(card, name) for name in VIEWS})}))


def card_of(text: str, arrays: Mapping[str, Any]) -> ObjectCard:
    """The card that `card_text` and its view describe.

    Raises:
      ExportError: the view is another than was exported.
    """
    plain, own = unseal(text), {name: arrays[name] for name in VIEWS if name in arrays}
    _require_same(plain, own, f"object {plain['object_id']}")
    return ObjectCard(**plain, **own)


def _checksum(arrays: Mapping[str, Any]) -> int:
    """CRC-32 of the names, types, shapes and values of the arrays that are not `None`."""
    crc = 0
    for name, array in sorted(arrays.items()):
        if array is not None:
            crc = zlib.crc32(f"{name} {array.dtype.str} {array.shape} ".encode(), crc)
            crc = zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data, crc)
    return crc


def _require_same(plain: dict[str, Any], arrays: Mapping[str, Any], what: str) -> None:
    if plain.pop(ARRAYS, None) not in (None, _checksum(arrays)):
        raise ExportError(
            f"{what}: its arrays are not those that were exported; export the records again, or, if the change is "
            f"meant, remove {ARRAYS!r} and 'crc32' from its JSON"
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExportHead:
    """Description of an export, by itself.

    Args:
      meta: of the records.
      sequences: their number; `None` in exports of earlier versions.
      rests: name → CRC-32 of the pictures of gels at rest; empty in exports of earlier versions.
    """

    meta: RecordsMeta
    sequences: int | None
    rests: Mapping[str, int]


def head_text(selected: Selected) -> str:
    """Description of the records and of the format, as JSON."""
    sensors, store = set(selected.meta.sensors), selected.store
    rests = {name: zlib.crc32(data) for name, data in rest_pictures(store.path).items()}
    counted = {"sequences": sum(len(sensors & set(store.sensors_of(i))) for i in selected.numbers), "rests": rests}
    return seal(json.dumps({"format": FORMAT, "version": 1, "meta": dataclasses.asdict(selected.meta), **counted}))


def head_of(text: str, where: object) -> ExportHead:
    """The description that `head_text` wrote.

    Raises:
      ExportError: an export of another version, or of another program.
    """
    tree = unseal(text)
    if (tree.get("format"), tree.get("version")) != (FORMAT, 1):
        raise ExportError(
            f"{where} is {tree.get('format')!r} version {tree.get('version')!r}, this code reads {FORMAT!r} version 1; "
            "export the records again"
        )
    meta = RecordsMeta(**tree["meta"] | {"sensors": tuple(tree["meta"]["sensors"])})
    return ExportHead(meta=meta, sequences=tree.get("sequences"), rests=tree.get("rests", {}))


@dataclasses.dataclass(frozen=True, kw_only=True)
class FoundExport:
    """An opened export: its description, cards and gels at rest, its contacts one after the other, and their number."""

    head: ExportHead
    cards: list[ObjectCard]
    rests: Mapping[str, bytes]
    count: int
    contacts: Iterator[list[Sequence]]


@contextlib.contextmanager
def damage_named(path: pathlib.Path) -> Iterator[None]:
    """Errors of the libraries that read an export become one that names it.

    Raises:
      ExportError: it is no export, or damaged.
    """
    try:
        yield
    except UserError:
        raise
    except UNREADABLE as error:
        raise ExportError(
            f"{path} is no export of records, or damaged ({name_and_text(error)}); export them again"
        ) from error


def write_back(path: pathlib.Path, found: FoundExport, out: pathlib.Path, progress: Progress) -> None:
    """Write what an export holds as records; an interrupted import goes on behind the contacts that are there.

    Raises:
      ExportError: a part of it is damaged or missing.
      RecordsExistError: `out` holds other records, or another contact or gel at rest under the same name.
    """
    differ = {
        name for name, data in found.rests.items() if found.head.rests.get(name, zlib.crc32(data)) != zlib.crc32(data)
    }
    if lost := sorted(differ | (found.head.rests.keys() - found.rests.keys())):
        raise ExportError(f"{path}: the gel at rest in {lost[0]} is missing or damaged; export the records again")
    sequences = 0
    with RecordWriter(out, meta=found.head.meta, resume=True) as writer:
        there, rests = RecordStore(out, allow_incomplete=True) if writer.contacts_done else None, rest_pictures(out)
        for name in found.rests.keys() & rests.keys():
            _require_own(rests[name] == found.rests[name], f"gel at rest {name}", out, path)
        put_rest_pictures(out, found.rests)
        for card in found.cards:
            if card.object_id not in writer.objects_done:
                writer.write_object(card)
        for done, contact in enumerate(_read(path, found.contacts), 1):
            if not contact:
                raise ExportError(f"{path}: contact {done} holds no sequence; export the records again")
            if there is not None and (number := there.contacts.find(contact[0].key)) is not None:
                same = _encoded(there.contact(number).values()) == _encoded(contact)
                _require_own(same, contact[0].name, out, path)
            else:
                writer.write_contact(contact)
            sequences += len(contact)
            progress(done, found.count)
        if found.head.sequences not in (None, sequences):
            raise ExportError(f"{path} holds {sequences} of {found.head.sequences} sequences; export the records again")


def _encoded(contact: Iterable[Sequence]) -> dict[str, bytes]:
    return {sequence.sensor: encode_sequence(sequence) for sequence in contact}


def _require_own(same: bool, what: str, out: pathlib.Path, path: pathlib.Path) -> None:
    if not same:
        raise RecordsExistError(
            f"{out} holds another {what} than {path}: records of one name are of one recording; choose another one"
        )


def _read(path: pathlib.Path, parts: Iterator[_T]) -> Iterator[_T]:
    """Each part of an export; errors of writing the records are not raised in here."""
    with damage_named(path):
        yield from parts


def library(name: str, extra: str) -> Any:
    """A package that only an export needs.

    Raises:
      ExportError: it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ExportError(f"{name} is not installed: pip install 'touchr1-jax[{extra}]'") from error


@contextlib.contextmanager
def published(out: pathlib.Path) -> Iterator[pathlib.Path]:
    """A path next to `out` to write to, which takes its place if the block ends without an error, and else vanishes.

    Raises:
      ExportError: `out` is there already.
    """
    there = ExportError(f"--out is {out}: must not exist yet; name another path, or move it away")
    if out.exists():
        raise there
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        try:
            if temporary.is_file():
                os.link(temporary, out)  # a file that moves replaces another one; a folder does not
            else:
                temporary.rename(out)
        except OSError:
            if out.exists():  # written meanwhile, by another process
                raise there from None
            temporary.replace(out)  # a file system without links
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        temporary.unlink(missing_ok=True)
