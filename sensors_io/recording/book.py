"""The records of a session and the journals beside them: what is done, what is wanted next, what a kill left behind."""

import dataclasses
import pathlib
from typing import Any

from sensors_io.recording.assemble import assemble
from sensors_io.recording.coach import Stage
from sensors_io.records import RecordWriter
from sensors_io.schema import ContactKey, ObjectCard

ATTEMPTS = 16
"""Of one contact: trial = level · ATTEMPTS + attempt."""

_PER_SHARD = 19  # contacts: those of one site by protocol


@dataclasses.dataclass(kw_only=True)
class Report:
    """What a session did: contacts written, those recovered from journals of a killed one, those asked for again."""

    contacts: int = 0
    recovered: int = 0
    incomplete: int = 0


class Book:
    """The records and the journals beside them."""

    def __init__(self, writer: RecordWriter, journals: pathlib.Path, report: Report):
        self._writer, self._journals, self._report = writer, journals, report
        self._incomplete: list[list[Any]] = list(writer.notes.get("incomplete", []))
        self._unpublished: list[pathlib.Path] = []

    def add_object(self, object_id: str) -> None:
        if object_id not in self._writer.objects_done:
            self._writer.write_object(
                ObjectCard(object_id=object_id, split="unlabelled", labels={}, annotator="nobody yet")
            )

    def recover(self) -> None:
        """Bring journals that a killed session left into the records."""
        for path in sorted(self._journals.glob("*.journal")):
            self._report.recovered += self.store(path) is not None

    def wanted(self, object_id: str, site: int, stage: Stage) -> ContactKey | None:
        """Identity of the next attempt at a stage; `None` once it is complete or has been tried `ATTEMPTS` times."""
        for attempt in range(ATTEMPTS):
            trial = stage.level * ATTEMPTS + attempt
            key = ContactKey(object_id=object_id, site=site, motion=stage.motion, trial=trial)
            if key not in self._writer:
                return key
            if _plain(key) not in self._incomplete:
                return None
        return None

    def path(self, key: ContactKey) -> pathlib.Path:
        return self._journals / f"{key.object_id}-{key.site}-{key.motion}-{key.trial}.journal"

    def store(self, path: pathlib.Path) -> bool | None:
        """Write a journal's contact; whether it was complete, `None` if there was nothing in it."""
        found = assemble(path)
        if found is None:
            path.unlink()
            return None
        self._unpublished.append(path)
        key = found.sequence.key
        if key not in self._writer:  # else it was published, and its journal not yet deleted
            self.add_object(key.object_id)
            self._writer.write_contact([found.sequence])
            self._report.contacts += 1
            if not found.complete:
                self._report.incomplete += 1
                self._incomplete.append(_plain(key))
                self._writer.note(incomplete=self._incomplete)
        if len(self._unpublished) >= _PER_SHARD:
            self.publish()
        return found.complete

    def publish(self) -> None:
        """Make everything visible; only then are its journals deleted."""
        self._writer.publish()
        for path in self._unpublished:
            path.unlink()
        self._unpublished.clear()


def _plain(key: ContactKey) -> list[Any]:
    return [key.object_id, key.site, key.motion, key.trial]
