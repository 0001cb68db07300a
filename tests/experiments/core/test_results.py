"""Results refuse what must not be published, and say whether bounds are kept."""

import dataclasses
import math

import numpy as np
import pytest

from experiments.core.errors import ResultsError
from experiments.core.results import Column, Comparison, Estimate, Picture, Requirement, Results, Table, named_table
from tests.experiments.fakes import coin

GOOD = Estimate(mean=50.0, ci95=(40.0, 60.0), per_seed=(45.0, 55.0))
SETTINGS = {"preset": "paper", "lr_scale": 100.0}
FAST = Requirement(name="frame", measured=2.0, bound=2.5, better="lower", unit="ms")
SLOW = Requirement(name="rate", measured=399.0, bound=400.0, better="higher", unit="records/s", note="one core")
CHART = Picture(name="a", title="", caption="", content=b"")
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
        ({"arms": {}}, "verdict is .*: must hold a sentence"),
        ({"requirements": (dataclasses.replace(FAST, measured=math.nan),)}, "requirement 'frame'"),
        ({"pictures": (CHART, CHART)}, "names of their own"),
    ],
)
def test_bad_results_are_named(changes, message):
    with pytest.raises(ResultsError, match=message):
        results(**changes)


@pytest.mark.parametrize(
    ("bound", "measured", "met"), [(FAST, 2.5, True), (FAST, 2.51, False), (SLOW, 399.9, False), (SLOW, 400.0, True)]
)
def test_a_bound_is_kept_on_its_own_side(bound, measured, met):
    assert dataclasses.replace(bound, measured=measured).met is met


def test_results_json_has_the_agreed_shape():
    git = {"commit": "ab", "dirty": True}
    description = {"experiment": "coin", "scale": "smoke", "config": {"steps": 3}, "git": git}
    table = named_table("Tiers", [{"tier": "spg", "ms": -2.0, "ok": True}, {"tier": "winkler", "ok": False}])
    changes = {"requirements": (FAST, SLOW), "tables": (table,), "pictures": (CHART,), "verdict": ("It is fast.",)}
    written = results(comparisons=(COMPARED,), baselines={"blind": {"acc": GOOD}}, **changes).to_json(description)
    assert written["arms"]["a"]["acc"] == {"mean": 50.0, "ci95": [40.0, 60.0], "per_seed": [45.0, 55.0]}
    assert written["git"] == "ab-dirty"
    assert [r["met"] for r in written["requirements"]] == [True, False]
    assert written["tables"][0]["rows"] == [["spg", -2.0, True], ["winkler", None, False]]
    assert {"experiment", "baselines", "timing", "data", "config", "comparisons"} <= set(written)
    assert not {"examples", "pictures"} & set(written)
    assert "arms" not in Results(**changes).to_json(description)


def test_a_table_refuses_a_missing_cell_and_the_format_of_no_column():
    with pytest.raises(ResultsError, match="must have 2 cells"):
        Table(title="t", columns=(Column(name="a"), Column(name="b")), rows=(("x",),))
    with pytest.raises(ResultsError, match="must name columns"):
        named_table("t", [{"a": 1}], formats={"b": ".1f"})


def test_slots_of_an_example_must_lie_in_its_trace_and_apart():
    with pytest.raises(ResultsError, match="slots"):
        dataclasses.replace(coin.example(), slots=((11, 21, "perceive"), (20, 24, "compare")))
    with pytest.raises(ResultsError, match=r"frames\[xense\]"):
        dataclasses.replace(coin.example(), frames={"xense": np.zeros((4, 8, 8, 3), np.float32)})
