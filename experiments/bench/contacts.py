"""The measured contacts of a data set that questions are made from: labels, measurements by sensor, a fingerprint."""

import collections
import dataclasses
import hashlib
from collections.abc import Callable, Mapping

import numpy as np

from sensors_io.measures import Measured, MeasureError, measure
from sensors_io.records import RecordStore
from sensors_io.schema import FRAME_ARRAYS, UNKNOWN, Sequence
from touchr1_jax.bench.items import Touch


class ContactError(ValueError):
    """Records from which no questions can be made; the message names what is missing and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeasuredContact:
    """One contact: labels by attribute, measurements by sensor, a fingerprint of the recordings.

    `deceptive` is true where the object's picture suggests another material; `None` where that is unknown.
    """

    touch: Touch
    labels: Mapping[str, int]
    deceptive: bool | None
    measured: Mapping[str, Measured]
    fingerprint: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitContacts:
    """The contacts of one split, and the number of recordings that could not be measured, by reason."""

    contacts: tuple[MeasuredContact, ...]
    skipped: Mapping[str, int]

    def objects(self) -> set[str]:
        """The labelled objects."""
        return {contact.touch.object for contact in self.contacts if contact.labels}

    def by_touch(self) -> dict[Touch, MeasuredContact]:
        """Contacts by touch."""
        return {contact.touch: contact for contact in self.contacts}


def measure_split(store: RecordStore, split: str, after_each: Callable[[], None] = lambda: None) -> SplitContacts:
    """Read and measure all contacts of a split, those of unlabelled objects included; `after_each` is for a bar."""
    contacts, skipped = [], collections.Counter[str]()
    for i in store.contacts_of_split(split):
        key, recorded, measured = store.contacts[i], store.contact(int(i)), {}
        for sensor, sequence in recorded.items():
            try:
                measured[sensor] = measure(sequence)
            except MeasureError as error:
                skipped[f"{sensor}: {error}"] += 1
        if measured:
            card = store.objects[key.object_id]
            contacts.append(
                MeasuredContact(
                    touch=Touch(object=key.object_id, site=key.site, motion=key.motion, trial=key.trial),
                    labels={name: level for name, level in card.labels.items() if level != UNKNOWN},
                    deceptive=card.visual_lies,
                    measured=measured,
                    fingerprint=_fingerprint(recorded),
                )
            )
        after_each()
    return SplitContacts(contacts=tuple(contacts), skipped=dict(skipped))


def _fingerprint(recorded: Mapping[str, Sequence]) -> str:
    """Hash of all recorded arrays but the clock: a copy under another name has the same."""
    digest = hashlib.sha256()
    for sensor, sequence in sorted(recorded.items()):
        digest.update(sensor.encode())
        for name in FRAME_ARRAYS:
            array = getattr(sequence, name)
            if array is not None and not name.endswith("time_ns"):
                digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
