"""The records of a session and their journals: what is done, what is wanted next, what a kill left behind."""

import collections
import dataclasses
import itertools
import pathlib
from typing import Any

import cv2
import numpy as np

from sensors_io.cards import replace_cards
from sensors_io.index import INDEX, JOURNALS, Index
from sensors_io.recording.assemble import assemble, background_name
from sensors_io.recording.coach import ContactStage
from sensors_io.records import RecordsExistError, RecordsMeta, RecordStore, RecordWriter
from sensors_io.schema import ContactKey, ObjectCard, SchemaError
from sensors_io.shards import is_shard

ATTEMPTS = 16
"""Of one contact: trial = level · ATTEMPTS + attempt."""

_PER_SHARD = 19  # contacts: those of one site by protocol


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectView:
    """View of the object by an RGB-D camera before the first contact.

    Args:
      picture: uint8 [Hv, Wv, 3] RGB.
      depth_mm: float32 [Hv, Wv], 0 where the camera saw none; `None` without a depth camera.
      region_px: (x, y, width, height) of the contact in it; `None` where unknown.
    """

    picture: np.ndarray
    depth_mm: np.ndarray | None = None
    region_px: tuple[int, int, int, int] | None = None


@dataclasses.dataclass(kw_only=True)
class Report:
    """Result of a session.

    Attributes:
      contacts: written.
      recovered: those of them that came from journals of a killed session.
      incomplete: those of them that are asked for again.
      ended: the replay that ended before the session was complete, in words; empty otherwise.
      left_out: frames of another size or with other arrays than most of their contact.
      broken: frames with values that no sensor measures; they are flagged.
      absent: contacts in which a sensor of the session gave no frame, by its name.
      silent: contacts at the beginning or end of which a sensor gave no frame for long, by its name.
      view_dropped: the object had a view already, from an earlier session, and keeps it.
      given_up: stages that `ATTEMPTS` contacts did not complete, in words.
    """

    contacts: int = 0
    recovered: int = 0
    incomplete: int = 0
    ended: str = ""
    left_out: int = 0
    broken: int = 0
    absent: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    silent: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    view_dropped: bool = False
    given_up: list[str] = dataclasses.field(default_factory=list)


def require_own(out: pathlib.Path) -> None:
    """Refuse shards of contacts that no index lists and that no killed session left, for it leaves journals too.

    Raises:
      RecordsExistError: they came from other records, and would be taken for remains and deleted.
    """
    if not (out / INDEX).exists() or any((out / JOURNALS).glob("*.journal")):
        return
    strange = {file.name for file in out.glob("contacts-*") if is_shard(file.name)} - {*Index.read(out).shard_files()}
    if strange:
        raise RecordsExistError(
            f"{out} holds {min(strange)}, which its {INDEX} does not list: another folder of records was copied over "
            "this one, which must be separated again, or the journals of a killed session were deleted; move the shard "
            "away. Nothing was changed"
        )


def complete_view(out: pathlib.Path, meta: RecordsMeta, object_id: str, view: ObjectView) -> bool:
    """Give the card of an object that was recorded without a view this one; False if it has one already."""
    if not (out / INDEX).exists():
        return True
    store = RecordStore(out, allow_incomplete=True)
    if (store.meta.config_hash, store.meta.licence) != (meta.config_hash, meta.licence):
        return True  # records of another making, which the writer refuses
    card = store.objects.get(object_id)
    if card is not None and card.view is None:
        replace_cards(out, [dataclasses.replace(card, view=view.picture, view_depth_mm=view.depth_mm)])
    return card is None or card.view is None


