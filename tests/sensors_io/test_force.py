"""Bias, weight, mounting, lag and interpolation against made readings."""

import numpy as np
import pytest

from sensors_io.force import ForceError, Mount, at_frames, estimate_lag, fit_gravity, gravity_directions
from tests.sensors_io.checks import refused

MS = 1_000_000
BIAS, BIAS_M = np.array([1.2, -0.4, 3.0]), np.array([20.0, -5.0, 8.0])
WEIGHT, CENTRE = 1.5, np.array([2.0, -1.0, 12.0])


def poses(count=12, noise_n=0.0, seed=0):
    """Directions of gravity and readings without contact."""
    rng = np.random.default_rng(seed)
    down = rng.normal(size=(count, 3))
    down /= np.linalg.norm(down, axis=-1, keepdims=True)
    force = BIAS + WEIGHT * down + noise_n * rng.normal(size=down.shape)
    moment = BIAS_M + np.cross(CENTRE, WEIGHT * down) + 10 * noise_n * rng.normal(size=down.shape)
    return down, force, moment


@pytest.mark.parametrize(("count", "noise_n"), [(12, 0.0), (60, 0.02)])
def test_bias_weight_and_centre_come_back_and_noise_is_seen_in_the_residual(count, noise_n):
    model = fit_gravity(*poses(count, noise_n))
    np.testing.assert_allclose(model.bias_n, BIAS, atol=noise_n + 1e-9)
    np.testing.assert_allclose(model.bias_nmm, BIAS_M, atol=10 * noise_n + 1e-9)
    np.testing.assert_allclose(model.centre_mm, CENTRE, atol=10 * noise_n + 1e-9)
    assert model.mass_kg == pytest.approx(WEIGHT / 9.80665, abs=noise_n + 1e-9)
    assert (model.rms_n, model.rms_nmm) == pytest.approx((noise_n, 10 * noise_n), rel=0.3, abs=1e-9)


def test_what_is_left_is_the_contact():
    down, force, moment = poses()
    model = fit_gravity(down, force, moment)
    pushed = np.array([0.1, 0.2, -2.0])
    left, left_moment = model.contact(force + pushed, moment + np.cross([0, 0, 5.0], pushed), down)
    np.testing.assert_allclose(left, np.broadcast_to(pushed, left.shape), atol=1e-9)
    np.testing.assert_allclose(left_moment[0], np.cross([0, 0, 5.0], pushed), atol=1e-9)


def test_impossible_poses_mounts_and_readings_are_refused():
    down, force, moment = poses()
    refused(ForceError, "turn the sensor in more directions", fit_gravity, down[:2], force[:2], moment[:2])
    for count in (2, 3):
        refused(ForceError, "span no sphere", gravity_directions, force[:count])
    refused(ForceError, "length 1", fit_gravity, 2 * down, force, moment)
    flat = down * [1, 1, 0]
    flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
    refused(ForceError, "span no sphere", gravity_directions, BIAS + WEIGHT * flat)
    weightless = fit_gravity(down, 0 * force, 0 * moment)
    refused(ForceError, r"weight_n is 0\.0000", lambda: weightless.centre_mm)
    refused(ForceError, "must be a rotation", Mount, rotation=np.diag([1.0, 1.0, -1.0]))
    refused(ForceError, "sign is 0", Mount, sign=0)
    still = np.zeros(5, np.int64)
    refused(ForceError, "must be ≥ 3 and rise", at_frames, np.zeros(1, np.int64), still, np.zeros((5, 3)))


def test_a_press_on_a_sensor_mounted_upside_down():
    """The sensor's z points into the table: half a turn about x; a push at the centre leaves no moment."""
    turn = np.diag([1.0, -1.0, -1.0])
    mount = Mount(rotation=turn, offset_mm=np.array([0, 0, -10.0]))
    push = np.array([0.3, 0.0, 2.0])  # along the sensor's z, away from the object
    force, moment = mount.to_gel(push, np.cross([0, 0, -10.0], push))
    np.testing.assert_allclose(force, [0.3, 0.0, -2.0])
    np.testing.assert_allclose(moment, 0, atol=1e-12)
    np.testing.assert_allclose(Mount(sign=-1).to_gel(push, np.zeros(3))[0], -push)


def presses(lag_s, rate_hz=25.0, seed=0):
    """Six presses: frames at a camera's rate respond as force^0.7 some time later; the force is read at 1 kHz."""
    rng = np.random.default_rng(seed)
    force_time = np.arange(0, 12_000) * MS
    at = lambda t: 10 * np.clip(np.sin(2 * np.pi * 0.5 * t + 0.8 * np.sin(0.9 * t)), 0, None) ** 1.5
    frame_time = (np.arange(int(11.9 * rate_hz)) / rate_hz * 1e9).astype(np.int64) + 7 * MS
    signal = at(frame_time / 1e9 - lag_s) ** 0.7 + 0.02 * rng.standard_normal(len(frame_time))
    force = at(force_time / 1e9) + 0.02 * rng.standard_normal(len(force_time))
    return frame_time, signal, force_time, force


@pytest.mark.parametrize("lag", [-0.03, 0.0, 0.047, 0.12])
def test_the_lag_is_found_to_a_tenth_of_a_frame(lag):
    found = estimate_lag(*presses(lag))
    assert found.seconds == pytest.approx(lag, abs=0.004)
    assert found.correlation > 0.95


def test_unrelated_signals_have_no_lag():
    frame_time, signal, force_time, force = presses(0.0)
    noise = np.random.default_rng(1).standard_normal(len(signal))
    refused(ForceError, "picture and force agree by", estimate_lag, frame_time, noise, force_time, force)
    refused(ForceError, "overlaps by", estimate_lag, frame_time[:20], signal[:20], force_time, force)


def test_readings_are_interpolated_and_gaps_are_not():
    time = np.array([0, 10, 20, 30, 130, 140]) * MS
    value = np.array([0, 1, 2, 5, 6, 7.0])[:, None]
    found = at_frames(np.array([5, 15, 80, 200]) * MS, time, value)
    assert found.value[:, 0].tolist() == [0.5, 1.5, 5.5, 7.0]
    assert found.covered.tolist() == [True, True, False, False]
    np.testing.assert_allclose(found.residual, [0, 1.0, 1.0, 0], atol=1e-12)
