"""Failures are judged by their numbers, and the experiment runs shrunken."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.engine import stability_grpo
from experiments.engine.failures import PAPER, SCENARIOS, STABLE, VariantRun
from experiments.engine.outcomes import ScenarioOutcome, VariantOutcome
from experiments.engine.stability_runs import FirstAlarm, alarms_of, refused
from experiments.engine.stability_tables import alarm_table, criteria, requirements, summary, verdict
from tests.experiments.shrunk import run_shrunk
from tests.touchr1_jax.rl.test_alarms import HEALTHY
from touchr1_jax.rl.alarms import WINDOW

TINY = dataclasses.replace(stability_grpo.SMOKE, codes=("F3",), margins=(0.13,))


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return run_shrunk(stability_grpo, TINY, tmp_path_factory.mktemp("runs"))


@pytest.mark.slow
def test_both_sides_of_every_value_are_reported(directory):
    results = read_json(directory / "results.json")
    (counts,) = results["data"]["failed"].values()
    assert {len(c) for c in counts.values()} == {TINY.most_values}
    names = [r["name"] for r in results["requirements"]]
    assert names[0] == "F3 grounding without bound: failed runs of stable"
    assert "other runs whose alarm fired" in names
    assert (directory / "plots" / "stability_grpo.svg").exists()


@pytest.mark.slow
def test_the_odds_of_the_tactile_reward_are_printed(directory):
    tables = {t["title"]: t for t in read_json(directory / "results.json")["tables"]}
    ((margin, false_credit, power),) = tables["The tactile-use reward by chance"]["rows"]
    assert margin == pytest.approx(0.13)
    assert false_credit == pytest.approx(0.086, abs=0.002)
    assert power == pytest.approx(0.5115, abs=0.002)


def exam(**figures: float) -> dict[str, np.ndarray]:
    """An examination of two seeds: a sound one, and one with these figures."""
    sound = {
        "accuracy": 0.8,
        "middle": 0.33,
        "echo_share": 0.7,
        "slots_right": 0.75,
        "grounding": 0.2,
        "grounding_0": 0.2,
        "grounding_1": 0.2,
        "entropy": 0.1,
        "kl": 0.1,
        "gamed_share": 0.05,
        "accuracy_swap": 0.4,
        "shuffled": 1.0,
    }
    return {name: np.array([value, figures.get(name, value)]) for name, value in sound.items()}


def course(late: dict[str, float] | None = None, **figures: float) -> VariantRun:
    metrics = {
        "degenerate_share": 0.3,
        "tactile_credit_share": 0.05,
        "bonus_cancelled_share": 0.0,
        "bonus_telling_share": 0.3,
    }
    rows = {n: np.stack([np.full(50, v), np.full(50, (late or {}).get(n, v))]) for n, v in metrics.items()}
    before = exam()
    before["accuracy"] -= 0.15
    return VariantRun(before=before, after=exam(**figures), metrics=rows)


FAILED = {
    "F1 answers drift to the middle level": course(middle=0.6),
    "F2 slots echo each other": course(echo_share=1.0, slots_right=0.5),
    "F3 grounding without bound": course(grounding=2.0, accuracy=0.5),
    "F4 noise is detected, touch is not read": course(grounding=0.5, accuracy_swap=0.8),
    "F5 the tactile bonus cancels": course({"bonus_cancelled_share": 0.2}),
    "F6 tactile credit by chance": course({"tactile_credit_share": 0.3}),
    "F7 groups that teach nothing": course({"degenerate_share": 0.9}, accuracy=0.55),
    "F8 the KL estimate does not hold": course(kl=1.5),
    "F9 entropy blows up": course(entropy=0.9, accuracy=0.5),
    "F9 long steps end in one answer": course(accuracy=0.5),
    "F10 a stream that never arrives": course(grounding_1=0.0),
    "F12 time ids stand still": course(shuffled=0.0),
    "F13 the parser is gamed": course(gamed_share=0.9),
}


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: f"{s.code} {s.title}")
def test_each_failure_is_judged_by_its_own_number(scenario):
    failed = {name: scenario.failed(c).tolist() for name, c in FAILED.items()}
    name = f"{scenario.code} {scenario.title}"
    assert failed[name] == [False, True]
    assert not any(f[0] for f in failed.values())


def test_a_course_that_the_engine_refuses_has_not_failed():
    (scenario,) = (s for s in SCENARIOS if s.code == "F10")
    broken = dataclasses.replace(course(), before=exam(grounding_1=0.0), after=exam(grounding_1=0.0))
    assert refused(broken)
    assert not refused(course())
    assert scenario.failed(broken).tolist() == [False, True]
    assert not scenario.failed(dataclasses.replace(broken, refused=True)).any()


def side(failed: list[int], fired: list[int]) -> VariantOutcome:
    """Ten seeds at each value, of which the first so many failed, and the first so many raised F1 after step 30."""
    raised = [
        [{"F1": FirstAlarm(30, 0.4)} if seed < n else {"F7": FirstAlarm(20, 0.9)} for seed in range(10)] for n in fired
    ]
    return VariantOutcome(failed=np.array([np.arange(10) < n for n in failed]), raised=raised)


OUTCOME = ScenarioOutcome(
    scenario=SCENARIOS[0], values=(1.0, 2.0, 3.0), failing=side([0, 1, 6], [1, 0, 6]), cure=side([0, 0, 1], [0, 0, 0])
)


def test_breakdown_points_and_alarm_shares_by_hand():
    assert OUTCOME.failing.breaks_at(OUTCOME.values) == 2.0
    assert OUTCOME.failing.breaks_at(OUTCOME.values, 0.5) == 3.0
    assert OUTCOME.cure.breaks_at(OUTCOME.values) == 3.0
    assert OUTCOME.cure.breaks_at(OUTCOME.values, 0.5) is None
    assert (OUTCOME.harmed, OUTCOME.compared) == (1, 20)
    assert OUTCOME.power == pytest.approx(6 / 8)
    assert OUTCOME.false_alarms == pytest.approx(1 / 52)


def test_tables_and_sentences_say_what_was_counted():
    assert summary([OUTCOME]).rows[0][2:] == (2.0, 3.0, 3.0, 1, 20, 0.75, pytest.approx(1 / 52))
    assert criteria([OUTCOME]).rows[0][2:] == tuple(
        row.replace(":", ":\N{NO-BREAK SPACE}") for row in ("1:0 · 2:1 · 3:6", "1:0 · 2:0 · 3:1")
    )
    assert alarm_table([OUTCOME]).rows[0][1:] == ("F1 > 0.25", 8, 6, 0.4, 30.0, 52, 1)
    assert OUTCOME.sentence.endswith("noise of touch σ, levels: paper breaks at 2, stable at 3")
    met = {r.name: r.met for r in requirements([OUTCOME])}
    assert not met["failed runs whose alarm fired"]
    assert met["other runs whose alarm fired"]
    said = verdict([OUTCOME], {"paper": [{}] * 10, "stable": [{"F7": FirstAlarm(20, 0.9)}, {}]})
    assert said[1] == "It failed too in F1 answers drift to the middle level (1 of 20 runs)."
    assert said[2] == "Alarms fired in 75% of 8 failed runs and in 1.9% of the 52 others."
    assert said[3] == "Failed in silence: F1 answers drift to the middle level (2)."
    assert said[4].endswith("paper: none in 10 seeds; stable: F7 in 1 of 2 seeds.")


def test_alarms_are_those_of_the_training_log():
    steps = 2 * WINDOW
    calm = {name: np.full((1, steps), value) for name, value in HEALTHY.items()}
    rows = VariantRun(before={}, after={}, metrics={**calm, "reward": np.zeros((1, steps))})
    assert alarms_of(rows, 0) == {}
    grown = np.where(np.arange(steps) < WINDOW, 0.1, 5.0)[None]
    alarms = alarms_of(dataclasses.replace(rows, metrics={**rows.metrics, "grounding": grown}), 0)
    assert set(alarms) == {"F3"}
    assert alarms["F3"].value > 1
    assert alarms["F3"].step >= WINDOW


def test_the_knobs_turn_what_they_say():
    for scenario in SCENARIOS:
        for variant in (scenario.failing, STABLE):
            places = {scenario.place(variant, v) for v in scenario.values}
            assert len(places) == len(scenario.values) or scenario.code in ("F12", "F13")
    assert SCENARIOS[2].place(PAPER, 0.16)[1].gamma == 0.16
