"""The experiment on active touch, shrunk: contacts of two objects a part, every plan and policy, every table."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.active import active_touch, stability_touch
from experiments.active.active_touch import ActiveTouchConfig
from experiments.active.findings import METRIC, verdict
from experiments.core.artifacts import read_json
from tests.experiments.shrunk import run_shrunk

TINY = dataclasses.replace(
    active_touch.SMOKE,
    world=dataclasses.replace(
        active_touch.SMOKE.world, contacts=dataclasses.replace(active_touch.SMOKE.world.contacts, objects=20)
    ),
    learner=dataclasses.replace(active_touch.SMOKE.learner, steps=2),
)


@pytest.mark.slow  # generates contacts and compiles the steps of two budgets
def test_a_shrunken_run_scores_every_plan_at_equal_seconds(tmp_path):
    directory = run_shrunk(active_touch, TINY, tmp_path, "--cache-dir", str(tmp_path / "cache"))
    results = read_json(directory / "results.json")
    plans = {"chosen", "chosen_2", "random", "best_press", "best_fixed", "by_question"}
    assert plans <= results["arms"].keys()
    assert {"every_touch", "imitation", "chosen_harm"} <= results["baselines"].keys()
    pairs = {(c["arm"], c["against"]) for c in results["comparisons"]}
    assert {("chosen", rule) for rule in ("random", "best_fixed", "by_question")} <= pairs
    assert {("chosen_2", f"{rule}_at_equal_seconds") for rule in ("random", "best_fixed", "by_question")} <= pairs
    charts = {"accuracy_over_seconds.svg", "first_touches.svg"}  # trajectories too, if the policy touches at all
    assert charts <= {path.name for path in (directory / "plots").iterdir()}
    headroom = [t for t in results["tables"] if t["title"].startswith("Headroom")]
    assert len(headroom) == 3  # by probes, by the warm start, and where choices drop out
    every = next(t for t in results["tables"] if t["title"] == "Plans and policies")
    seconds = {row[0]: row[5] for row in every["rows"]}
    assert seconds["random_2"] == pytest.approx(2 * seconds["random"])
    assert seconds["chosen"] <= seconds["random"] + 1e-6
    assert np.isfinite([row[1] for row in every["rows"]]).all()
    programs = next(r for r in results["requirements"] if r["name"] == "programs of the step on turns")
    assert programs["measured"] == 1
    missing = {row[0]: row for t in results["tables"] if t["title"] == "Where choices drop out" for row in t["rows"]}
    assert missing["by_question_at_equal_seconds"][5] == pytest.approx(missing["chosen_2"][5])  # seconds
    assert missing["by_question_at_equal_seconds"][4] is None  # contacts of a mixture
    agents = next(t for t in results["tables"] if t["title"] == "Agents of other libraries")
    assert agents["rows"][0][1].startswith("not run: ")
    assert {*(directory / "policies").glob("*/0")} == {
        directory / "policies" / name / "0" for name in ("chosen", "chosen_2", "chosen_harm")
    }


@pytest.mark.slow  # generates contacts and compiles a step
def test_a_shrunken_run_of_seeds_tells_their_first_motions(tmp_path):
    config = dataclasses.replace(stability_touch.SMOKE, world=TINY.world, learner=TINY.learner, seeds=1)
    directory = run_shrunk(stability_touch, config, tmp_path, "--cache-dir", str(tmp_path / "cache"))
    (table,) = read_json(directory / "results.json")["tables"]
    assert [row[0] for row in table["rows"]] == ["0"]


def test_a_seed_trains_the_priced_arms_only_where_it_is_asked_for():
    config = ActiveTouchConfig(second_prices=(0.0,), harm_price=0.7)
    assert config.arms(1).keys() == {"chosen", "chosen_3"}
    first = config.arms(0)
    assert first.keys() == {"chosen", "chosen_3", "chosen_harm", "chosen_3_at_0"}
    assert (first["chosen"].budget, first["chosen_harm"].harm, first["chosen_3_at_0"].second) == (1, 0.7, 0.0)


def test_a_warm_start_that_cannot_read_touch_concludes_nothing_about_choosing():
    plans = ("chosen", "chosen_2", "chosen_warm_answers", "by_question", "every_touch")
    estimates = {name: {METRIC: SimpleNamespace(mean=40.0)} for name in plans}
    seeds = [{"chosen_2": SimpleNamespace(contacts=np.ones(3))}]
    rules = ("random", "best_fixed", "by_question")
    pairs = [("chosen", rule) for rule in rules] + [("chosen_warm_answers", rule) for rule in rules[1:]]
    pairs += [("chosen_2", f"{rule}_at_equal_seconds") for rule in rules[1:]] + [("by_question", "no_touch")]

    def said(low):
        one = {"difference": low + 1, "low": low, "high": low + 2, "over": "objects"}
        return verdict(estimates, [SimpleNamespace(arm=a, against=b, **one) for a, b in pairs], seeds, 2)

    assert len(said(0.5)) == 3
    (only,) = said(-0.5)
    assert "+0.5" in only
