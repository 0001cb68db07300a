"""Distances of pictures: nought for equal sets, hand values, and a judge who is at chance where nothing differs."""

import numpy as np
import pytest

from experiments.scenes.two_sample import PatchClassifier, accuracy, distances

P, N = 8, 48
CENTRES = np.full((P, 2), N / 2)


def _pictures(seed: int, std: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    smooth = 120 + 20 * np.sin(np.linspace(0, 3, N))[:, None, None] * np.ones((P, N, N, 3))
    return np.clip(np.round(smooth + std * rng.standard_normal((P, N, N, 3))), 0, 255).astype(np.uint8)


def test_equal_pictures_are_at_no_distance() -> None:
    found = distances(_pictures(0), _pictures(0))
    assert (found.pixel, found.intensity, found.gradient, found.spectrum_db) == (0, 0, 0, 0)


def test_a_shift_of_brightness_is_its_own_distance() -> None:
    found = distances(_pictures(0), _pictures(0) + np.uint8(7))
    assert found.pixel == pytest.approx(7)
    assert found.intensity == pytest.approx(7)
    assert found.gradient == pytest.approx(0, abs=1e-9)
    assert found.spectrum_db == pytest.approx(0, abs=1e-9)


def test_twice_the_contrast_is_six_decibels() -> None:
    real = _pictures(0, 3.0).astype(np.float64)
    doubled = 2 * (real - real.mean((1, 2), keepdims=True)) + real.mean((1, 2), keepdims=True)
    assert distances(real, doubled).spectrum_db == pytest.approx(20 * np.log10(2), abs=1e-6)
    assert distances(real, doubled).intensity > 1


def test_the_judge_is_at_chance_where_nothing_differs() -> None:
    mean, error = accuracy(_pictures(0), _pictures(1), CENTRES, PatchClassifier(patches=16))
    assert mean == pytest.approx(0.5, abs=4 * error + 0.02)


def test_the_judge_sees_a_fifth_more_noise() -> None:
    mean, _ = accuracy(_pictures(0), _pictures(1, 3.6), CENTRES, PatchClassifier(patches=16))
    assert mean > 0.9


def test_the_judge_needs_two_folds() -> None:
    with pytest.raises(ValueError, match="real holds 3 pictures: must be ≥ 4"):
        accuracy(_pictures(0)[:3], _pictures(1)[:3], CENTRES[:3], PatchClassifier())
