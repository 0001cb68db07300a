"""The bank of contacts returns what it holds, and the check of an environment names what is wrong with it."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from touchr1_jax.rl.environment import (
    EnvironmentCheckError,
    Outcome,
    TouchBank,
    TouchCase,
    TouchChoice,
    check_bank,
    check_environment,
)

CHOICES = (
    TouchChoice(sensor="tac3d", motion="slide", force_n=5.0),
    TouchChoice(sensor="xense", motion="press", force_n=2.5),
)
EVERY = np.ones(2, bool)


def make_bank(**changes) -> TouchBank:
    """Two objects, two choices, three tokens of width 4; object 1 lacks choice 1."""
    tokens = np.arange(2 * 2 * 3 * 4, dtype=np.float32).reshape(2, 2, 3, 4)
    bank = TouchBank(
        tokens=tokens,
        available=np.array([[True, True], [True, False]]),
        seconds=np.array([[3.0, 1.0], [4.0, 2.0]], np.float32),
        harm=np.array([[0.0, 1.0], [0.5, 1.0]], np.float32),
        label=np.zeros((2, 5), np.int32),
        choices=CHOICES,
    )
    return dataclasses.replace(bank, **changes)


def cases(*objects: int) -> TouchCase:
    return TouchCase(np.array(objects, np.int32), np.tile(EVERY, (len(objects), 1)))


def touch(bank: TouchBank, which: int, offered: np.ndarray, action: int) -> Outcome:
    bank = jax.tree.map(jnp.asarray, bank)
    state = bank.reset(TouchCase(jnp.array(which), jnp.asarray(offered)))
    return bank.step(state, jnp.array(action))[1]


def test_words_and_kinds_of_choices():
    assert make_bank().actions == ("tac3d slide 5n", "xense press 2.5n")
    assert make_bank().kinds == ("slide", "press")


def test_an_available_contact_is_gathered():
    seen = touch(make_bank(), 0, EVERY, 1)
    np.testing.assert_array_equal(seen.tokens, make_bank().tokens[0, 1])
    assert seen.exists.all()
    assert (seen.seconds, seen.harm) == (1.0, 1.0)


@pytest.mark.parametrize(("which", "offered"), [(1, EVERY), (0, np.array([True, False]))])
def test_a_missing_contact_shows_nothing_and_takes_its_time(which, offered):
    seen = touch(make_bank(), which, offered, 1)
    assert not seen.exists.any()
    assert not seen.tokens.any()
    assert (seen.seconds, seen.harm) == (make_bank().seconds[which, 1], 0.0)


def test_the_check_returns_every_outcome():
    found = check_environment(make_bank(), cases(0, 1), budget=1)
    assert found.tokens.shape == (2, 2, 3, 4)
    np.testing.assert_array_equal(found.exists.any(-1), make_bank().available)


BAD = {
    "budget": ({}, 0),
    "actions": ({"choices": CHOICES[:1]}, 1),
    "occur twice": ({"choices": (CHOICES[0], CHOICES[0])}, 1),
    "outcome.tokens": ({"tokens": np.full((2, 2, 3, 4), np.nan, np.float32)}, 1),
    "outcome.seconds": ({"seconds": np.full((2, 2), -1, np.float32)}, 1),
}


@pytest.mark.parametrize("names", BAD)
def test_the_check_names_the_fault(names):
    changes, budget = BAD[names]
    with pytest.raises(EnvironmentCheckError, match=names):
        check_environment(make_bank(**changes), cases(0, 1), budget=budget)


NOTHING_TO_CHOOSE = {
    "no object has": np.array([[True, False], [True, False]]),
    "1 objects": np.array([[True, True], [True, False]]),
    "2 objects": np.array([[True, False], [False, True]]),
}


@pytest.mark.parametrize("available", NOTHING_TO_CHOOSE.values(), ids=NOTHING_TO_CHOOSE)
def test_banks_without_a_choice_are_refused(available):
    with pytest.raises(EnvironmentCheckError):
        check_bank(make_bank(available=available))


def test_objects_with_one_contact_are_refused():
    with pytest.raises(EnvironmentCheckError, match=r"\[1\]"):
        check_bank(make_bank())


class Count(NamedTuple):
    """State of the environments below."""

    touches: jax.Array


@struct.dataclass
class Faulty:
    """An environment that does what `fault` says."""

    start: jax.Array
    fault: str = struct.field(pytree_node=False)
    actions = ("one", "two")

    @property
    def kinds(self):
        return self.actions[: 1 if self.fault == "kinds" else 2]

    def reset(self, case):
        return Count(case + self.start)

    def step(self, state, action):
        if self.fault == "traced" and action > 0:
            return state, None
        tokens = jnp.ones((3, 2), jnp.int32 if self.fault == "outcome.tokens" else jnp.float32)
        exists = jnp.ones(2 if self.fault == "outcome.exists" else 3, bool)
        seconds = jnp.ones(1 if self.fault == "outcome.seconds" else ())
        if self.fault == "pure":  # a step would trace it once: every contact of a run would take that time
            seconds = seconds * np.random.default_rng().random()
        after = Count(jnp.ones(2) if self.fault == "state" else state.touches + 1.0)
        outcome = Outcome(tokens, exists, seconds, jnp.zeros(()))
        return after, tuple(outcome) if self.fault == "Outcome" else outcome


FAULTS = ("kinds", "traced", "outcome.tokens", "outcome.exists", "outcome.seconds", "state", "Outcome", "pure")


@pytest.mark.parametrize("fault", FAULTS)
def test_the_check_tries_any_environment(fault):
    check_environment(Faulty(jnp.zeros(()), "none"), jnp.zeros(2), budget=2)
    with pytest.raises(EnvironmentCheckError, match=fault):
        check_environment(Faulty(jnp.zeros(()), fault), jnp.zeros(2), budget=2)
