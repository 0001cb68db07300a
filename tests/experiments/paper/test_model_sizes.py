"""Trends over sizes by hand."""

import numpy as np
import pytest

from experiments.core.results import Estimate
from experiments.paper.model_sizes import SizeCost, grpo_step_s, size_trends
from tests.experiments import tiny

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


def test_a_metric_that_a_size_lacks_is_left_out():
    table = rows("acc", (50.0, 60.0), (53.0, 63.0), (56.0, 66.0))
    table["full model"]["large"] = {"omae": estimate(0.5, 0.5)}
    assert size_trends(table, COSTS, ("acc", "omae")) == ()


def test_seconds_of_steps():
    timing = {"in steps/grpo/full/0": 3.0, "in steps/grpo/full/1": 5.0, "in steps/sft/0": 9.0, "grpo/full/0": 7.0}
    config = tiny.STUDY
    assert grpo_step_s(config, timing) == pytest.approx(8 / (2 * (config.grpo_steps - 1)))
    assert COSTS["small"].training_s(config) == pytest.approx(0.1 * config.sft.steps + 0.2 * config.grpo_steps)
