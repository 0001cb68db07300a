"""The strict rewards of the stable preset by hand, and the adversary that searches for answers without touch."""

import numpy as np
import pytest

from tests.touchr1_jax.rewards.examples import constant, make_parsed, make_target
from touchr1_jax.rewards import make_rewards, stable_weights
from touchr1_jax.rewards.__main__ import PUBLISHED
from touchr1_jax.rewards.adversary import HONEST, AnswerProgram, earnings, programs, with_prior

PRIOR = np.array([[0.5, 0.3, 0.2] + [0] * 6, [1 / 3] * 3 + [0] * 6, [1 / 9] * 9])
REWARDS = make_rewards(PRIOR)
PRIORS = [(1 / 3, 1 / 3, 1 / 3), (0.5, 0.3, 0.2), (0.2, 0.6, 0.2), (0.1, 0.1, 0.8), (0.45, 0.1, 0.45)]


def value(name: str, parsed, label: int) -> float:
    return float(REWARDS[name].value(parsed, make_target(label=(label, 0, 0))))


def test_accuracy_by_hand():
    """Constants earn .62, .58 and .32 on these labels, .5067 on average."""
    mean = (0.62 + 0.58 + 0.32) / 3
    assert value("accuracy_strict", constant(0), 0) == pytest.approx(1 - 0.62 + mean)
    assert value("accuracy_strict", constant(0), 2) == pytest.approx(-0.62 + mean)
    assert value("accuracy_strict", make_parsed(), 0) == pytest.approx(-0.1 - 0.62 + mean)
    assert value("accuracy_strict", constant(0).replace(formatted=False), 0) == pytest.approx(-0.1 - 0.62 + mean)
    assert value("accuracy_strict", constant(0), -1) == 0


@pytest.mark.parametrize(
    ("perceive", "compare", "conclude", "label", "earned"),
    [
        ((0, 0, 0), 0, 0, 0, 0.5),
        ((0, 1, 0), 0, 0, 0, 0.5 * 5 / 6),
        ((0, 0, 0), 0, 0, 1, -0.5),
        ((0, 0, 0), 0, 2, 2, 0),
        ((2, 2, 2), 2, 2, 2, 0.8),
        ((0, 0, 0), 0, -1, 0, -0.5),
        ((-1, 0, 0), 0, 0, 0, 0),
        ((0, 0, 0), 0, 0, -1, 0),
    ],
)
def test_consistency_by_hand(perceive, compare, conclude, label, earned):
    parsed = make_parsed(conclude=(conclude, 0, 0), compare=(compare, 0, 0), perceive=perceive)
    assert value("consistency_strict", parsed, label) == pytest.approx(earned)


@pytest.mark.parametrize(("formatted", "conclude", "earned"), [(True, 1, 1), (True, -1, 0), (False, 1, 0)])
def test_a_format_without_an_answer_earns_nothing(formatted, conclude, earned):
    assert value("format_strict", make_parsed((conclude, 0, 0), formatted=formatted), 0) == earned


@pytest.mark.long
@pytest.mark.parametrize("prior", PRIORS)
def test_an_honest_miss_earns_more_than_any_answer_that_cannot_be_read(prior):
    rewards, weights = make_rewards(with_prior(prior)), stable_weights(PUBLISHED)
    table = earnings(rewards, weights, prior).table
    every = [*programs(), HONEST]
    reads = lambda p: p.layout == "in order" and p.conclude not in ("nothing", "all levels")
    unread = [not reads(program) for program in every]
    assert table[unread].max() < table[np.logical_not(unread)].min()


@pytest.mark.parametrize("prior", PRIORS)
def test_no_program_beats_the_honest_one_under_the_stable_rewards(prior):
    rewards, weights = make_rewards(with_prior(prior)), stable_weights(PUBLISHED)
    assert earnings(rewards, weights, prior).better() == []


def test_the_adversary_finds_the_known_ways_around_the_published_rewards():
    """Among them: a constant, an echo with a list of all levels, agreement that the conclusion contradicts."""
    found = {
        weights: dict(earnings(REWARDS_UNIFORM, names, PRIORS[0]).better())
        for weights, names in {"paper": PUBLISHED, "gated": GATED}.items()
    }
    firm = AnswerProgram("in order", ("firm", "firm"), "firm", "firm")
    contradicted = AnswerProgram("in order", ("soft", "soft"), "soft", "touch")
    nested = AnswerProgram("nested", ("firm", "firm"), "firm", "firm")
    assert found["paper"][firm] == pytest.approx(0.6 * 0.6 + 0.3 + 0.1 - 0.604, abs=1e-3)
    assert {contradicted, nested} <= set(found["paper"])
    assert found["gated"][contradicted] == pytest.approx(0.048, abs=1e-3)


GATED = {"accuracy_debiased": 0.6, "consistency_gated": 0.3, "format": 0.1}
REWARDS_UNIFORM = make_rewards(with_prior(PRIORS[0]))


@pytest.mark.parametrize("seed", range(5))
def test_expected_earnings_agree_with_drawing(seed):
    rng = np.random.default_rng(seed)
    found = earnings(REWARDS_UNIFORM, PUBLISHED, PRIORS[0])
    which, n = rng.integers(len(found.table)), 40_000
    label = rng.integers(0, 3, n)
    wrong = (label[:, None] + rng.integers(1, 3, (n, 3))) % 3
    reading = np.where(rng.random((n, 3)) < 0.4, label[:, None], wrong)
    drawn = found.table[which, reading @ [9, 3, 1], label]
    assert drawn.mean() == pytest.approx(found.expected()[which], abs=0.01)


def test_published_rewards_are_replaced_and_others_stay():
    assert stable_weights({"accuracy": 0.6, "format": 0.1, "overlong": 0.2}) == {
        "accuracy_strict": 0.6,
        "format_strict": 0.1,
        "overlong": 0.2,
    }
