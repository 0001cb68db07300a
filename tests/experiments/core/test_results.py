"""Results refuse what must not be published; estimates agree with hand values."""

import dataclasses
import math

import numpy as np
import pytest

from experiments.core.errors import ResultsError
from experiments.core.results import Comparison, Estimate, Results
from experiments.study.estimates import compare_over_objects, compare_over_seeds, estimate
from tests.experiments.fakes import coin
from touchr1_jax.bench.metrics import accuracy, ordinal_mae

GOOD = Estimate(mean=50.0, ci95=(40.0, 60.0), per_seed=(45.0, 55.0))
SETTINGS = {"preset": "paper", "lr_scale": 100.0}
COMPARED = Comparison(metric="acc", arm="a", against="b", difference=1.0, ci95=(0.5, 1.5), over="seeds", n=2)


def results(**changes):
    arms = {"a": {"acc": GOOD}, "b": {"acc": GOOD}}
    return Results(**{"arms": arms, "baselines": {}, "settings": SETTINGS, **changes})


def changed(**changes):
    return {"a": {"acc": dataclasses.replace(GOOD, **changes)}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arms": {}, "baselines": {"constant": {}}}, "one arm"),
        ({"arms": {"a": {}}}, "one metric"),
        ({"arms": {"a": {"H_acc": GOOD}}}, "H_acc.*h_acc"),
        ({"arms": changed(ci95=(60.0, 40.0))}, "low, high"),
        ({"arms": changed(mean=math.nan)}, "finite"),
        ({"arms": changed(per_seed=(1.0, math.inf))}, "finite"),
        ({"arms": {"a": {"acc": GOOD, "omae": dataclasses.replace(GOOD, per_seed=(1.0,))}}}, "same length"),
        ({"arms": {"a": {"acc": GOOD}, "b": changed(per_seed=(1.0,))["a"]}}, "same seeds"),
        ({"baselines": {"a": {"acc": GOOD}}}, "names of arms"),
        ({"settings": {"preset": "paper"}}, "lr_scale"),
        ({"comparisons": (dataclasses.replace(COMPARED, against="c"),)}, "'c'"),
        ({"comparisons": (dataclasses.replace(COMPARED, metric="x"),)}, "'x'"),
        ({"comparisons": (dataclasses.replace(COMPARED, p_value=1.5),)}, "p_value"),
    ],
)
def test_bad_results_are_named(changes, message):
    with pytest.raises(ResultsError, match=message):
        results(**changes)


def test_results_json_has_the_agreed_shape():
    description = {
        "experiment": "coin",
        "scale": "smoke",
        "config": {"steps": 3},
        "git": {"commit": "ab", "dirty": True},
    }
    written = results(comparisons=(COMPARED,), baselines={"blind": {"acc": GOOD}}).to_json(description)
    assert written["arms"]["a"]["acc"] == {"mean": 50.0, "ci95": [40.0, 60.0], "per_seed": [45.0, 55.0]}
    assert written["git"] == "ab-dirty"
    assert {"experiment", "git", "arms", "baselines", "timing", "data", "config", "comparisons"} <= set(written)
    assert "examples" not in written


def test_slots_of_an_example_must_lie_in_its_trace_and_apart():
    with pytest.raises(ResultsError, match="slots"):
        dataclasses.replace(coin.example(), slots=((11, 21, "perceive"), (20, 24, "compare")))
    with pytest.raises(ResultsError, match=r"frames\[xense\]"):
        dataclasses.replace(coin.example(), frames={"xense": np.zeros((4, 8, 8, 3), np.float32)})


OBJECTS = np.array(["a", "a", "b"])
LABEL = np.array([0, 1, 2])


def test_estimate_averages_seeds_and_resamples_objects():
    seeds = [accuracy(LABEL, LABEL), accuracy(np.array([0, 1, 0]), LABEL)]
    made = estimate(seeds, OBJECTS)
    assert made.per_seed == (100.0, pytest.approx(200 / 3))
    assert made.mean == pytest.approx(250 / 3)
    assert made.ci95 == (50.0, 100.0)  # two objects, so the ends are theirs


def test_comparison_over_seeds_by_hand():
    a = dataclasses.replace(GOOD, per_seed=(1.0, 2.0, 3.0))
    b = dataclasses.replace(GOOD, per_seed=(0.0, 0.0, 0.0))
    made = compare_over_seeds("omae", "a", "b", a, b)
    half = 4.302653 * 1.0 / math.sqrt(3)
    assert made.difference == 2.0
    assert made.ci95 == pytest.approx((2 - half, 2 + half), rel=1e-6)
    assert (made.p_value, made.improvement, made.n) == (0.25, 0.0, 3)  # a larger OMAE is no improvement
    assert compare_over_seeds("middle_rate", "a", "b", a, b).improvement is None
    with pytest.raises(ResultsError, match="same seeds"):
        compare_over_seeds("acc", "a", "b", a, GOOD)


def test_comparison_over_objects_is_paired():
    a = [ordinal_mae(np.array([[0], [1], [0]]), LABEL[:, None], np.array([3]))]
    b = [ordinal_mae(np.array([[1], [2], [0]]), LABEL[:, None], np.array([3]))]
    made = compare_over_objects("omae", "a", "b", a, b, OBJECTS)
    assert (made.difference, made.ci95, made.n) == (pytest.approx(-2 / 3), (-1.0, 0.0), 2)
    with pytest.raises(ResultsError, match="same answers"):
        compare_over_objects("omae", "a", "b", a, [accuracy(LABEL[:2], LABEL[:2])], OBJECTS)
