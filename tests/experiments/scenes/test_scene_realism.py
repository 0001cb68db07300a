"""The whole experiment on rendered recordings; distances of pictures and the accuracy of the classifier by hand."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.context import Context
from experiments.core.errors import ResultsError
from experiments.scenes import realism_fit, scene_realism
from experiments.scenes.scene_realism import accuracy, distances
from sensors_io.scenes import fitting, photometric
from sensors_io.scenes.photometric import MINI
from sensors_io.scenes.sensors import GELSIGHT_MINI
from tests.experiments.shrunk import run_shrunk

HEIGHT, WIDTH, SCALE, RADIUS_MM = 240, 320, 0.0634, 3.155
P, N = 8, 48
CENTRES = np.full((P, 2), N / 2)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen presses in the form of the published ones, rendered with the stored constants and a little noise."""
    root = tmp_path_factory.mktemp("presses")
    rng = np.random.default_rng(0)
    window, axis = HEIGHT * SCALE, (np.arange(HEIGHT) - (HEIGHT - 1) / 2) * SCALE
    profiles = fitting.ball_profiles(GELSIGHT_MINI.gel, RADIUS_MM, presses=8)
    flat = photometric.fields(MINI, HEIGHT, window)[0].transpose(1, 2, 0)
    _write(root / "background.png", flat, rng)
    for i in range(16):
        touch = np.array([-5 + 3.3 * (i % 4), -5 + 3.3 * (i // 4), 1.5 + 0.04 * i])
        _write(root / f"6.310mm/{i}/gelsight.png", flat + fitting.change(MINI, profiles, touch, axis, window), rng)
    return root


def _write(path: Path, square: np.ndarray, rng: np.random.Generator) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    side = (WIDTH - HEIGHT) // 2
    image = np.pad(square, ((0, 0), (side, side), (0, 0)), mode="edge")
    noisy = 255 * (image + 0.005 * rng.standard_normal(image.shape))
    cv2.imwrite(str(path), np.clip(np.round(noisy), 0, 255).astype(np.uint8)[..., ::-1])


@pytest.mark.slow
def test_the_fit_finds_the_optics_that_made_the_pictures(recordings: Path, tmp_path: Path) -> None:
    config = dataclasses.replace(scene_realism.SMOKE, data_dir=recordings, image_px=64, patches=4)
    directory = run_shrunk(scene_realism, config, tmp_path)
    results = read_json(directory / "results.json")
    (stored,) = results["requirements"]
    assert stored["measured"] < 1.5  # levels; the lamps by eye are off by 13
    distance, fit = ({row[0]: row[1:] for row in table["rows"]} for table in results["tables"])
    assert min(fit["fitted"][:3]) > 95
    assert min(fit["held out"][:3]) > 95
    by_eye, fitted = distance["lamps by eye"], distance["fitted optics and noise"]
    assert fitted[0] < 0.4 * by_eye[0]  # rms difference
    assert fitted[4] < by_eye[4]  # accuracy of the classifier
    assert by_eye[4] > 90
    assert (directory / "plots" / "presses.png").read_bytes().startswith(b"\x89PNG")
    made: dict[str, object] = {}
    exec((directory / "mini_optics.py").read_text(), made)
    fields = ("HALF_WINDOW_MM", "FLAT", "SLOPE", "DEPTH", "MAX_TILT")
    half, flat, slope, depth, tilt = (made[name] for name in fields)
    found = photometric.PhotometricOptics(half_window_mm=half, flat=flat, slope=slope, depth=depth, max_tilt=tilt)
    assert found.half_window_mm == pytest.approx(HEIGHT * SCALE / 2)
    assert len(made["READ_NOISE"]) == len(made["SHOT_NOISE"]) == len(made["GRAIN"]) == 3


@pytest.mark.long
def test_shadows_that_were_not_cast_explain_nothing(recordings: Path, context: Context) -> None:
    presses = realism_fit.read(recordings, image_px=48)
    study = realism_fit.fit(presses, context)
    assert realism_fit.shadow_gain(study, context)["explained"] < 0.05


@pytest.mark.parametrize(("data_dir", "message"), [(None, "data_dir is None"), ("empty", "0 pictures")])
def test_a_folder_without_recordings_is_refused(data_dir: str | None, message: str, tmp_path: Path) -> None:
    where = None if data_dir is None else tmp_path / data_dir
    with pytest.raises(ResultsError, match=message):
        realism_fit.read(where, image_px=48)


def pictures(seed: int, std: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    smooth = 120 + 20 * np.sin(np.linspace(0, 3, N))[:, None, None] * np.ones((P, N, N, 3))
    return np.clip(np.round(smooth + std * rng.standard_normal((P, N, N, 3))), 0, 255).astype(np.uint8)


def test_a_shift_of_brightness_is_its_own_distance() -> None:
    found = distances(pictures(0), pictures(0) + np.uint8(7))
    assert found == pytest.approx({"difference": 7, "intensity": 7, "gradient": 0, "spectrum": 0}, abs=1e-9)


def test_twice_the_contrast_is_six_decibels() -> None:
    real = pictures(0, 3.0).astype(np.float64)
    doubled = 2 * (real - real.mean((1, 2), keepdims=True)) + real.mean((1, 2), keepdims=True)
    assert distances(real, doubled)["spectrum"] == pytest.approx(20 * np.log10(2), abs=1e-6)
    assert distances(real, doubled)["intensity"] > 1


def test_the_classifier_is_at_chance_where_nothing_differs() -> None:
    mean, error = accuracy(pictures(0), pictures(1), CENTRES, patches=16)
    assert mean == pytest.approx(0.5, abs=4 * error + 0.02)


def test_the_classifier_finds_a_fifth_more_noise() -> None:
    mean, _ = accuracy(pictures(0), pictures(1, 3.6), CENTRES, patches=16)
    assert mean > 0.9
