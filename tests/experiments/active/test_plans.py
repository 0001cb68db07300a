"""Controls by rule: what they choose, what it costs, how they are compared at equal seconds."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.active.arms import as_json, at_seconds, counted, from_json
from experiments.active.contacts import ContactsConfig
from experiments.active.findings import scores_of
from experiments.active.headroom import Beliefs
from experiments.active.plans import (
    Played,
    at_random,
    look_up,
    play,
    same_for_all,
    same_for_question,
    until_sure,
)
from experiments.active.report import found_motion, motion_accuracy
from touchr1_jax.rl.environment import TouchBank, TouchChoice
from touchr1_jax.training.exploration import NO_CHOICE

CHOICES = [TouchChoice(sensor="tac3d", motion=m, force_n=2.0) for m in ("press", "slide_x", "hold")]
LABEL = np.array([[0, 2], [1, 1], [2, 0], [0, 1]])
BANK = TouchBank(
    tokens=jnp.zeros((4, 3, 1, 2)),
    available=jnp.ones((4, 3), bool),
    seconds=jnp.broadcast_to(jnp.array([1.0, 2.0, 4.0]), (4, 3)),
    harm=jnp.array([[0.0, 1, 0], [0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    label=jnp.asarray(LABEL),
    choices=tuple(CHOICES),
)
EVERY = np.arange(4)


def knowing(objects, questions, choices):
    """Beliefs of a policy that is sure of the level after choice 1 for question 0, or choice 2 for question 1."""
    shown = (choices == 1 + questions[:, None]).any(1)
    true = np.eye(3)[LABEL[objects, questions]]
    return np.log(np.where(shown[:, None], 0.9 * true + 0.03, [[0.34, 0.33, 0.33]]))


def beliefs():
    o, c, a = (x.ravel() for x in np.meshgrid(EVERY, range(3), range(2), indexing="ij"))
    return Beliefs(knowing(o, a, c[:, None]).reshape(4, 3, 2, 3), LABEL)


def test_a_plan_pays_for_what_it_chooses_and_answers_what_it_believes():
    played = play(BANK, EVERY, same_for_question([(1,), (2,)], 4), knowing)
    np.testing.assert_array_equal(played.right, np.ones((4, 2)))
    np.testing.assert_array_equal(played.seconds, [[2, 4]] * 4)
    np.testing.assert_array_equal(played.harm, [[1, 0], [0, 0], [0, 1], [1, 0]])
    stopped = play(BANK, EVERY, np.full((4, 2, 1), NO_CHOICE), knowing)
    assert stopped.contacts.sum() == stopped.seconds.sum() == 0
    np.testing.assert_array_equal(stopped.right, LABEL == 0)


def test_look_ups_find_the_choice_that_shows_each_question():
    look = look_up(BANK, beliefs(), 2, 3)
    assert look.by_question[1] == [(1,), (2,)]
    assert look.press[1] == (0,)
    assert sorted(look.fixed[2]) == [1, 2]
    assert [order[0] for order in look.order] == [1, 2]


@pytest.mark.parametrize(("threshold", "contacts"), [(0.5, 1), (0.95, 2)])
def test_a_look_up_with_a_threshold_stops_when_it_is_sure(threshold, contacts):
    chosen = until_sure(EVERY, [(1, 0), (2, 0)], 2, threshold, knowing)
    assert ((chosen != NO_CHOICE).sum(-1) == contacts).all()
    np.testing.assert_array_equal(chosen[..., 0], [[1, 2]] * 4)


def test_random_choices_are_different():
    drawn = at_random((4, 2, 3), 2, np.random.default_rng(0))
    assert set(drawn.ravel()) == {0, 1, 2}
    assert (drawn[..., 0] != drawn[..., 1]).all()


def test_plans_are_mixed_to_equal_seconds():
    made = {"no_touch": np.full((4, 2, 1), NO_CHOICE)}
    made |= {counted("fixed", k): same_for_all((1, 2)[:k], 4, 2) for k in (1, 2)}
    found = {name: play(BANK, EVERY, choices, knowing) for name, choices in made.items()}
    np.testing.assert_array_equal(at_seconds(found, "fixed", 2.0, 2), found["fixed"].right)
    np.testing.assert_allclose(at_seconds(found, "fixed", 4.0, 2), (found["fixed"].right + found["fixed_2"].right) / 2)
    np.testing.assert_array_equal(at_seconds(found, "fixed", 99.0, 2), found["fixed_2"].right)
    np.testing.assert_array_equal(at_seconds(found, "fixed", 0.0, 2), found["no_touch"].right)


def test_what_was_played_survives_as_json():
    played = {"one": play(BANK, EVERY, same_for_all((2, 0), 4, 2), knowing)}
    again = from_json(as_json(played))["one"]
    for field in dataclasses.fields(Played):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(played["one"], field.name))
    assert scores_of(again).mean() == pytest.approx(100 * again.right.mean())


def test_a_first_motion_is_judged_by_the_probes_interval():
    setup = ContactsConfig(objects=4, motions=("press", "slide_x", "hold"), forces_n=(2.0,), sensors=("tac3d",))
    np.testing.assert_array_equal(motion_accuracy(setup, beliefs(), 0), [0.5, 1, 0.5])
    assert found_motion(setup, np.array([1, 1, 0]), beliefs(), 0)
    assert not found_motion(setup, np.array([1, 0, 0]), beliefs(), 0)
    assert not found_motion(setup, np.array([NO_CHOICE]), beliefs(), 0)
