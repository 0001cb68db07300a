"""The averages by hand values, and that none is made of less than all of its parts."""

import math

import pytest

from touchr1_jax.bench.averages import AVERAGED, VTV, touch_average, vtv_average

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
