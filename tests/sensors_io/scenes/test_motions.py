"""The commanded motions: phases, forces, speeds, and the gap that moves with the object."""

import itertools

import numpy as np
import pytest

from sensors_io.scenes.motions import Pace, plan
from sensors_io.schema import EXPLORATORY, FORCES_N, MOTIONS, PRESS_FORCE_N, Phase
from tests.sensors_io.checks import refused

ALL = [("press", PRESS_FORCE_N), *itertools.product(EXPLORATORY, FORCES_N)]
X = (np.arange(40) + 0.5) * 0.4 - 8.0


@pytest.mark.parametrize(("motion", "force"), ALL)
def test_every_motion_is_ninety_frames_in_order_and_force_belongs_to_its_phase(motion: str, force: float) -> None:
    made = plan(motion, force)
    assert motion in MOTIONS
    assert {len(getattr(made, n)) for n in ("slide_mm", "twist_rad", "tilt_rad", "phase", "time_s")} == {90}
    assert made.phase.dtype == np.uint8
    assert made.phase[0] == Phase.APPROACH
    assert made.force_n.max() == pytest.approx(force)
    np.testing.assert_allclose(np.diff(made.time_s), 1 / 30)
    assert np.all(made.force_n[made.phase == Phase.APPROACH] == 0)
    rise = np.diff(made.force_n, prepend=0)
    assert np.all(rise[made.phase == Phase.LOAD] > 0)
    assert np.all(rise[made.phase == Phase.UNLOAD] < 0)
    np.testing.assert_allclose(made.force_n[np.isin(made.phase, (Phase.HOLD, Phase.MOVE))], force)


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


@pytest.mark.parametrize(("motion", "presses", "held"), [("press", 1, 0), ("tap", 3, 0), ("hold", 1, 40)])
def test_presses_do_not_move_sideways_and_those_of_a_tap_let_go(motion: str, presses: int, held: int) -> None:
    made = plan(motion, 5.0)
    for path in (made.slide_mm, made.twist_rad, made.tilt_rad):
        np.testing.assert_array_equal(path, 0)
    touching = np.diff((made.force_n > 0).astype(int))
    assert np.sum(touching == 1) == presses
    assert np.sum(touching == -1) == (0 if motion == "press" else presses)
    assert np.sum(made.phase == Phase.HOLD) >= held


def test_impossible_requests_are_refused() -> None:
    refused(ValueError, "motion is 'wave': must be one of press, slide_x", plan, "wave", 5.0)
    refused(ValueError, r"force_n is 0\.0: must be > 0", plan, "press", 0.0)
    refused(ValueError, "frames is 30: must be ≥ 36", Pace, frames=30)
    refused(ValueError, "taps is 20", Pace, taps=20)
    refused(ValueError, "slide_mm_per_s is 0", Pace, slide_mm_per_s=0)
