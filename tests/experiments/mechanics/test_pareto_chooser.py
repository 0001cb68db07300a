"""The chooser's experiment, shrunk, and its arithmetic by hand."""

import numpy as np
import pytest

from experiments.core.artifacts import jsonable
from experiments.mechanics import chooser_measure as measured
from experiments.mechanics import chooser_trial as trial
from experiments.mechanics.chooser_measure import FAMILIES, MenuMeasurements, draw
from experiments.mechanics.chooser_trial import ChooserTrial, SequenceTrial
from sensors_io.scenes.chooser_survey import FEATURES
from sensors_io.scenes.sensors import XENSE

ERROR = np.array([[0.30, 0.09, 0.02], [0.14, 0.20, 0.01], [0.90, 0.80, 0.70]])
COST = np.array([1.0, 2.0, 4.0])


def test_hindsight_takes_the_cheapest_setting_that_meets_the_error():
    np.testing.assert_array_equal(trial.in_hindsight(ERROR, COST, 0.1), [1, 2, -1])


def test_a_summary_counts_shares_and_times():
    scenes = {"index": [1, 0, 2], "met": [True, True, False], "error": [0.09, 0.16, 0.7], "best": [1, 2, -1]}
    times = {"seconds": [0.003], "hindsight": [0.006], "possible": [2]}
    made = ChooserTrial(asked=0.1, **{name: np.array(values) for name, values in (scenes | times).items()})
    found = trial.summary(made, ERROR, COST)
    assert found["kept"] == 0.5
    assert found["kept of all"] == pytest.approx(1 / 3)
    assert found["flagged"] == found["unreachable"] == found["beyond promise"] == pytest.approx(1 / 3)
    assert found["flagged in vain"] == 0
    assert found["time"] == pytest.approx(1.5)
    assert found["ratio"] == pytest.approx(0.5)
    assert found["fixed"] is None  # the third scene is met by none


def test_frames_count_only_where_they_were_promised():
    error = np.array([[0.05, 0.16], [0.9, 0.9]])
    made = SequenceTrial(asked=0.1, grid=np.array([64, 128]), met=np.array([True, False]), error=error)
    assert made.kept_share == 0.5
    assert made.kept.tolist() == [[True, False], [False, False]]


def test_batches_survive_a_round_trip():
    lengths = {"radius_mm": 3.0, "slope_share": 0.0, "window_mm": 18.0, "thickness_mm": 4.0}
    made = MenuMeasurements(
        features=np.ones((3, len(FEATURES))),
        **{name: np.full(3, value) for name, value in lengths.items()},
        errors=ERROR,
        ms=np.ones((1, 3)),
        family=np.full(3, "balls"),
    )
    again = measured.join(MenuMeasurements, [jsonable(made), jsonable(made)])
    np.testing.assert_array_equal(again.errors, np.concatenate([made.errors, made.errors]))
    np.testing.assert_array_equal(again.family, np.concatenate([made.family, made.family]))
    kept = SequenceTrial(asked=0.1, grid=np.array([64]), met=np.array([True]), error=np.ones((1, 2)))
    assert measured.join(SequenceTrial, [jsonable(kept), jsonable(kept)]).asked == 0.1


def test_families_are_what_they_say():
    batch = draw(XENSE, len(FAMILIES), (24,), 0)
    assert tuple(batch.family) == FAMILIES
    assert set(batch.gap_mm) == {24, 48, 96, measured.REFERENCE_GRID}
    ball = batch.gap_mm[48][1]
    assert ball.min() >= 0
    assert np.diff(ball, 2, axis=0).std() < 0.05 * np.diff(ball, 2, axis=0).mean()  # one curvature everywhere
