"""Differences of rungs by hand values, and what is said about signs."""

import dataclasses

import numpy as np
import pytest

from experiments.paper.deltas import FOUR, MEASURES, Step, deltas, pooled
from experiments.paper.diagnosis import Case, course_of, diagnose
from experiments.paper.ladder_arms import FULL, LADDER, NO_SFT, OMISSIONS, arms, omitted
from experiments.paper.ladder_tables import delta_table
from experiments.paper.outcome import find, phrase
from touchr1_jax.bench.metrics import Scores
from touchr1_jax.rewards import make_rewards, uniform_prior

STEP = Step(arm="b", against="a", adds="it", published=(-0.1, 5.0, 2.0))
OBJECTS = np.repeat(np.arange(20), 2)


def scores(values) -> Scores:
    values = np.broadcast_to(np.asarray(values, float), 40)
    return Scores(values=values, items=np.arange(40), strata=np.zeros(40, int))


def rows(a, b):
    """Two arms in all three measures, one value a seed."""
    row = lambda seeds: [{m.metric: scores(x) for m in MEASURES} for x in seeds]
    return {"a": row(a), "b": row(b)}


def test_a_step_is_the_mean_difference_of_paired_seeds():
    omae, csc, four = deltas([STEP], rows([1.0, 2.0, 3.0], [0.9, 2.1, 3.3]), OBJECTS)
    assert omae.seeds.mean == pytest.approx(0.1)
    assert omae.seeds.high - omae.seeds.mean == pytest.approx(4.302653 * 0.2 / np.sqrt(3), rel=1e-5)
    assert (omae.published, csc.published, four.published) == (-0.1, 5.0, 2.0)
    assert (omae.measure.metric, csc.measure.metric, four.measure.metric) == ("omae", "csc", FOUR)


def test_signs_need_an_interval_without_zero():
    sign = lambda a, b: [d.sign for d in deltas([STEP], rows(a, b), OBJECTS)]
    assert sign([1.0, 2.0, 3.0], [1.1, 2.1, 3.11]) == ["opposite", "reproduced", "reproduced"]
    assert sign([1.0, 2.0, 3.0], [0.9, 1.9, 2.91]) == ["reproduced", "opposite", "opposite"]
    assert sign([1.0, 2.0, 3.0], [0.9, 2.1, 3.3]) == ["undecided"] * 3
    bare = dataclasses.replace(STEP, published=None)
    assert [d.sign for d in deltas([bare], rows([1.0, 2.0], [2.0, 3.1]), OBJECTS)] == ["not in the paper"] * 3


def test_p_values_are_corrected_over_the_table():
    three = [1.0, 2.0, 3.0]
    found = deltas([STEP], rows(three, [1.1, 2.1, 3.2]), OBJECTS)
    assert [d.p_seeds for d in found] == [0.75] * 3  # .25 is the least of three seeds; three measures
    assert all(d.p_objects < 0.01 for d in found)


def test_a_baseline_of_one_seed_stands_against_every_seed():
    found = deltas([STEP], rows([1.0], [2.0, 3.0]), OBJECTS)
    assert found[0].seeds.mean == pytest.approx(1.5)
    with pytest.raises(ValueError, match="b and a have 2 and 3 seeds"):
        deltas([STEP], rows([1.0, 1.0, 1.0], [2.0, 3.0]), OBJECTS)


def test_measures_that_an_arm_lacks_are_left_out():
    table = rows([1.0, 2.0], [2.0, 3.0])
    table["a"] = [{m: s for m, s in seed.items() if m != "csc"} for seed in table["a"]]
    assert [d.measure.metric for d in deltas([STEP], table, OBJECTS)] == ["omae", FOUR]


def test_pooling_means_over_seeds_question_by_question():
    a, b = scores(np.arange(40)), scores(np.arange(40) + 2.0)
    assert np.array_equal(pooled([a, b]).values, np.arange(40) + 1.0)


def test_a_table_shows_what_the_paper_prints_and_what_was_found():
    found = deltas([STEP], rows([1.0, 2.0, 3.0], [0.9, 1.9, 2.91]), OBJECTS)
    table = delta_table(found, {found[1]: ("F2: slots echo",)}, "T", "")
    assert [row[0] for row in table.rows] == ["it: OMAE", "it: CSC", "it: Avg"]
    assert table.rows[0][1] == "−0.097"
    assert table.rows[1][6:] == ("+5.0", "opposite", "F2: slots echo")
    assert "OMAE −0.097" in phrase(found[0])
    assert find(found, "b", "csc") is found[1]
    assert find(found, "c", "csc") is None


def test_every_rung_stands_on_the_one_below_and_pays_with_known_rewards():
    weights, algorithms = arms()
    known = make_rewards(uniform_prior([3, 3, 3, 9]))
    assert list(weights) == [r.name for r in LADDER[2:]] == list(algorithms)
    assert all(name in known for of in weights.values() for name in of)
    assert [r.published is None for r in LADDER] == [False] * 7 + [True]
    left, _ = omitted()
    assert [FULL, *(o.name for o in OMISSIONS if o.name != NO_SFT)] == list(left)


def lines(arm: str, seed: int, alarm: bool = False, **metrics):
    """A course that goes from its first value to its last in thirty steps."""
    for step in range(30):
        row = {name: a if step < 10 else b for name, (a, b) in metrics.items()}
        yield {"stage": f"grpo/{arm}/{seed}", "step": step, **row} | ({"alarm_F9": 0.1} if alarm and step == 20 else {})


def test_a_course_is_its_beginning_and_its_end():
    rows = [
        *lines("b", 0, entropy=(0.8, 0.2)),
        *lines("b", 1, True, entropy=(0.6, 0.2)),
        *lines("c", 0, entropy=(0, 1)),
    ]
    course = course_of(rows, "b")
    assert course.start == pytest.approx({"entropy": 0.7})
    assert course.end == pytest.approx({"entropy": 0.2})
    assert course.alarms == {"F9": 0.5}
    assert course_of(rows, "sft") is None


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
    case = Case(course=None, after={**QUIET, **after}, before=QUIET, consistency=consistency)
    (found,) = diagnose(case)
    assert found.startswith(f"{code}: ")


def test_failures_show_in_training():
    rows = [*lines("b", 0, entropy=(0.8, 0.1), degenerate_share=(0.1, 0.9))]
    found = diagnose(Case(course=course_of(rows, "b"), after=QUIET, before=QUIET))
    assert [text.split(":")[0] for text in found] == ["F7", "F9"]
    assert "90 %" in found[0]
    assert diagnose(Case(course=None, after=QUIET, before=QUIET)) == ()
    struck = course_of([*lines("b", 0, True, entropy=(0.8, 0.7))], "b")
    assert diagnose(Case(course=struck, after=QUIET, before=QUIET))[0].startswith("F9: ")
