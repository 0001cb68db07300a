"""Slopes over sizes by hand."""

import numpy as np
import pytest

from experiments.core.results import Estimate
from experiments.paper.growth import beside_sizes, growth_table, growths
from experiments.paper.sizes import Cost, grpo_step_s
from tests.experiments import tiny

COSTS = {
    name: Cost(parameters=n, sft_s=0.1, grpo_s=0.2, question_s=0.01)
    for name, n in (("small", 100), ("default", 200), ("large", 400))
}


def estimate(*per_seed: float) -> Estimate:
    mean = float(np.mean(per_seed))
    return Estimate(mean=mean, ci95=(mean - 1, mean + 1), per_seed=per_seed)


def rows(metric: str, *values: tuple[float, ...]) -> dict:
    return {"full model": {name: {metric: estimate(*v)} for name, v in zip(COSTS, values, strict=True)}}


def test_a_straight_line_has_its_slope_in_every_seed():
    (found,) = growths(rows("acc", (50.0, 60.0), (53.0, 63.0), (56.0, 66.0)), COSTS, ("acc",))
    assert found.slope.mean == pytest.approx(3)
    assert (found.slope.low, found.slope.high) == pytest.approx((3, 3))
    assert found.sign == "better"


def test_less_error_is_better_and_scatter_is_undecided():
    (fewer,) = growths(rows("omae", (0.9, 0.8), (0.8, 0.7), (0.7, 0.6)), COSTS, ("omae",))
    assert fewer.sign == "better"
    (scattered,) = growths(rows("acc", (50.0, 60.0), (53.0, 55.0), (56.0, 51.0)), COSTS, ("acc",))
    assert scattered.sign == "undecided"
    (worse,) = growths(rows("acc", (60.0, 60.0), (55.0, 55.1), (50.0, 50.0)), COSTS, ("acc",))
    assert worse.sign == "worse"
    assert "worse" in growth_table([worse]).rows[0]


def test_a_metric_that_a_size_lacks_is_left_out():
    table = rows("acc", (50.0, 60.0), (53.0, 63.0), (56.0, 66.0))
    table["full model"]["large"] = {"omae": estimate(0.5, 0.5)}
    assert growths(table, COSTS, ("acc", "omae")) == ()


def test_the_paper_prints_one_of_its_sizes():
    table = beside_sizes({"small": {"omae": estimate(0.5)}})
    assert [row[0] for row in table.rows] == ["small", *(f"Touch-R1-{n}B (paper)" for n in (3, 7, 14))]
    assert table.rows[2][5] == 0.24
    assert set(table.rows[1][1:]) == {None}


def test_seconds_of_steps():
    timing = {"in steps/grpo/full/0": 3.0, "in steps/grpo/full/1": 5.0, "in steps/sft/0": 9.0, "grpo/full/0": 7.0}
    assert grpo_step_s(tiny.STUDY, timing) == pytest.approx(8 / (2 * (tiny.STUDY.grpo_steps - 1)))
    config = tiny.STUDY
    assert COSTS["small"].training_s(config) == pytest.approx(0.1 * config.sft.steps + 0.2 * config.grpo_steps)
