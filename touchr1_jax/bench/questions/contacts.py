"""The measured contacts that questions are made from."""

import dataclasses
from collections.abc import Mapping
from typing import Protocol

from touchr1_jax.bench.items import Touch


class ContactError(ValueError):
    """Records from which no questions can be made; the message names what is missing and the fix."""


class Measurement(Protocol):
    """The numbers that one sensor measured of a contact, such as `sensors_io.measures.Measured`."""

    @property
    def quantities(self) -> Mapping[str, float]:
        """Name → value."""

    @property
    def units(self) -> Mapping[str, str]:
        """Name → unit."""

    @property
    def at(self) -> tuple[float, float]:
        """(x, y) of the place as shares of the window."""

    @property
    def box(self) -> tuple[float, float, float, float]:
        """(left, top, right, bottom) of the contact as shares of the window, x right, y down."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeasuredContact:
    """One contact: labels by attribute, measurements by sensor, a fingerprint of the recordings.

    `deceptive` is true where the object's picture suggests another material; `None` where that is unknown.
    """

    touch: Touch
    labels: Mapping[str, int]
    deceptive: bool | None
    measured: Mapping[str, Measurement]
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
