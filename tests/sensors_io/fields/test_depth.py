"""Zero level and contact mask, by surfaces that are known; failed contact, by real pictures."""

import pathlib

import numpy as np
import pytest

from sensors_io.calibration.presses import indentation
from sensors_io.fields.contact import ContactConfig, changed_contacts, find_contacts, steepest_change
from sensors_io.fields.depth import ZeroConfig, untouched_cells, zero_level
from sensors_io.fields.sources import read_picture
from tests.sensors_io.checks import refused

PITCH = 0.0634
DATA = pathlib.Path(__file__).parents[2] / "data"


def pressed(x_0: float, y_0: float, contact_mm: float = 1.5) -> tuple[np.ndarray, np.ndarray]:
    """Depth and length of the slopes under a ball of 3 mm radius, mm and mm/mm, float32 [240, 320]."""
    y, x = np.mgrid[:240, :320].astype(float)
    depth, d_x, d_y = indentation((x - x_0) * PITCH, (y - y_0) * PITCH, contact_mm, 3.0)
    return depth.astype(np.float32), np.hypot(d_x, d_y).astype(np.float32)


def test_a_tilted_and_bent_zero_is_taken_out() -> None:
    depth, slope = pressed(160, 120)
    y, x = np.mgrid[-1:1:240j, -1:1:320j]
    drift = 0.05 + 0.03 * x - 0.02 * y + 0.04 * x**2 + 0.02 * x * y
    clean = depth - zero_level(depth, slope, PITCH, ZeroConfig())
    found = depth + drift.astype(np.float32)
    found -= zero_level(found, slope, PITCH, ZeroConfig())
    np.testing.assert_allclose(found, clean, atol=2e-3)


@pytest.mark.parametrize("sign", [1, -1])
def test_gel_that_sinks_around_a_contact_is_no_zero_level(sign: int) -> None:
    """A sinking of the supposed decay is left in the depth; gel that rises there is taken for a fault as before."""
    config = ZeroConfig()
    _, slope = pressed(160, 120)
    steep = np.where(slope > config.steep, 1.0, 0.0).astype(np.float32)
    y, x = np.mgrid[:240, :320]
    away = np.maximum(np.hypot(x - 160, y - 120) - np.sqrt(steep.sum() / np.pi), 0) * PITCH
    sunk = sign * 0.15 * np.exp(-away / config.sinks_mm).astype(np.float32)
    tilt = (0.05 * x / 320 - 0.03 * y / 240).astype(np.float32)
    left = (sunk + tilt) - zero_level(sunk + tilt, steep, PITCH, config)
    error = np.abs(left - sunk)[steep > 0].max()
    assert (error < 0.005) == (sign > 0)


@pytest.mark.parametrize(("columns", "degree"), [(20, 2), (19, 1), (8, 1), (7, 0)])
def test_the_share_of_untouched_gel_sets_the_degree_of_its_zero(columns: int, degree: int) -> None:
    """Of 50 columns of cells 40 % are enough for a quadratic, 15 % for a plane; less gives a constant."""
    x = (np.arange(400) + 0.5) / 200 - 1
    slope = np.tile((np.arange(400) >= 8 * columns).astype(np.float32), (80, 1))
    for power in range(3):
        depth = np.tile(x**power, (80, 1)).astype(np.float32)
        left = depth - zero_level(depth, slope, 0.125, ZeroConfig(margin_mm=0))
        assert (np.abs(left).max() < 1e-3) == (power <= degree)


def test_a_contact_that_fills_the_window_takes_its_shallowest_part_for_zero() -> None:
    depth = np.tile(np.linspace(0.2, 1.0, 320, dtype=np.float32), (240, 1))
    level = zero_level(depth, np.ones_like(depth), PITCH, ZeroConfig())
    np.testing.assert_allclose(level, level[0, 0], atol=1e-6)
    assert level[0, 0] == pytest.approx(0.22, abs=0.02)


def test_cells_near_a_slope_are_not_untouched() -> None:
    """One steep column of cells of 8 px takes the margin on either side with it."""
    slope = np.zeros((80, 400), np.float32)
    slope[:, 200:208] = 1.0
    still = untouched_cells(slope, 0.125, ZeroConfig(margin_mm=3.0))  # cells of 1 mm
    assert still.shape == (10, 50)
    assert still.all(0).tolist() == [abs(column - 25) > 3 for column in range(50)]


@pytest.mark.parametrize("contact_mm", [0.8, 1.5, 2.0])
def test_the_mask_is_the_contact(contact_mm: float) -> None:
    """At half the greatest depth, which is Hertz's edge."""
    found = find_contacts(pressed(160, 120, contact_mm)[0], PITCH)
    assert (found.count, found.at_border) == (1, False)
    assert np.sqrt(found.mask.sum() / np.pi) * PITCH == pytest.approx(contact_mm, rel=0.05)


@pytest.mark.parametrize("at", [(5, 120), (315, 120), (160, 5), (160, 235)])
def test_contacts_at_each_border_and_beside_another_are_there(at: tuple[int, int]) -> None:
    assert find_contacts(pressed(*at)[0], PITCH).at_border
    both = np.maximum(pressed(80, 120, 0.8)[0] - 0.1, pressed(240, 120, 0.8)[0] - 0.1)
    found = find_contacts(both, PITCH)
    assert (found.count, found.at_border) == (2, False)