class Book:
    """The records and their journals."""

    def __init__(self, writer: RecordWriter, journals: pathlib.Path, report: Report):
        self._writer, self._journals, self._report = writer, journals, report
        self._incomplete: list[list[Any]] = list(writer.notes.get("incomplete", []))
        self._unpublished: dict[pathlib.Path, ContactKey] = {}

    def add_object(self, object_id: str, view: ObjectView | None = None) -> None:
        """Store the card of an object that has none; a view is published at once, for no journal holds it."""
        if object_id in self._writer.objects_done:
            return
        card = ObjectCard(object_id=object_id, split="unlabelled", labels={}, annotator="nobody yet")
        if view is None:
            self._writer.write_object(card)
        else:
            self._writer.write_object(dataclasses.replace(card, view=view.picture, view_depth_mm=view.depth_mm))
            self._writer.publish()

    def recover(self) -> None:
        """Bring journals that a killed session left into the records."""
        for path in sorted(self._journals.glob("*.journal")):
            self._report.recovered += self.store(path) is not None

    def wanted(self, object_id: str, site: int, stage: ContactStage) -> ContactKey | None:
        """Identity of the next attempt at a stage; `None` once it is complete or has been tried `ATTEMPTS` times."""
        for attempt in range(ATTEMPTS):
            trial = stage.level * ATTEMPTS + attempt
            key = ContactKey(object_id=object_id, site=site, motion=stage.motion, trial=trial)
            if key not in self._writer:
                return key
            if _plain(key) not in self._incomplete:
                return None
        self._report.given_up.append(f"{stage.motion} at {stage.force_n:g} N")
        return None

    def path(self, key: ContactKey) -> pathlib.Path:
        """The journal of a contact."""
        return self._journals / f"{key.object_id}-{key.site}-{key.motion}-{key.trial}.journal"

    def store(self, path: pathlib.Path) -> bool | None:
        """Write a journal's contact; whether it was complete, `None` if there was nothing in it."""
        try:
            return self._store(path)
        except SchemaError as error:  # set aside, or it would stop every later session
            numbers = itertools.chain([""], (f".{n}" for n in itertools.count(2)))  # an earlier attempt's stays
            names = (path.with_suffix(f"{number}.refused") for number in numbers)
            kept = path.rename(next(name for name in names if not name.exists()))
            raise SchemaError(f"{error}; nothing is lost: the contact's journal is kept as {kept}") from error

    def _store(self, path: pathlib.Path) -> bool | None:
        found = assemble(path)
        if found is None:
            path.unlink()
            return None
        key = found.sequences[0].key
        if key not in self._writer:  # else it was published, and its journal not yet deleted
            self.add_object(key.object_id)
            for sensor, picture in found.backgrounds.items():
                _write_picture(self._journals.parent / background_name(key, sensor), picture)
            self._writer.write_contact(found.sequences)
            self._report.contacts += 1
            self._report.absent.update(found.sequences[0].camera["recording"]["absent"])
            for sensor, recording in ((sequence.sensor, sequence.camera["recording"]) for sequence in found.sequences):
                self._report.silent[sensor] += any(recording["silent_s"])
                self._report.left_out += recording["left_out"]
                self._report.broken += max(recording["broken"].values(), default=0)
            if not found.complete:
                self._report.incomplete += 1
                self._incomplete.append(_plain(key))
                self._writer.note(incomplete=self._incomplete)
        self._unpublished[path] = key
        if len(self._unpublished) >= _PER_SHARD:
            self.publish()
        return found.complete

    def publish(self) -> None:
        """Make everything visible; a journal is deleted once its contact has been read back from the records.

        Raises:
          CorruptRecordsError: a contact that cannot be read back; its journal stays.
        """
        self._writer.publish()
        if not self._unpublished:
            return
        store = RecordStore(self._journals.parent, allow_incomplete=True)
        numbers = {key: i for i, key in enumerate(store.contacts)}
        for path, key in self._unpublished.items():
            store.contact(numbers[key])
            path.unlink()
        self._unpublished.clear()


def _plain(key: ContactKey) -> list[Any]:
    return [key.object_id, key.site, key.motion, key.trial]


def _write_picture(path: pathlib.Path, picture: np.ndarray) -> None:
    """Write a PNG whole or not at all."""
    path.parent.mkdir(exist_ok=True)
    temporary = path.with_suffix(".tmp.png")
    if not cv2.imwrite(str(temporary), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)):
        raise OSError(f"{temporary} cannot be written: look whether the disk is full")
    temporary.replace(path)
