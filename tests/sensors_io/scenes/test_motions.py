"""The commanded motions: phases, forces, speeds, and the gap that moves with the object."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.scenes import surface
from sensors_io.scenes.motions import Pace, moved, plan
from sensors_io.scenes.objects import sample
from sensors_io.schema import EXPLORATORY, FORCES_N, MOTIONS, PRESS_FORCE_N, Phase
from tests.sensors_io.checks import refused

ALL = [("press", PRESS_FORCE_N), *itertools.product(EXPLORATORY, FORCES_N)]
X = (np.arange(40) + 0.5) * 0.4 - 8.0


@pytest.mark.parametrize(("motion", "force"), ALL)
def test_every_motion_is_ninety_frames_in_order(motion: str, force: float) -> None:
    made = plan(motion, force)
    assert len(made) == 90
    assert motion in MOTIONS
    for name in ("slide_mm", "twist_rad", "tilt_rad", "phase", "time_s"):
        assert len(getattr(made, name)) == 90
    assert made.phase.dtype == np.uint8
    assert made.phase[0] == Phase.APPROACH
    assert made.force_n.max() == pytest.approx(force)
    np.testing.assert_allclose(np.diff(made.time_s), 1 / 30)


@pytest.mark.parametrize(("motion", "force"), ALL)
def test_force_belongs_to_its_phase(motion: str, force: float) -> None:
    made = plan(motion, force)
    assert np.all(made.force_n[made.phase == Phase.APPROACH] == 0)
    rise = np.diff(made.force_n, prepend=0)
    assert np.all(rise[made.phase == Phase.LOAD] > 0)
    assert np.all(rise[made.phase == Phase.UNLOAD] < 0)
    still = (made.phase == Phase.HOLD) | (made.phase == Phase.MOVE)
    np.testing.assert_allclose(made.force_n[still], force)


@pytest.mark.parametrize(
    ("motion", "field", "speed"),
    [
        ("slide_x", "slide_mm", 4.0),
        ("slide_y", "slide_mm", 4.0),
        ("twist", "twist_rad", 0.6),
        ("roll", "tilt_rad", 0.2),
    ],
)
def test_motion_is_a_closed_cycle_at_the_stated_speed(motion: str, field: str, speed: float) -> None:
    made = plan(motion, 5.0)
    path = getattr(made, field)
    if path.ndim == 2:
        along = int(motion == "slide_y")
        assert np.all(path[:, 1 - along] == 0)
        path = path[:, along]
    assert np.all(path[made.phase != Phase.MOVE] == 0)
    assert path[np.flatnonzero(made.phase == Phase.MOVE)[-1]] == pytest.approx(0, abs=1e-12)
    assert path.max() == pytest.approx(-path.min(), rel=0.05)
    steps = np.abs(np.diff(path))[made.phase[1:] == Phase.MOVE] * 30
    assert np.median(steps) == pytest.approx(speed)
    assert steps.max() == pytest.approx(speed)


@pytest.mark.parametrize("motion", ["press", "tap", "hold"])
def test_presses_do_not_move_sideways(motion: str) -> None:
    made = plan(motion, 5.0)
    for path in (made.slide_mm, made.twist_rad, made.tilt_rad):
        np.testing.assert_array_equal(path, 0)


def test_a_tap_is_three_presses_and_each_lets_go() -> None:
    made = plan("tap", 5.0)
    touching = np.diff((made.force_n > 0).astype(int), append=0)
    assert np.sum(touching == 1) == 3
    assert np.sum(touching == -1) == 3


def test_hold_comes_back_to_nothing() -> None:
    made = plan("hold", 5.0)
    assert made.force_n[-1] == 0
    assert np.sum(made.phase == Phase.HOLD) >= 40


@pytest.mark.parametrize("frames", [36, 64, 200])
def test_other_lengths(frames: int) -> None:
    for motion in ("press", *EXPLORATORY):
        made = plan(motion, 2.0, Pace(frames=frames))
        assert len(made) == frames
        assert made.force_n.max() == pytest.approx(2.0)


def _pose(**changes: object) -> surface.SensorPose:
    still = surface.SensorPose(offset_mm=jnp.array([0.4, -0.2]), turn_rad=jnp.array(0.3), tilt=jnp.array([0.01, 0.0]))
    return dataclasses.replace(still, **changes)


def test_the_gap_moves_with_the_object() -> None:
    """Shape, relief and roughness of a slid skin are those of the skin before, read at points moved back."""
    skin = surface.make_skin(sample(np.random.default_rng(3), 0.3, 0.9), np.array([1.0, 2.0]), 1.0)
    gap = jax.jit(surface.gap)
    x = jnp.asarray(X, jnp.float32)
    slide = 5 * 0.4  # five pixels
    before = gap(skin, _pose(tilt=jnp.zeros(2)), x)
    after = gap(skin, moved(_pose(tilt=jnp.zeros(2)), jnp.array([slide, 0.0]), jnp.array(0.0), jnp.zeros(2)), x)
    difference = np.asarray(after)[:, 5:] - np.asarray(before)[:, :-5]
    np.testing.assert_allclose(difference, difference[0, 0], atol=2e-4)


def test_a_quarter_turn_turns_the_gap() -> None:
    skin = surface.make_skin(sample(np.random.default_rng(4), 0.3, 0.9), np.array([1.0, 2.0]), 1.0)
    still = _pose(offset_mm=jnp.zeros(2), tilt=jnp.zeros(2))
    gap, x = jax.jit(surface.gap), jnp.asarray(X, jnp.float32)
    before = gap(skin, still, x)
    after = gap(skin, moved(still, jnp.zeros(2), jnp.array(np.pi / 2), jnp.zeros(2)), x)
    np.testing.assert_allclose(after, np.rot90(before, -1), atol=1e-3)  # x → y, with y down the rows


def test_a_tilt_is_a_slope() -> None:
    pose = moved(_pose(), jnp.array([1.0, 2.0]), jnp.array(0.1), jnp.array([0.1, -0.2]))
    np.testing.assert_allclose(pose.offset_mm, [1.4, 1.8], rtol=1e-6)
    np.testing.assert_allclose(pose.turn_rad, 0.4, rtol=1e-6)
    np.testing.assert_allclose(pose.tilt, [0.01 + np.tan(0.1), np.tan(-0.2)], rtol=1e-6)


def test_impossible_requests_are_refused() -> None:
    refused(ValueError, "motion is 'wave': must be one of press, slide_x", plan, "wave", 5.0)
    refused(ValueError, r"force_n is 0\.0: must be > 0", plan, "press", 0.0)
    refused(ValueError, "frames is 30: must be ≥ 36", Pace, frames=30)
    refused(ValueError, "taps is 20", Pace, taps=20)
    refused(ValueError, "slide_mm_per_s is 0", Pace, slide_mm_per_s=0)
