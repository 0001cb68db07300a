"""Search for answers that earn reward without touch: all short programs of slots and layouts, evaluated exactly.

A program fills each slot with a constant level, nothing, all levels, or a reading of touch, and arranges the slots in a
valid or invalid layout.  Its expected reward is a sum over labels and readings of touch.  No program may earn more than
the honest one, whose slots all contain their own readings.
"""

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from touchr1_jax.rewards.base import AnyReward, total_reward
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.oracle import read
from touchr1_jax.types import Parsed, Target

ACCURACY = 0.4
"""Share of right readings of the honest answer: touch that is hardly better than chance among three levels."""

TOUCH, COPY, NOTHING, ALL = "touch", "copy", "nothing", "all levels"
"""Fillings of a slot: its own reading; in `perceive` that of the conclusion; no level; every level."""

ATTRIBUTE = TOUCH_LANGUAGE.attributes[0]
WORDS = tuple(words[0] for words in ATTRIBUTE.levels)
K, SENSORS = len(WORDS), 2

LAYOUTS: Mapping[str, str] = {
    "in order": "<perceive> {p} </perceive> <compare> {c} </compare> <conclude> {a} </conclude>",
    "wrong order": "<conclude> {a} </conclude> <compare> {c} </compare> <perceive> {p} </perceive>",
    "nested": "<perceive> <compare> <conclude> {p} {c} {a} </conclude> </compare> </perceive>",
    "tag twice": "<perceive> {p} </perceive> <compare> {c} </compare> <conclude> {a} </conclude> <compare>",
    "not closed": "<perceive> {p} </perceive> <compare> {c} </compare> <conclude> {a}",
    "text after": "<perceive> {p} </perceive> <compare> {c} </compare> <conclude> {a} </conclude> so",
    "no tags": "{p} {c} {a}",
}
"""Arrangements of the bodies of `perceive` p, `compare` c and `conclude` a."""


@dataclasses.dataclass(frozen=True)
class AnswerProgram:
    """A layout and the filling of every slot; `perceive` has one for each of two sensors."""

    layout: str
    perceive: tuple[str, ...]
    compare: str
    conclude: str

    def __str__(self) -> str:
        return f"{self.layout}: {' '.join(dict.fromkeys(self.perceive))} → {self.compare} → {self.conclude}"

    def text(self, reading: Sequence[int]) -> str:
        """The answer, given the reading of the conclusion and that of each sensor."""
        whole, *each = (WORDS[level] for level in reading)
        fill = lambda slot, own: {TOUCH: own, COPY: whole, ALL: " ".join(WORDS)}.get(slot, slot)
        named = zip(TOUCH_LANGUAGE.sensors, self.perceive, each, strict=False)
        perceive = " ".join(f"{sensor.phrases[0]} {fill(slot, own)}" for sensor, slot, own in named)
        return LAYOUTS[self.layout].format(p=perceive, c=fill(self.compare, whole), a=fill(self.conclude, whole))


HONEST = AnswerProgram("in order", (TOUCH,) * SENSORS, TOUCH, TOUCH)
ECHO = AnswerProgram("in order", (COPY,) * SENSORS, TOUCH, TOUCH)
"""The honest conclusion copied into all slots: the label alone does not distinguish it from sensors that agree."""


