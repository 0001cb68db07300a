"""The breaking of trackers and of shear, shrunken."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.runner import main
from experiments.fields import depth_stress, shear_stress, stability_fields, tracking_stress
from experiments.fields.known_motion import GelCamera, pressed
from experiments.fields.tracking_stress import Stress, StressOutcome
from sensors_io.schema import Flag

TINY = dataclasses.replace(stability_fields.SMOKE, methods=(stability_fields.OURS, "dots, nearest"))


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    home = tmp_path_factory.mktemp("runs")
    few = tuple(Stress(name=s.name, levels=s.levels[::3]) for s in tracking_stress.STRESSES)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stability_fields, "EXPERIMENT", dataclasses.replace(stability_fields.EXPERIMENT, config=TINY))
        patch.setattr(tracking_stress, "STRESSES", few)
        patch.setattr(stability_fields, "STRESSES", few)
        layers = tuple(Stress(name=s.name, levels=s.levels[2:3]) for s in shear_stress.SHEAR_STRESSES)
        patch.setattr(shear_stress, "SHEAR_STRESSES", layers)
        patch.setattr(stability_fields, "SHEAR_STRESSES", layers)
        balls = tuple(Stress(name=s.name, levels=s.levels[::4]) for s in depth_stress.DEPTH_STRESSES)
        patch.setattr(depth_stress, "DEPTH_STRESSES", balls)
        patch.setattr(stability_fields, "DEPTH_STRESSES", balls)
        assert main(["stability_fields", "--runs-dir", str(home)]) == 0
    (directory,) = (p for p in (home / "stability_fields").iterdir() if not p.is_symlink())
    return directory


@pytest.mark.slow
def test_nothing_of_ours_breaks_in_silence(directory):
    results = read_json(directory / "results.json")
    assert {r["name"]: r["measured"] for r in results["requirements"] if not r["met"]} == {}
    assert set(results["data"]) == {f"silent, {method}" for method in TINY.methods}


@pytest.mark.slow
def test_the_curves_are_drawn(directory):
    assert {p.name for p in (directory / "plots").iterdir()} >= {
        f"stability_{field}.svg" for field in ("tracking", "shear", "depth")
    }


def test_a_stressed_press_is_where_its_level_says():
    """A contact whose centre lies on the border: half of it is seen, deepest at the outermost column."""
    press = depth_stress._stressed("contact from the border, mm", 0.0, seed=3)
    assert press.touch[0] == depth_stress.WINDOW_MM / 2
    assert depth_stress._stressed("exposure, up", 1.3, seed=3).gain == 1.3
    assert depth_stress._stressed("contact, radii of a ball of 6.31 mm", 0.5, seed=3).touch[2] == 6.31 / 4


def test_depth_is_wrong_from_a_fifth_of_the_press():
    truth, inside = np.array([[0.0, 1.0]]), np.array([[False, True]])
    near, far = (depth_stress._outcome(truth - off, Flag.NONE, truth, inside) for off in (0.19, 0.21))
    assert (near.broken, far.broken) == (False, True)


def test_known_motion_is_exact():
    """The picture at p + f(p) shows what lay at p: a spline of the moved picture brings the dots back."""
    motion = pressed((120, 160), 6.0, np.random.default_rng(1))
    points = np.random.default_rng(2).uniform(20, 100, (50, 2))
    moved = points + motion.forward(points)
    np.testing.assert_allclose(moved - motion.backward(moved), points, atol=1e-9)
    y, x = np.mgrid[:120, :160].astype(float)
    smooth = np.stack([100 + 0.5 * x, 80 + 0.4 * y, 0 * x + 90], -1).round().astype(np.uint8)
    still = GelCamera(smooth, 0.0, 0)
    assert np.abs(still.under(motion.times(0.0), 0.0).astype(int) - smooth).max() == 0


def test_the_peak_is_the_peak():
    motion = pressed((120, 160), 6.0)
    y, x = np.mgrid[:120, :160].astype(float)
    assert np.linalg.norm(motion.backward(np.stack([x, y], -1)), axis=-1).max() == pytest.approx(6.0)


def test_silent_is_broken_without_a_flag():
    assert StressOutcome(error_px=9.0, wrong=0.2, flags=Flag.NONE).silent
    assert not StressOutcome(error_px=9.0, wrong=0.2, flags=Flag.MARKER_LOSS).silent
    assert not StressOutcome(error_px=0.1, wrong=0.0, flags=Flag.NONE).silent


def test_a_configuration_without_the_package_is_refused():
    with pytest.raises(ValueError, match="must hold"):
        stability_fields.FieldStabilityConfig(methods=("mean shift",))