def test_hysteresis_keeps_no_shallow_region_and_no_speck() -> None:
    config = ContactConfig(low_mm=0.03, high_mm=0.06)
    shallow = np.zeros((240, 320), np.float32)
    shallow[50:90, 50:90] = 0.05
    assert find_contacts(shallow, PITCH, config).count == 0
    shallow[60, 60] = 0.07
    assert find_contacts(shallow, PITCH, config).mask.sum() == 1600
    speck = np.zeros((240, 320), np.float32)
    speck[3, 3] = 1.0
    assert not find_contacts(speck, PITCH, config).mask.any()


def test_a_zero_level_that_drifts_is_no_contact() -> None:
    """A corner that rises by 0.1 mm over 10 mm next to a bump of 0.5 mm: one contact, away from the border."""
    y, x = np.mgrid[:160, :214] * 0.1
    drift = (0.1 * np.clip((x + y - 27) / 10, 0, 1)).astype(np.float32)
    bump = (0.5 * np.exp(-((x - 8) ** 2 + (y - 7) ** 2) / 2)).astype(np.float32)
    found = find_contacts(drift + bump, 0.1)
    assert (found.count, found.at_border) == (1, False)
    assert find_contacts(drift, 0.1).count == 0
    assert find_contacts(drift, 0.1, ContactConfig(rim=0.01)).at_border


@pytest.mark.parametrize(("sunk_mm", "count"), [(0.15, 1), (0.05, 0)])
def test_a_ball_of_ten_millimetres_is_touched_from_a_rim_of_eight_hundredths(sunk_mm: float, count: int) -> None:
    """√(u/R) = 0.08 at u = 0.064 mm; the thresholds of depth let both pass."""
    contact_mm = np.sqrt(sunk_mm * 10.0)
    y, x = np.mgrid[:240, :320].astype(float)
    depth, _, _ = indentation((x - 160) * PITCH, (y - 120) * PITCH, contact_mm, 10.0)
    assert find_contacts(depth.astype(np.float32), PITCH, ContactConfig(high_mm=0.04)).count == count


@pytest.mark.parametrize(("folder", "press", "pitch"), [("gelslam", "press_9", 0.1902), ("FOTS", "press_20", 0.2043)])
def test_real_contacts_are_contacts_and_drift_is_none(folder: str, press: str, pitch: float) -> None:
    background = read_picture(DATA / folder / "background.png")
    config = ContactConfig()
    assert steepest_change(read_picture(DATA / folder / f"{press}.png"), background, pitch) > config.steepness
    y, x = np.mgrid[-1 : 1 : background.shape[0] * 1j, -1 : 1 : background.shape[1] * 1j]
    drift = np.clip(background + 10 * np.exp(-(x**2 + y**2) / 0.3)[..., None], 0, 255).astype(np.uint8)
    assert steepest_change(drift, background, pitch) < config.steepness
    assert changed_contacts(drift, background, pitch).count == 0


def step(levels: float) -> tuple[np.ndarray, np.ndarray]:
    """A picture and its background: brighter by `levels` on the right, fading out towards the top."""
    y, x = np.mgrid[:240, :320]
    background = np.full((240, 320, 3), 100, np.uint8)
    return background + np.round(levels * (x >= 160) * y / 239).astype(np.uint8)[..., None], background


def test_a_step_is_as_steep_as_its_smoothing_makes_it() -> None:
    """h / (σ √2π) at its foot, whatever pixels are averaged first."""
    assert steepest_change(*step(80), PITCH) == pytest.approx(80 / (0.3 * np.sqrt(2 * np.pi)), rel=0.03)


@pytest.mark.parametrize(("levels", "least_mm2", "count"), [(80, 0.05, 1), (6, 0.05, 0), (80, 200.0, 0)])
def test_a_change_must_be_both_steep_and_large(levels: float, least_mm2: float, count: int) -> None:
    assert changed_contacts(*step(levels), PITCH, ContactConfig(least_mm2=least_mm2)).count == count


CRITERIA = ("least_mm2", "rim", "steepness", "smoothing_mm")


@pytest.mark.parametrize(
    ("config", "changes", "said"),
    [
        (ContactConfig, {"low_mm": 0.2, "high_mm": 0.1}, "must be 0 < low ≤ high"),
        *((ContactConfig, {name: x}, f"{name} is {x}: must be > 0") for name in CRITERIA for x in (0.0, float("nan"))),
        (ZeroConfig, {"sinks_mm": 0.0}, "sinks_mm is .*: must be ≥ 0"),
        (ZeroConfig, {"near_mm": -1.0}, "near_mm is .*: must be ≥ 0"),
        (ZeroConfig, {"bent": float("nan")}, "bent is .*: must be ≥ 0"),
    ],
)
def test_settings_that_mean_nothing_are_refused(config, changes, said) -> None:
    refused(ValueError, said, config, **changes)
