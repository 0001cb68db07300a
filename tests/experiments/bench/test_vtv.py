"""The nine tasks of VTV150K: who knows everything is right, who knows nothing is at chance, exactly."""

import numpy as np
import pytest

from experiments.bench import vtv
from experiments.bench.vtv import ASSIGNMENTS, ATTRIBUTES, CHANCE, averaged, draw_tasks, prior_log_probs, score
from experiments.bench.vtv_report import MEANINGS, tasks_table, vtv_chart, vtv_table
from touchr1_jax.bench.averages import VTV, vtv_average

N = 60
LABEL = np.random.default_rng(3).integers(0, 3, (N, 4))
OBJECTS = np.arange(N)


@pytest.fixture(scope="module")
def tasks():
    return draw_tasks(LABEL, 240, seed=1)


def certain(label: np.ndarray) -> np.ndarray:
    return np.log(np.where(label[..., None] == np.arange(3), 0.98, 0.01))


def test_who_knows_the_levels_is_always_right(tasks):
    assert {name: s.mean() for name, s in score(tasks, certain(LABEL)).items()} == dict.fromkeys(VTV, 100)


def test_who_knows_the_opposite_is_wrong_in_every_comparison(tasks):
    wrong = {name: s.mean() for name, s in score(tasks, certain(2 - LABEL)).items()}
    assert (wrong["sfd"], wrong["soi"], wrong["combined"]) == (0, 0, 100 * float((LABEL == 1).all(1).mean()))


def test_who_feels_nothing_is_at_chance_exactly(tasks):
    blind = score(tasks, prior_log_probs(LABEL))
    for task in ("sfd", "soi", "osc", "tsa"):
        assert blind[task].mean() == pytest.approx(CHANCE[task])
    for a, name in enumerate(ATTRIBUTES):
        assert blind[name].mean() == pytest.approx(100 * np.bincount(LABEL[:, a]).max() / N)


def test_questions_are_about_what_differs(tasks):
    first, second = (LABEL[tasks.pairs[:, i], tasks.pair_of] for i in (0, 1))
    assert (first != second).all()
    assert np.array_equal(tasks.pairs[::2], tasks.pairs[1::2, ::-1])
    three = LABEL[tasks.threes, tasks.three_of[:, None]]
    assert np.array_equal(np.sort(three, 1), np.tile([0, 1, 2], (240, 1)))
    for a in range(4):
        assert set(tasks.most[tasks.three_of == a]) == {True, False}
    rows = LABEL[tasks.names]
    assert all(len(np.unique(r, axis=0)) == 3 for r in rows)


def test_recordings_are_matched_to_names_by_hand():
    label = np.array([[0, 0, 0, 0], [1, 1, 1, 1], [2, 2, 2, 2]])
    for k, given in enumerate(ASSIGNMENTS):
        one = np.zeros((1, 2), int)
        tasks = vtv.VTVTasks(
            label=label, pairs=one, pair_of=one[0, :1], threes=np.zeros((1, 3), int), three_of=one[0, :1],
            most=np.array([True]), names=np.array([[0, 1, 2]]), shown=np.array([k]), fits=one, scenario=one[0, :1],
        )  # fmt: skip
        assert score(tasks, certain(label))["osc"].mean() == 100
        assert vtv._matched(certain(label), tasks).tolist() == [k]
        assert given == ASSIGNMENTS[k]


@pytest.mark.parametrize(
    ("label", "count", "message"),
    [
        (LABEL, 100, "multiple of 24"),
        (np.zeros((9, 4), int), 24, "lacks levels"),
    ],
)
def test_questions_that_cannot_be_drawn(label, count, message):
    with pytest.raises(ValueError, match=message):
        draw_tasks(label, count, seed=0)


def test_the_average_is_that_of_the_tasks_and_has_an_interval(tasks):
    rows = {"knows": averaged(score(tasks, certain(LABEL)), OBJECTS),
            "guesses": averaged(score(tasks, prior_log_probs(LABEL)), OBJECTS)}  # fmt: skip
    span = rows["guesses"]["average"]
    assert span.mean == pytest.approx(vtv_average({t: rows["guesses"][t].mean for t in VTV}))
    assert span.low < span.mean < span.high
    assert rows["knows"]["average"].low == 100
    table = vtv_table(rows)
    assert table.rows[2][0] == "guessing"
    assert table.rows[2][10] == pytest.approx(31.6, abs=0.05)
    assert table.rows[-1][1] == 78.6
    assert len(tasks_table(dict.fromkeys(VTV, 240), dict.fromkeys(VTV, 1.0)).rows) == len(MEANINGS) == 9
    assert vtv_chart(rows, "knows", ("guesses",)).startswith(b"<?xml")
