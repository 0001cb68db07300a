"""The sensors are those of the published sheets, within one square window each."""

import dataclasses

import numpy as np
import pytest

from sensors_io.scenes import sensors
from sensors_io.scenes.readout import FIELD_GRID
from sensors_io.schema import SENSORS
from tests.sensors_io.checks import refused

PUBLISHED_MM = {
    "gelsight_mini": [(20.3, 15.2)],
    "xense": [(19.4, 30.8)],
    "tac3d": [(19.0, 19.0), (21.0, 21.0)],
    "dmtac_x": [(24.0, 18.0), (20.0, 15.0), (16.0, 12.0)],
}
RATE_HZ = {"gelsight_mini": 25, "xense": 60, "tac3d": 30.6, "dmtac_x": 120}


@pytest.mark.parametrize("model", sensors.MODELS, ids=SENSORS)
def test_the_window_is_the_square_of_a_published_one(model: sensors.SensorModel) -> None:
    sides = [min(area) for area in PUBLISHED_MM[model.name]]
    assert min(sides) <= model.window_mm <= max(sides)
    assert 1000 / model.frame_period_ms == pytest.approx(RATE_HZ[model.name], rel=0.01)


def test_the_nodes_of_the_tac3d_are_its_markers_and_only_other_gels_are_grained_or_printed() -> None:
    assert sensors.TAC3D.window_mm / FIELD_GRID == pytest.approx(1.0)
    assert sensors.TAC3D.render is None
    shapes = {m.name: m.draw_texture(np.random.default_rng(0)).shape for m in sensors.MODELS}
    assert shapes == {"gelsight_mini": (3, 112, 112), "xense": (2, 2), "tac3d": (2, 2), "dmtac_x": (288, 288)}


def test_a_window_without_size_is_refused() -> None:
    refused(ValueError, "xense: window_mm is 0: must be > 0", dataclasses.replace, sensors.XENSE, window_mm=0)
