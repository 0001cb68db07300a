"""What the generator knows of the contacts of a data set: labels, what each sensor measured, a fingerprint."""

import collections
import dataclasses
import hashlib
from collections.abc import Callable, Mapping

import numpy as np

from sensors_io.measures import Measured, MeasureError, measure
from sensors_io.records import RecordStore
from sensors_io.schema import FRAME_ARRAYS, UNKNOWN, ContactKey, ObjectCard, Sequence
from touchr1_jax.bench.items import Touch


class ContactError(ValueError):
    """Records that no questions can be made of; the message names what is missing and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeasuredContact:
    """One contact: its labels by attribute, what each sensor measured, a fingerprint of what was recorded."""

    touch: Touch
    labels: Mapping[str, int]
    deceptive: bool | None
    measured: Mapping[str, Measured]
    fingerprint: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitContacts:
    """The contacts of one split, and how many recordings measured nothing, by reason."""

    contacts: tuple[MeasuredContact, ...]
    skipped: Mapping[str, int]

    def objects(self) -> set[str]:
        """The objects that have a label."""
        return {contact.touch.object for contact in self.contacts if contact.labels}

    def by_touch(self) -> dict[Touch, MeasuredContact]:
        """Every contact by its name."""
        return {contact.touch: contact for contact in self.contacts}


def measure_split(store: RecordStore, split: str, tell: Callable[[], None] = lambda: None) -> SplitContacts:
    """Read and measure the contacts of a split, those of unlabelled objects too.

    Args:
      store: the records.
      split: as in the records.
      tell: called after every contact.
    """
    contacts, skipped = [], collections.Counter[str]()
    for i in store.contacts_of_split(split):
        card, recorded = store.objects[store.contacts[i].object_id], store.contact(int(i))
        measured = {}
        for sensor, sequence in recorded.items():
            try:
                measured[sensor] = measure(sequence)
            except MeasureError as error:
                skipped[f"{sensor}: {error}"] += 1
        if measured:
            contacts.append(_contact(store.contacts[i], card, recorded, measured))
        tell()
    return SplitContacts(contacts=tuple(contacts), skipped=dict(skipped))


def _contact(
    key: ContactKey, card: ObjectCard, recorded: Mapping[str, Sequence], measured: Mapping[str, Measured]
) -> MeasuredContact:
    return MeasuredContact(
        touch=Touch(object=key.object_id, site=key.site, motion=key.motion, trial=key.trial),
        labels={name: level for name, level in card.labels.items() if level != UNKNOWN},
        deceptive=card.visual_lies,
        measured=measured,
        fingerprint=fingerprint(recorded),
    )


def fingerprint(recorded: Mapping[str, Sequence]) -> str:
    """Hash of all that was measured, not of names: a copy under another name has the same."""
    digest = hashlib.sha256()
    for sensor, sequence in sorted(recorded.items()):
        digest.update(sensor.encode())
        for name in FRAME_ARRAYS:
            array = getattr(sequence, name)
            if array is not None and not name.endswith("time_ns"):
                digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
