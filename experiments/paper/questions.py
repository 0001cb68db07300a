"""The questions of the bench put to whoever answers about single touches: a policy of one prompt, or a baseline.

A property of a touch is asked as it stands; several properties one by one; one sensor by that sensor alone.  Touches
are compared by what is answered about each: by the level, between equal levels by the mean of the levels by single
sensors; if these are equal too, the touch that is shown first is taken to have less.  So a constant gets exactly the
chance of a question that comes in all orders.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Int

from experiments.bench.contacts import measure_split
from experiments.bench.draw import Quota, draw
from experiments.core.context import Context
from experiments.study.answers import Evaluated
from experiments.study.dataset import Dataset
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import Ask, Touch
from touchr1_jax.bench.metrics import BOTTOM

SCALE = 3
"""The K of ordinal levels: means of levels over K stay below one level."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Answerer:
    """What was answered about n contacts, by all streams and by each alone; −1 where nothing was or could be read."""

    level: Int[np.ndarray, "n A"]
    alone: Int[np.ndarray, "n S A"]

    @staticmethod
    def of(said: Evaluated, contacts: int) -> "Answerer":
        """From the answers to every question about some contacts.

        A policy without touch says the same whichever sensor is shown.

        Args:
          said: the answers; `contact` counts among them.
          contacts: n.
        """
        attributes, streams = said.label.shape[1], said.streams.shape[1]
        level = np.full((contacts, attributes), BOTTOM)
        alone = np.full((contacts, streams, attributes), BOTTOM)
        n = np.arange(len(said.contact))
        spoken = np.asarray(said.parsed.conclude)[n, said.attribute]
        level[said.contact, said.attribute] = spoken
        single = np.repeat(spoken[:, None], streams, 1) if said.alone is None else said.alone[n, :, said.attribute]
        alone[said.contact, :, said.attribute] = single
        return Answerer(level=level, alone=alone)

    def strength(self, contact: int, attribute: int) -> float | None:
        """How much of a property a contact has; `None` where its level is ⊥."""
        level, alone = self.level[contact, attribute], self.alone[contact, :, attribute]
        if level == BOTTOM:
            return None
        read = alone[alone != BOTTOM]
        return float(level) + (float(read.mean()) / SCALE if len(read) else 0.0)


def questions(data: Dataset, quota: Quota, context: Context) -> tuple[Ask, ...]:
    """The bench's questions about the test contacts."""
    with context.progress("measuring contacts", len(data.store.contacts_of_split("test"))) as advance:
        contacts = measure_split(data.store, "test", advance).contacts
    return draw(contacts, data.clip.sensors, quota, seed=0)


def answered(data: Dataset, asks: Sequence[Ask], seeds: Sequence[Evaluated]) -> list[dict[str, tuple[int, ...]]]:
    """What the answers about single touches answer to the bench's questions, for every seed."""
    rows, contacts = touch_rows(data), len(data.parts["test"])
    return [answer_all(asks, Answerer.of(said, contacts), rows, data.clip.sensors) for said in seeds]


def touch_rows(data: Dataset, part: str = "test") -> dict[Touch, int]:
    """The place of each contact of a part of the data among its contacts."""
    keys = [data.store.contacts[int(i)] for i in data.parts[part]]
    return {Touch(object=k.object_id, site=k.site, motion=k.motion, trial=k.trial): n for n, k in enumerate(keys)}


def answer_all(
    asks: Iterable[Ask], answerer: Answerer, rows: Mapping[Touch, int], sensors: Sequence[str]
) -> dict[str, tuple[int, ...]]:
    """The levels that answer each question, keyed by its id, −1 for ⊥.

    Args:
      asks: questions about contacts in `rows`.
      answerer: what is answered about each of them.
      rows: place of each contact in `answerer`.
      sensors: names of the streams, in their order.
    """
    return {ask.id: _answer(ask, answerer, [rows[t] for t in ask.touches], sensors) for ask in asks}


def _answer(ask: Ask, answerer: Answerer, rows: list[int], sensors: Sequence[str]) -> tuple[int, ...]:
    asked = [ATTRIBUTES.index(name) for name in ask.attributes]
    if ask.kind == "one_sensor":
        return (int(answerer.alone[rows[0], sensors.index(ask.sensors[0]), asked[0]]),)
    if ask.kind not in ("compare", "order"):
        return tuple(int(answerer.level[rows[0], a]) for a in asked)
    strengths = [answerer.strength(row, asked[0]) for row in rows]
    known = [s for s in strengths if s is not None]
    if len(known) < len(strengths):
        return (BOTTOM,)
    rising = tuple(int(i) for i in np.argsort(known, kind="stable"))
    return (rising[-1],) if ask.kind == "compare" else (ORDERS.index(rising),)
