"""From answers to the table of the bench, and its averages, by hand values."""

import dataclasses
import math

import numpy as np
import pytest

from tests.touchr1_jax.bench.sample_items import items
from touchr1_jax.bench.averages import AVERAGED, VTV, touch_average, vtv_average
from touchr1_jax.bench.scoring import BENCH_METRICS, clusters, score

ASKS = tuple(i.ask for i in items())
RIGHT = {ask.id: ask.answer for ask in ASKS}


def test_who_is_right_scores_all():
    table = score(ASKS, RIGHT)
    means = {name: scores.mean() for name, scores in table.items()}
    assert means["omae"] == 0
    assert means["soi_rho"] == 1
    assert {name: value for name, value in means.items() if name not in ("omae", "soi_rho")} == dict.fromkeys(
        set(means) - {"omae", "soi_rho"}, 100.0
    )
    assert list(table) == [name for name in BENCH_METRICS if name in table]


def test_who_says_nothing_scores_nothing():
    table = score(ASKS, {name: [-1] * len(answer) for name, answer in RIGHT.items()})
    assert table["omae"].mean() == 2.0
    assert table["soi_rho"].mean() == 0.0
    assert all(scores.mean() == 0 for name, scores in table.items() if name != "omae")


def test_each_metric_reads_its_kind():
    said = RIGHT | {"h": (0,), "s": (2,), "c": (0, 1), "p1": (0,), "o": (2,), "t": (0,), "d": (1,)}
    table = {name: scores.mean() for name, scores in score(ASKS, said).items()}
    assert table["h_acc"] == 0.0
    assert table["mat_acc"] == 100.0
    assert table["omae"] == pytest.approx((2 + 1 + 0 + 1) / 4)  # h, s, and both parts of c
    assert table["l2_em"] == 0.0
    assert (table["sfd"], table["sfd_swap"]) == (50.0, 0.0)
    assert table["soi_rho"] == 0.5
    assert (table["csc"], table["csc_agree"]) == (0.0, 0.0)
    assert table["deceptive_acc"] == 0.0


def test_values_know_their_objects():
    table = score(ASKS, RIGHT)
    assert clusters(ASKS, table["sfd"]).tolist() == ["a", "a"]  # both orders of a pair are one object's
    assert clusters(ASKS, table["deceptive_acc"]).tolist() == ["c"]
    assert clusters(ASKS, table["omae"]).tolist() == ["a", "b", "a", "a"]


def test_sensors_of_different_touches_are_no_group():
    """Without a group of their own two touches would count as one, against the answer of the first."""
    one = next(ask for ask in ASKS if ask.kind == "one_sensor")
    other = dataclasses.replace(one, id="other", answer=(one.answer[0] + 1,))
    with pytest.raises(ValueError, match=f"holds {one.id!r} and 'other': must be of one touch and property"):
        score((*ASKS, other), RIGHT | {"other": other.answer})


def test_conflict_is_where_sight_is_wrong():
    sees = lambda level, said: {n: s.mean() for n, s in score(ASKS, RIGHT | {"d": (said,)}, {"d": (level,)}).items()}
    assert {"conflict_acc", "revision_rate"} & set(sees(0, 0)) == set()  # sight is right: no conflict
    assert (sees(2, 0)["conflict_acc"], sees(2, 0)["revision_rate"]) == (100.0, 100.0)
    assert (sees(2, 1)["conflict_acc"], sees(2, 1)["revision_rate"]) == (0.0, 100.0)
    assert (sees(2, 2)["conflict_acc"], sees(2, 2)["revision_rate"]) == (0.0, 0.0)
    with pytest.raises(ValueError, match="lacks 'd'"):
        score(ASKS, RIGHT, {})


def test_metrics_without_items_are_left_out():
    few = [ask for ask in ASKS if ask.kind == "scale"]
    assert list(score(few, RIGHT)) == ["omae"]
    assert score([ask for ask in ASKS if ask.id == "m"], RIGHT).keys() == {"mat_acc", "mat_bacc"}


def test_every_averaged_metric_is_scored():
    assert set(AVERAGED) <= set(BENCH_METRICS)


def test_answers_are_complete():
    with pytest.raises(ValueError, match="lacks 'h'"):
        score(ASKS, {name: answer for name, answer in RIGHT.items() if name != "h"})
    with pytest.raises(ValueError, match=r"answers\['c'\] has 1 levels"):
        score(ASKS, RIGHT | {"c": np.array([1])})


PERFECT = dict.fromkeys(AVERAGED, 100.0) | {"omae": 0.0, "soi_rho": 1.0}


def test_perfect_is_100_and_worst_is_0():
    assert touch_average(PERFECT) == 100.0
    assert touch_average(dict.fromkeys(AVERAGED, 0.0) | {"omae": 2.0, "soi_rho": -1.0}) == 0.0


def test_the_papers_columns_do_not_give_its_average():
    row = (76.8, 68.4, 65.1, 74.6, 0.24, 39.5, 78.2, 0.66, 71.3)
    ours = touch_average(dict(zip(AVERAGED, row, strict=True)))
    assert ours == pytest.approx((76.8 + 68.4 + 65.1 + 74.6 + 88 + 39.5 + 78.2 + 66 + 71.3) / 9)
    assert abs(ours - 60.1) > 9


def test_vtv_is_the_plain_mean():
    row = (78.6, 79.3, 71.8, 61.2, 41.9, 76.5, 63.4, 48.7, 68.0)
    assert round(vtv_average(dict(zip(VTV, row, strict=True))), 1) == 65.5


@pytest.mark.parametrize("gone", [{}, {"csc": math.nan}])
def test_a_missing_metric_is_named(gone):
    metrics = {name: value for name, value in PERFECT.items() if name != "csc"} | gone
    with pytest.raises(ValueError, match="lacks csc"):
        touch_average(metrics)
