"""Effects of components by hand values, agreement with the paper's signs, and the failures that a run shows."""

import collections
import dataclasses

import numpy as np
import pytest

from experiments.paper.ablation_cumulative import attribute_table
from experiments.paper.component_effects import (
    FOUR,
    LADDER_METRICS,
    ComponentComparison,
    ComponentStep,
    component_effects,
    diagnose,
    training_history,
)
from experiments.paper.components import COMPONENTS, PUBLISHED
from touchr1_jax.bench.metrics import Scores
from touchr1_jax.rewards import make_rewards, uniform_prior

STEP = ComponentStep(arm="b", against="a", component="it", published=(-0.1, 5.0, 2.0))
OBJECTS = np.repeat(np.arange(20), 2)


def scores(values) -> Scores:
    values = np.broadcast_to(np.asarray(values, float), 40)
    return Scores(values=values, items=np.arange(40), strata=np.zeros(40, int))


def rows(a, b):
    """Two arms in all metrics of the ladder, one value a seed."""
    row = lambda seeds: [{m.metric: scores(x) for m in LADDER_METRICS} for x in seeds]
    return {"a": row(a), "b": row(b)}


def effects(a, b, step=STEP):
    return component_effects([step], rows(a, b), OBJECTS)


@pytest.mark.parametrize(("recipe", "asks"), [("touch", False), ("paper", True)])
def test_the_table_of_attributes_says_what_grpo_asks_about(recipe, asks):
    assert (
        "material is asked in the evaluation alone" in attribute_table(collections.defaultdict(dict), recipe).note
    ) == asks


def test_an_effect_is_the_mean_difference_of_paired_seeds():
    omae, csc, four = found = effects([1.0, 2.0, 3.0], [0.9, 2.1, 3.3])
    assert omae.seeds.mean == pytest.approx(0.1)
    assert omae.seeds.high - omae.seeds.mean == pytest.approx(4.302653 * 0.2 / np.sqrt(3), rel=1e-5)
    assert [e.published for e in found] == [-0.1, 5.0, 2.0]
    assert [e.metric.metric for e in found] == ["omae", "csc", FOUR]
    comparison = ComponentComparison(estimates={}, effects=found, failures={})
    assert comparison.effect("b", "csc") is csc
    assert comparison.effect("c", "csc") is None
    assert four is not csc


@pytest.mark.parametrize(
    ("after", "signs"),
    [
        ([1.1, 2.1, 3.11], ["opposite", "reproduced", "reproduced"]),
        ([0.9, 1.9, 2.91], ["reproduced", "opposite", "opposite"]),
        ([0.9, 2.1, 3.3], ["undecided"] * 3),
    ],
)
def test_signs_need_an_interval_without_zero(after, signs):
    before = [1.0, 2.0, 3.0]
    assert [e.sign for e in effects(before, after)] == signs
    bare = dataclasses.replace(STEP, published=None)
    assert [e.sign for e in effects(before, after, bare)] == ["not in the paper"] * 3


def test_p_values_of_the_primary_hypotheses_are_corrected_and_can_reject_with_five_seeds():
    before, after = np.zeros(5), [-0.02, -0.03, -0.02, -0.01, -0.02]
    plain = {e.metric.metric: e.p_value for e in effects(before, after)}
    assert plain["omae"] == pytest.approx(0.0032, abs=1e-4)  # Student's t of five seeds
    steps = [dataclasses.replace(STEP, component=name) for name in ("ordinal credit", "consistency")]
    found = component_effects(steps, rows(before, after), OBJECTS)
    primary = {e.step.component: e.p_value for e in found if e.primary}
    assert primary == pytest.approx({"ordinal credit": 2 * plain["omae"], "consistency": 2 * plain["omae"]})
    assert {e.p_value for e in found if not e.primary} == {plain["omae"]}


def test_a_baseline_of_one_seed_is_compared_with_every_seed():
    assert effects([1.0], [2.0, 3.0])[0].seeds.mean == pytest.approx(1.5)
    with pytest.raises(ValueError, match="b and a have 2 and 3 seeds"):
        effects([1.0, 1.0, 1.0], [2.0, 3.0])


def test_arms_add_or_omit_one_component_and_use_known_rewards():
    """The ladder ends in the full objective, from which each omission takes one component."""
    known = make_rewards(uniform_prior([3, 3, 3, 9]))
    arms = [arm for c in COMPONENTS for arm in (c.added, c.omitted)]
    assert len({arm.name for arm in arms}) == len(arms)
    assert {term for arm in arms for term in arm.weights or ()} <= set(known)
    assert PUBLISHED == {"accuracy": 0.6, "consistency": 0.3, "format": 0.1}
    full = COMPONENTS[-1].added
    for below, component in zip((None, *COMPONENTS), COMPONENTS, strict=False):
        one, omitted = component.added, component.omitted
        if below and below.added.weights:
            assert (one.weights == below.added.weights) != (one.algorithm == below.added.algorithm)
        if omitted.name != "no_sft":
            assert (omitted.weights == full.weights) != (omitted.algorithm == full.algorithm)


def lines(arm: str, seed: int, alarm: bool = False, **metrics):
    """Thirty steps of training: each metric has its first value for ten steps, then its second."""
    for step in range(30):
        row = {name: a if step < 10 else b for name, (a, b) in metrics.items()}
        yield {"stage": f"grpo/{arm}/{seed}", "step": step, **row} | ({"alarm_F9": 0.1} if alarm and step == 20 else {})


def test_a_history_is_the_beginning_and_the_end():
    rows = [*lines("b", 0, entropy=(0.8, 0.2)), *lines("b", 1, True, entropy=(0.6, 0.2))]
    rows += lines("c", 0, entropy=(0, 1))
    history = training_history(rows, "b")
    assert history.start == pytest.approx({"entropy": 0.7})
    assert history.end == pytest.approx({"entropy": 0.2})
    assert history.alarms == {"F9": 0.5}
    assert training_history(rows, "sft") is None


QUIET = {"middle_rate": 30.0, "csc": 40.0, "csc_slot": 60.0, "parse_rate": 100.0}


@pytest.mark.parametrize(
    ("after", "consistency", "code"),
    [
        ({"middle_rate": 45.0}, False, "F1"),
        ({"middle_rate": 5.0}, True, "F2"),
        ({"middle_rate": 5.0}, False, "F9"),
        ({"csc_slot": 90.0, "csc": 41.0}, False, "F2"),
        ({"parse_rate": 80.0}, False, "F13"),
    ],
)
def test_failures_show_on_test_questions(after, consistency, code):
    (found,) = diagnose(None, QUIET, {**QUIET, **after}, consistency=consistency)
    assert found.startswith(f"{code}: ")


def test_failures_show_in_training():
    rows = [*lines("b", 0, entropy=(0.8, 0.1), degenerate_share=(0.1, 0.9))]
    codes = lambda history: [text.split(":")[0] for text in diagnose(history, QUIET, QUIET)]
    assert codes(training_history(rows, "b")) == ["F7", "F9"]
    assert codes(None) == []
    assert codes(training_history([*lines("b", 0, True, entropy=(0.8, 0.7))], "b")) == ["F9"]
