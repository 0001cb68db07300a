"""Pictures are made straight by the geometry that the calibration's were made straight by, or not at all."""

import numpy as np
import pytest

from sensors_io.calibration.geometry import find_pins
from sensors_io.commands.straightening import Straightening
from sensors_io.fields.slopes import ColourMap, colour_terms, position_terms
from sensors_io.fields.types import Calibration, CalibrationError
from tests.sensors_io.calibration.test_geometry import SIZE, lens, picture, pins
from tests.sensors_io.checks import refused

ROWS, COLUMNS, PITCH_MM = 7, 9, 1.6


@pytest.fixture
def geometry(tmp_path):
    """The file of a lens that bends lines."""
    lens().save(tmp_path / "lens.json")
    return tmp_path / "lens.json"


@pytest.fixture
def calibration():
    """Of a sensor whose colours say nothing."""
    weights = np.zeros((len(position_terms(0)), len(colour_terms(1)), 2), np.float32)
    colours = ColourMap(weights=weights, degree=1, position_degree=0)
    return Calibration(
        sensor="x", background=np.zeros((*SIZE, 3), np.uint8), mm_per_px=0.06, colours=colours, made_from={}
    )


def test_straight_pins_lie_on_straight_lines(geometry):
    """Rows of pins, 1.6 mm apart, that bend by more than a pixel before."""
    straight = Straightening.of(geometry, None, SIZE)
    assert straight.mm_per_px == pytest.approx(lens().mm_per_px)
    where, rest = pins(lens()), np.full(SIZE, 150, np.uint8)
    bend = lambda points: np.abs(np.diff(points[..., 1], 2, axis=1)).max()
    found = find_pins(straight(picture(where, noise=0.0)), straight(rest), rows=ROWS, columns=COLUMNS)
    assert bend(where) > 1
    assert bend(found) < 0.5
    np.testing.assert_allclose(np.diff(found, axis=1)[..., 0] * straight.mm_per_px, PITCH_MM, atol=0.03)


def test_without_a_geometry_pictures_stay(calibration):
    straight = Straightening.of(None, 0.06, SIZE)
    image = picture(pins(lens()))
    assert straight(image) is image
    straight.check(calibration)
    assert straight.signed(calibration) is calibration


def test_a_calibration_asks_for_its_own_geometry(geometry, calibration, tmp_path):
    straight, none = Straightening.of(geometry, 0.06, SIZE), Straightening.of(None, 0.06, SIZE)
    signed = straight.signed(calibration)
    signed.save(tmp_path / "cal.npz")
    straight.check(Calibration.load(tmp_path / "cal.npz"))
    refused(CalibrationError, r"geometry is none: must be [0-9a-f]{16}", none.check, signed)
    refused(CalibrationError, "must be none", straight.check, calibration)
    lens(radial=(1.9, 0.2)).save(tmp_path / "other.json")
    with pytest.raises(CalibrationError, match="give --geometry that file"):
        Straightening.of(tmp_path / "other.json", 0.06, SIZE).check(signed)


def test_a_pitch_must_come_from_somewhere():
    refused(CalibrationError, "set --mm-per-px", Straightening.of, None, None, SIZE)
