"""The fit finds again what pictures were made with, and a ball's profile is the ball."""

import dataclasses

import numpy as np
import pytest

from sensors_io.scenes import fitting, photometric
from sensors_io.scenes.fitting import BallPictures
from sensors_io.scenes.photometric import MINI
from sensors_io.scenes.sensors import GELSIGHT_MINI

RADIUS_MM, PX = 3.155, 64
SCALE = GELSIGHT_MINI.window_mm / PX
READ, SHOT, GRAIN = 0.001, 0.002, 0.006


@pytest.fixture(scope="module")
def profiles() -> fitting.Profiles:
    return fitting.ball_profiles(GELSIGHT_MINI.gel, RADIUS_MM, presses=12)


def _touches() -> np.ndarray:
    rng = np.random.default_rng(1)
    places = np.stack(np.meshgrid([-5.0, -1.8, 1.8, 5.0], [-5.0, -1.8, 1.8, 5.0]), -1).reshape(-1, 2)
    return np.column_stack([places + rng.uniform(-0.5, 0.5, places.shape), rng.uniform(1.3, 2.1, len(places))])


@pytest.fixture(scope="module")
def presses(profiles: fitting.Profiles) -> BallPictures:
    """Sixteen presses rendered with the constants of the Mini, with noise and grain."""
    rng = np.random.default_rng(0)
    window = GELSIGHT_MINI.window_mm
    flat = photometric.fields(MINI, PX, window)[0].transpose(1, 2, 0)
    flat = flat * (1 + photometric.grain(rng, PX, (GRAIN,) * 3, 0.5).transpose(1, 2, 0))
    noisy = lambda image: image + (READ + SHOT * np.sqrt(np.maximum(image, 0))) * rng.standard_normal(image.shape)
    axis = (np.arange(PX) - (PX - 1) / 2) * SCALE
    made = [noisy(flat + fitting.change(MINI, profiles, t, axis, window)) for t in _touches()]
    return BallPictures(pictures=np.array(made), background=flat, radius_mm=RADIUS_MM, mm_per_px=SCALE)


@pytest.mark.long
def test_the_field_is_the_gradient_of_its_depth(profiles: fitting.Profiles) -> None:
    axis = np.arange(-3, 3, 0.05)
    depth, d_x, d_y = profiles.field(np.array([0.4, -0.3, 1.7]), axis[None, :], axis[:, None])
    numeric_y, numeric_x = np.gradient(depth, 0.05)
    away = np.hypot(axis[None] - 0.4, axis[:, None] + 0.3)
    smooth = (np.abs(away - 1.7) > 0.3) & (away > 0.3)
    np.testing.assert_allclose(d_x[smooth], numeric_x[smooth], atol=0.03)
    np.testing.assert_allclose(d_y[smooth], numeric_y[smooth], atol=0.03)


@pytest.mark.long
def test_optics_and_touches_are_found_again(presses: BallPictures, profiles: fitting.Profiles) -> None:
    train = np.arange(0, 16, 2)
    begun = _touches() + np.random.default_rng(3).uniform(-0.4, 0.4, (16, 3))
    reported: list[tuple[int, int]] = []
    found, touches = fitting.fit_jointly(presses, profiles, begun, train, lambda *word: reported.append(word))
    assert reported == [(n, fitting.ROUNDS + 1) for n in range(1, fitting.ROUNDS + 2)]
    np.testing.assert_allclose(touches, _touches(), atol=0.1)
    held_out = [fitting.change(found, profiles, t, presses.axis_mm, presses.window_mm) for t in touches[1::2]]
    true = [fitting.change(MINI, profiles, t, presses.axis_mm, presses.window_mm) for t in _touches()[1::2]]
    np.testing.assert_allclose(held_out, true, atol=0.03)
    assert np.std(np.subtract(held_out, true)) < 0.1 * np.std(true)
    flat = photometric.fields(found, PX, presses.window_mm)[0] - photometric.fields(MINI, PX, presses.window_mm)[0]
    assert np.abs(flat).mean() < 1e-3


@pytest.mark.long
def test_noise_and_grain_are_found_again(presses: BallPictures) -> None:
    noise = fitting.measure_noise(presses, _touches(), MINI)
    for c in range(3):
        level = float(np.sqrt(np.median(presses.background[..., c])))
        assert noise.read[c] + noise.shot[c] * level == pytest.approx(READ + SHOT * level, rel=0.15)
        assert noise.grain[c] == pytest.approx(GRAIN, rel=0.3)
    assert noise.shared == pytest.approx(0.5, abs=0.15)
    pictures = presses.pictures.copy()
    pictures[:, ::20, ::20] *= 0.7  # scratches, which are no grain
    scratched = dataclasses.replace(presses, pictures=pictures)
    assert fitting.measure_noise(scratched, _touches(), MINI).shared == pytest.approx(noise.shared, abs=0.25)