def programs() -> list[AnswerProgram]:
    """Every program but the honest one and its echo."""
    slots = (*WORDS, NOTHING, ALL, TOUCH)
    pairs = [*itertools.product(WORDS, repeat=SENSORS), *((slot,) * SENSORS for slot in (NOTHING, ALL, TOUCH, COPY))]
    every = (AnswerProgram(*parts) for parts in itertools.product(LAYOUTS, pairs, slots, slots))
    return [program for program in every if program not in (HONEST, ECHO)]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Earnings:
    """Reward of each program, [programs, readings, labels]; the honest one is the last."""

    table: Float[np.ndarray, "N R K"]
    prior: Float[np.ndarray, "K"]

    def expected(self, accuracy: float = ACCURACY) -> Float[np.ndarray, "N"]:
        """Expected reward of each program if a reading is right with that probability and otherwise any other level."""
        channel = np.full((K, K), (1 - accuracy) / (K - 1)) + (accuracy - (1 - accuracy) / (K - 1)) * np.eye(K)
        odds = [[self.prior[y] * np.prod(channel[y, list(r)]) for y in range(K)] for r in _readings()]
        return np.einsum("nrk,rk->n", self.table, np.array(odds))

    def better(self, accuracy: float = ACCURACY, slack: float = 1e-6) -> list[tuple[AnswerProgram, float]]:
        """Programs that earn more than the honest one, and their lead, the largest first."""
        *earned, honest = self.expected(accuracy)
        leads = [(program, float(e - honest)) for program, e in zip(programs(), earned, strict=True)]
        return sorted((lead for lead in leads if lead[1] > slack), key=lambda lead: -lead[1])


def earnings(rewards: Mapping[str, AnyReward], weights: Mapping[str, float], prior: Sequence[float]) -> Earnings:
    """Reward of every program for every reading and label.

    Args:
      rewards: all rewards by name; those that need a prior must be made with this one.
      weights: of the rewards that are used.
      prior: share of each of the three levels among the labels.
    """
    target = Target(
        asked=jnp.arange(len(TOUCH_LANGUAGE.attributes)) == 0,
        label=jnp.full(len(TOUCH_LANGUAGE.attributes), -1),
        levels=jnp.array([len(a.levels) for a in TOUCH_LANGUAGE.attributes]),
        ordinal=jnp.array([a.ordinal for a in TOUCH_LANGUAGE.attributes]),
        streams=jnp.arange(len(TOUCH_LANGUAGE.sensors)) < SENSORS,
    )

    def of_label(parsed: Parsed, label: jax.Array) -> jax.Array:
        asked = dataclasses.replace(target, label=target.label.at[0].set(label))
        return total_reward(rewards, weights, parsed, asked)[0]

    score = jax.jit(jax.vmap(jax.vmap(of_label, in_axes=(None, 0)), in_axes=(0, None)))
    distinct, which = _answers()
    return Earnings(table=np.asarray(score(distinct, jnp.arange(K)))[which], prior=np.asarray(prior))


def with_prior(prior: Sequence[float]) -> np.ndarray:
    """A prior [A, K] with these shares for the attribute that programs are asked about, uniform for all others."""
    widest = max(len(a.levels) for a in TOUCH_LANGUAGE.attributes)
    rows = [[1 / len(a.levels)] * len(a.levels) for a in TOUCH_LANGUAGE.attributes]
    rows[0] = list(prior)
    return np.array([row + [0.0] * (widest - len(row)) for row in rows], np.float32)


def _readings() -> list[tuple[int, ...]]:
    return list(itertools.product(range(K), repeat=1 + SENSORS))


@functools.cache
def _answers() -> tuple[Parsed, np.ndarray]:
    """The distinct answers of all programs, parsed, and which of them each writes for each reading, int [N, R]."""
    texts = [[program.text(reading) for reading in _readings()] for program in (*programs(), HONEST)]
    index = {text: i for i, text in enumerate(dict.fromkeys(itertools.chain.from_iterable(texts)))}
    found = [read(TOUCH_LANGUAGE, text) for text in index]
    parsed = Parsed(
        perceive=jnp.array([r.perceive for r in found]),
        compare=jnp.array([r.compare for r in found]),
        conclude=jnp.array([r.conclude for r in found]),
        formatted=jnp.array([r.formatted for r in found]),
        truncated=jnp.zeros(len(found), bool),
        length=jnp.array([len(text.split()) for text in index]),
    )
    return parsed, np.array([[index[text] for text in row] for row in texts])
