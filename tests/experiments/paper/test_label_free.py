"""Levels without labels: agreement of sensors, and ranks of measured physics."""

import dataclasses

import numpy as np
import pytest

from experiments.paper.label_free import agreed_levels, friction, levels_of_ranks, mean_ranks, measured_levels
from sensors_io.generate import generate_records
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import ContactKey, Phase, Sequence
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.types import Parsed

NOTHING = np.zeros(0)


def test_a_level_counts_where_three_of_four_present_sensors_conclude_it():
    """Questions about property 1 of contacts 0, 1 and 2; in the last, two sensors are there and disagree."""
    said = np.array([[2, 2, 2, 0], [1, 1, 0, 0], [2, 0, -1, -1]])
    alone = np.full((3, 4, 2), -1)
    alone[:, :, 1] = said
    streams = np.array([[True] * 4, [True] * 4, [True, True, False, False]])
    parsed = Parsed(NOTHING, NOTHING, NOTHING, NOTHING, NOTHING, NOTHING)
    answers = Evaluation(
        contact=np.arange(3),
        attribute=np.ones(3, int),
        streams=streams,
        tokens=NOTHING,
        parsed=parsed,
        label=NOTHING,
        alone=alone,
    )
    np.testing.assert_array_equal(agreed_levels(answers, np.zeros((3, 2))), [[-1, 2], [-1, -1], [-1, -1]])
    with pytest.raises(ValueError, match="alone is None"):
        agreed_levels(dataclasses.replace(answers, alone=None), np.zeros((3, 2)))


def test_ranks_are_those_of_each_sensor_and_joined():
    """Sensor b has ten times the values of a, and missed the contact in the middle."""
    values = [{"a": 3.0, "b": 50.0}, {"a": 2.0}, {"a": 1.0, "b": 10.0}]
    np.testing.assert_allclose(mean_ranks(values), [1, 0.5, 0])


def test_ranks_between_the_bands_imply_nothing():
    np.testing.assert_array_equal(
        levels_of_ranks(np.array([0, 0.28, 0.3, 0.5, 0.65, 0.72, 1])), [0, 0, -1, 1, -1, 2, 2]
    )


@pytest.mark.long
def test_measured_hardness_is_right_more_often_than_chance(tmp_path):
    """Hard objects indent the gel more: a rank of the wrong sign is right in a sixth of the contacts."""
    scenes = SceneConfig(objects=60, sites=1, image_px=28, view_px=28, contact_grid=32)
    generate_records(scenes, tmp_path)
    store = RecordStore(tmp_path)
    level = measured_levels(store, np.arange(len(store)))[:, 0]
    label = np.array([store.objects[key.object_id].label_row()[0] for key in store.contacts])
    assert (level == label)[level >= 0].mean() > 0.45


def sequence(motion: str, force_n: list[list[float]] | None) -> Sequence:
    n = 3
    return Sequence(
        key=ContactKey(object_id="o", site=0, motion=motion, trial=0),
        sensor="xense",
        depth_mm=np.zeros((n, 2, 2), np.float32),
        force_n=None if force_n is None else np.array(force_n, np.float32),
        host_time_ns=np.arange(n, dtype=np.int64),
        phase=np.array([Phase.LOAD, Phase.MOVE, Phase.MOVE], np.uint8),
        flags=np.zeros(n, np.uint32),
    )


def test_friction_is_tangential_over_normal_force_while_it_slides():
    force = [[9.0, 0.0, -1.0], [3.0, 4.0, -10.0], [0.0, 0.0, -0.1]]  # not moving; 5 / 10; hardly loaded
    assert friction(sequence("slide_x", force)) == pytest.approx(0.5)
    assert friction(sequence("press", force)) is None
    assert friction(sequence("slide_x", None)) is None
