"""Measurements of a contact on made-up presses whose numbers are known."""

import dataclasses

import numpy as np
import pytest

from sensors_io.measures import UNITS, MeasureError, band_rms, measure, slope
from sensors_io.schema import ContactKey, Flag, Sequence
from tests.sensors_io.checks import refused

FORCE = np.array([0.25, 0.75, 1.5, 6.0])
KEY = ContactKey(object_id="ball", site=0, motion="press", trial=0)


def press(**changes) -> Sequence:
    """A flat stamp on the left upper quarter of a gel of 2 N/mm and a picture that follows it."""
    depth = np.zeros((4, 20, 20), np.float32)
    depth[:, 2:10, 4:12] = (FORCE / 2)[:, None, None]
    frames = np.full((4, 40, 40, 3), 100, np.uint8)
    frames[:, 4:20, 8:24] += np.array([0, 20, 40, 80], np.uint8)[:, None, None, None]
    force = np.zeros((4, 3), np.float32)
    force[:, 2] = -FORCE
    shear, valid = np.full((4, 20, 20, 2), [0.3, 0.4], np.float32), np.ones((4, 20, 20), bool)
    fields = {"depth_mm": depth, "frames": frames, "force_n": force, "deformation_mm": shear, "valid": valid}
    frame = {"host_time_ns": np.arange(4), "phase": np.ones(4, np.uint8), "flags": np.zeros(4, np.uint32)}
    return Sequence(key=KEY, sensor="xense", **{**fields, **frame, **changes})


def test_a_stamp_by_hand():
    found = measure(press())
    assert found.frame == 2
    assert found.quantities["force"] == 1.5
    assert found.quantities["indentation"] == pytest.approx(0.75)
    assert found.quantities["stiffness"] == pytest.approx(2.0)
    assert found.quantities["contact area"] == pytest.approx(100 * 64 / 400)
    assert found.quantities["spread"] == pytest.approx(0)  # a stamp does not spread
    assert found.quantities["marker displacement"] == pytest.approx(0.5)
    assert found.box == (0.2, 0.1, 0.6, 0.5)
    assert found.at == (0.225, 0.125)  # the first of equal depths
    assert list(found.quantities) == [name for name in UNITS if name in found.quantities]


def test_what_is_not_recorded_is_not_measured():
    blind = measure(press(frames=None))
    assert not {"fine texture", "coarse texture"} & set(blind.quantities)
    bare = measure(press(deformation_mm=None, force_n=None))
    assert set(bare.quantities) == {"contact area", "indentation", "relief", "fine texture", "coarse texture"}
    pictures = measure(press(depth_mm=None, deformation_mm=None, valid=None))
    assert set(pictures.quantities) == {"force", "contact area", "spread", "fine texture", "coarse texture"}
    assert pictures.box == pytest.approx((0.2, 0.1, 0.6, 0.5), abs=0.08)


def test_flagged_frames_and_unreadable_nodes_are_not_read():
    """How far a gel could be strained must not tell what was touched: frames past the reference change nothing."""
    by_flags = lambda *flags: measure(press(flags=np.array(flags, np.uint32)))
    assert by_flags(0, 0, Flag.STRAIN_LIMIT, 0).quantities["force"] == 0.75
    assert by_flags(0, 0, 0, Flag.STRAIN_LIMIT) == measure(press())
    valid = np.ones((4, 20, 20), bool)
    valid[:, 2:10, 4:8] = False
    assert measure(press(valid=valid)).box == (0.4, 0.1, 0.6, 0.5)


def test_nothing_to_measure_is_said():
    with pytest.raises(MeasureError, match="no frame without flags"):
        measure(press(flags=np.full(4, Flag.NO_CONTACT, np.uint32)))
    refused(MeasureError, "no contact", lambda: measure(press(depth_mm=np.full((4, 20, 20), 0.01, np.float32))))
    markers = press(frames=None, depth_mm=np.zeros((4, 20, 20), np.float32))
    refused(MeasureError, "neither depth nor pictures", lambda: measure(dataclasses.replace(markers, depth_mm=None)))


def test_a_wave_has_the_energy_of_its_band():
    x = np.arange(128)
    wave = np.broadcast_to(np.sin(2 * np.pi * x / 8), (128, 128)).astype(np.float32)
    q = 2 * np.pi / 8
    gain = np.exp(-(q**2) * 1 / 2) - np.exp(-(q**2) * 9 / 2)  # of the two Gaussians
    inner = np.zeros((128, 128), bool)
    inner[24:104, 24:104] = True
    assert band_rms(wave, 1.0, 3.0, inner) == pytest.approx(gain / np.sqrt(2), rel=0.03)
    assert band_rms(np.full((64, 64), 7.0, np.float32), 1.0, 3.0, np.ones((64, 64), bool)) == pytest.approx(0, abs=1e-4)


def test_slope_by_hand():
    assert slope(np.array([0.0, 1.0, 2.0]), np.array([1.0, 3.0, 5.0])) == pytest.approx(2)
    assert slope(np.array([1.0]), np.array([1.0])) is None
    assert slope(np.array([1.0, 1.001]), np.array([0.0, 1.0])) is None
