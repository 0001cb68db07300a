"""Contacts of records that are exported, and what of them JSON can say."""

import contextlib
import dataclasses
import hashlib
import importlib
import json
import os
import pathlib
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from sensors_io.contents import put_rest_pictures
from sensors_io.errors import UserError
from sensors_io.index import RecordsMeta
from sensors_io.records import RecordStore, RecordWriter
from sensors_io.schema import FRAME_ARRAYS, ContactKey, ObjectCard, Sequence

FORMAT = "touchr1-export"
"""Says in every export that can be imported again what it is."""

SEQUENCE_PLAIN = ("sensor", "serial", "calibration", "camera", "contact_region_px", "mm_per_px")
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
    return json.dumps(plain)


def sequence_of(text: str, arrays: Mapping[str, Any]) -> Sequence:
    """The sequence that `sequence_text` and its arrays describe."""
    plain = json.loads(text)
    region = plain["contact_region_px"]
    plain |= {"key": ContactKey(**plain["key"]), "contact_region_px": None if region is None else tuple(region)}
    return Sequence(**plain, **{name: arrays[name] for name in FRAME_ARRAYS if name in arrays})


def card_text(card: ObjectCard) -> str:
    """A card without its view, as JSON."""
    plain = {name: getattr(card, name) for name in _CARD_PLAIN}
    return json.dumps(plain | {"labels": dict(card.labels), "truth": dict(card.truth)})


def card_of(text: str, arrays: Mapping[str, Any]) -> ObjectCard:
    """The card that `card_text` and its view describe."""
    return ObjectCard(**json.loads(text), view=arrays.get("view"), view_depth_mm=arrays.get("view_depth_mm"))


def meta_text(meta: RecordsMeta) -> str:
    """Description of the records and of the format, as JSON."""
    return json.dumps({"format": FORMAT, "version": 1, "meta": dataclasses.asdict(meta)})


def meta_of(text: str, where: object) -> RecordsMeta:
    """The description that `meta_text` wrote.

    Raises:
      ExportError: an export of another version, or of another program.
    """
    tree = json.loads(text)
    if (tree.get("format"), tree.get("version")) != (FORMAT, 1):
        raise ExportError(
            f"{where} is {tree.get('format')!r} version {tree.get('version')!r}, this code reads {FORMAT!r} version 1; "
            "export the records again"
        )
    return RecordsMeta(**tree["meta"] | {"sensors": tuple(tree["meta"]["sensors"])})


def write_back(
    meta: RecordsMeta,
    cards: Iterable[ObjectCard],
    contacts: Iterable[list[Sequence]],
    rests: Mapping[str, bytes],
    out: pathlib.Path,
    progress: Callable[[], object],
) -> None:
    """Write what an export holds as records; an interrupted import goes on behind the contacts that are there."""
    with RecordWriter(out, meta=meta, resume=True) as writer:
        put_rest_pictures(out, rests)
        for card in cards:
            if card.object_id not in writer.objects_done:
                writer.write_object(card)
        for sequences in contacts:
            if sequences[0].key not in writer:
                writer.write_contact(sequences)
            progress()


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
    """A path beside `out` to write to, which takes its place if the block ends without an error, and else vanishes.

    Raises:
      ExportError: `out` is there already.
    """
    if out.exists():
        raise ExportError(f"--out is {out}: must not exist yet; name another path, or move it away")
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        temporary.replace(out)
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        temporary.unlink(missing_ok=True)
