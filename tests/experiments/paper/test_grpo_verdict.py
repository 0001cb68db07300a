"""Verdicts on reinforcement, on the lengths of SFT and on sizes, by hand values."""

import types

import numpy as np
import pytest

from experiments.core.results import Comparison, Estimate
from experiments.paper.few_labels import verdict as curves_verdict
from experiments.paper.grpo_verdict import CONTINUED, GrpoVerdictConfig, algorithm_of, sure, train_policy, trained_by
from experiments.paper.model_sizes import SizeCost, grpo_step_s, size_trends
from experiments.paper.pareto_sft import PhaseResult, efficient
from tests.experiments import tiny
from touchr1_jax.rl.config import Norm


def difference(low: float, high: float, over: str, *, arm: str = "a", against: str = "b", metric: str = "acc"):
    middle = (low + high) / 2
    return Comparison(
        metric=metric,
        arm=arm,
        against=against,
        difference=middle,
        ci95=(low, high),
        over=over,
        n=5,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize(
    ("objects", "seeds", "metric", "expected"),
    [
        ((1, 2), (0.5, 3), "acc", 1),
        ((1, 2), (-0.5, 3), "acc", 0),  # beyond chance over objects alone
        ((-2, -1), (-3, -0.5), "acc", -1),
        ((-2, -1), (-3, -0.5), "omae", 1),  # a lower error is better
        ((1, 2), (0.5, 3), "omae", -1),
    ],
)
def test_a_difference_counts_beyond_both_intervals(objects, seeds, metric, expected):
    found = [difference(*objects, "objects", metric=metric), difference(*seeds, "seeds", metric=metric)]
    assert sure(found, "a", metric) == expected
    assert sure(found, "other", metric) == 0


def test_an_enumerated_preset_keeps_its_norm_and_draws_no_prompt_twice():
    assert algorithm_of("dapo", exact=False).candidates == 2
    exact = algorithm_of("dapo", exact=True)
    assert (exact.enumerated, exact.candidates, exact.clip_high) == (Norm.STD, 1, 0.28)
    assert algorithm_of("rloo", exact=True).enumerated is Norm.NONE
    assert algorithm_of("rloo", exact=False).enumerated is None


def test_the_report_names_the_algorithms_and_rates_of_the_arms():
    of_arms = "dapo, gspo, cispo, rloo with anchor=1.0, group=4, micro_prompts=8, inverse_draws=True"
    assert trained_by(GrpoVerdictConfig()) == {"preset": of_arms, "lr_scale": "100 or 400"}


def test_the_control_ends_with_its_last_checkpoint_as_the_arms_do():
    given = []
    continued = lambda config, contacts, validation, params: given.append(validation)
    started = types.SimpleNamespace(config=GrpoVerdictConfig(), train=0, held_out=1, params=2, continued=continued)
    train_policy(started, CONTINUED, {}, {})
    assert given == [None]


def test_the_verdict_of_few_labels_names_where_a_step_pays_and_where_it_costs():
    pays = difference(2, 4, "objects", arm="grpo-10-random", against="two_phases-10-random")
    costs = difference(-4, -2, "objects", arm="two_phases-30-pretrained", against="two_phases-30-random")
    sentences = curves_verdict([pays, costs], [10, 30])
    assert any("GRPO" in s and "10 labels (random encoder) +3.0" in s for s in sentences)
    assert any(s.startswith("Stage 1") and "lowers it at 30 labels −3.0" in s for s in sentences)


def result(seconds: float, accuracy: float) -> PhaseResult:
    return PhaseResult(seconds=seconds, accuracy=accuracy, material=30.0, omae=0.5)


def test_combinations_that_none_beats_by_hand():
    found = {(1, 0): result(10, 50), (1, 9): result(30, 60), (2, 0): result(20, 49), (2, 9): result(40, 60)}
    assert efficient(found) == [(1, 0), (1, 9)]


COSTS = {
    name: SizeCost(parameters=n, sft_s=0.1, grpo_s=0.2, question_s=0.01)
    for name, n in (("small", 100), ("default", 200), ("large", 400))
}


def estimate(*per_seed: float) -> Estimate:
    mean = float(np.mean(per_seed))
    return Estimate(mean=mean, ci95=(mean - 1, mean + 1), per_seed=per_seed)


def rows(metric: str, *values: tuple[float, ...]) -> dict:
    return {"full model": {name: {metric: estimate(*v)} for name, v in zip(COSTS, values, strict=True)}}


def test_a_straight_line_has_its_slope_in_every_seed():
    (found,) = size_trends(rows("acc", (50.0, 60.0), (53.0, 63.0), (56.0, 66.0)), COSTS, ("acc",))
    assert (found.slope.mean, found.slope.low, found.slope.high) == pytest.approx((3, 3, 3))


@pytest.mark.parametrize(
    ("metric", "values", "larger_is"),
    [
        ("acc", ((50.0, 60.0), (53.0, 63.0), (56.0, 66.0)), "better"),
        ("omae", ((0.9, 0.8), (0.8, 0.7), (0.7, 0.6)), "better"),
        ("acc", ((50.0, 60.0), (53.0, 55.0), (56.0, 51.0)), "undecided"),
        ("acc", ((60.0, 60.0), (55.0, 55.1), (50.0, 50.0)), "worse"),
    ],
)
def test_less_error_is_better_and_scatter_is_undecided(metric, values, larger_is):
    (found,) = size_trends(rows(metric, *values), COSTS, (metric,))
    assert found.larger_is == larger_is


def test_seconds_of_steps():
    timing = {"in steps/grpo/full/0": 3.0, "in steps/grpo/full/1": 5.0, "in steps/sft/0": 9.0, "grpo/full/0": 7.0}
    config = tiny.STUDY
    assert grpo_step_s(config, timing) == pytest.approx(8 / (2 * (config.grpo_steps - 1)))
    assert COSTS["small"].training_s(config) == pytest.approx(0.1 * config.sft.steps + 0.2 * config.grpo_steps)
