"""A sensor turned by hand: poses are found between the turns, and gravity tells what hangs on it."""

import itertools
import json

import numpy as np
import pytest

from sensors_io.force import ForceError
from sensors_io.json_files import read_json
from sensors_io.poses import ForceZero, PoseConfig, PoseFinder, fit_poses
from tests.sensors_io.checks import refused
from tests.sensors_io.test_force import BIAS, BIAS_M, CENTRE, WEIGHT


def turned(count=8, hold_s=1.0, turn_s=0.4, noise_n=0.005, rate_hz=200, seed=0):
    """Times, forces and moments of a hand that holds `count` directions, and the direction of gravity in the last."""
    rng = np.random.default_rng(seed)
    held = rng.normal(size=(count, 3))
    held /= np.linalg.norm(held, axis=-1, keepdims=True)
    path = [np.repeat(held[:1], round(hold_s * rate_hz), 0)]
    for a, b in itertools.pairwise(held):
        share = np.linspace(0, 1, round(turn_s * rate_hz))[:, None]
        path += [(1 - share) * a + share * b, np.repeat(b[None], round(hold_s * rate_hz), 0)]
    down = np.concatenate(path)
    down /= np.linalg.norm(down, axis=-1, keepdims=True)
    force = BIAS + WEIGHT * down + noise_n * rng.normal(size=down.shape)
    moment = BIAS_M + np.cross(CENTRE, WEIGHT * down) + 5 * noise_n * rng.normal(size=down.shape)
    return np.arange(len(down)) * round(1e9 / rate_hz), force, moment, held[-1]


def found_in(times, force, moment, **config):
    finder = PoseFinder(PoseConfig(**config))
    for row in zip(times, force, moment, strict=True):
        finder.offer(*row)
    return finder.poses


def test_every_pose_is_found_once_and_tells_bias_and_weight():
    times, force, moment, down = turned()
    poses = found_in(times, force, moment)
    assert len(poses) == 8
    zero = fit_poses(poses)
    np.testing.assert_allclose(zero.model.bias_n, BIAS, atol=0.01)
    np.testing.assert_allclose(zero.model.bias_nmm, BIAS_M, atol=0.1)
    assert zero.model.weight_n == pytest.approx(WEIGHT, abs=0.01)
    np.testing.assert_allclose(zero.model.centre_mm, CENTRE, atol=0.1)
    np.testing.assert_allclose(zero.down, down, atol=0.01)
    assert zero.model.rms_n < 0.01


def test_a_reading_that_is_not_finite_is_in_no_pose():
    times, force, moment, _ = turned()
    force[100] = np.nan
    poses = found_in(times, force, moment)
    assert len(poses) == 8
    assert np.isfinite([pose.force_n for pose in poses]).all()


def test_a_zero_comes_back_from_its_file(tmp_path):
    zero = fit_poses(found_in(*turned()[:3]))
    path = tmp_path / "g.json"
    zero.save(path)
    back = ForceZero.load(path)
    np.testing.assert_array_equal(back.down, zero.down)
    for name in ("bias_n", "bias_nmm", "first_moment_nmm", "weight_n", "rms_n", "rms_nmm", "poses"):
        np.testing.assert_array_equal(getattr(back.model, name), getattr(zero.model, name))


@pytest.mark.parametrize(
    "change",
    [
        {"down": [1, 2]},
        {"bias_n": 3},
        {"weight": 1},
        {"bias_n": [0, 0, float("nan")]},
        {"weight_n": "x"},
        {"weight_n": 1e999},
        {"down": [0, 0, -2]},
        None,
    ],
)
def test_a_file_without_a_zero_is_named(tmp_path, change):
    path = tmp_path / "g.json"
    fit_poses(found_in(*turned()[:3])).save(path)
    tree = [] if change is None else read_json(path) | change  # without a checksum, as one that somebody wrote
    path.write_text(json.dumps(tree))
    refused(ForceError, "make one with `force-zero`", ForceZero.load, path)
