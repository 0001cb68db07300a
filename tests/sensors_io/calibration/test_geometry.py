"""Lens and scale of made pictures and of a real pin board (9DTact)."""

import json
import pathlib

import cv2
import numpy as np
import pytest

from sensors_io.calibration.geometry import CameraGeometry, GeometryError, find_pins, fit_geometry
from sensors_io.json_files import read_json
from tests.sensors_io.checks import refused

BOARD = pathlib.Path(__file__).parents[2] / "data" / "9DTact"
SIZE = (240, 320)


def lens(radial=(2.0, 0.2), scale=0.06):
    """A geometry with mild tilt whose middle is the middle of the picture."""
    middle = np.array([SIZE[1], SIZE[0]]) / 2
    homography = np.array([[scale, 0.002, 0], [-0.001, scale, 0], [1e-5, 2e-5, 1.0]])
    homography[:2, 2] = -homography[:2, :2] @ middle
    return CameraGeometry(
        size_px=SIZE,
        centre_px=middle + np.array([4.0, -3.0]),
        radial=np.array(radial),
        homography=homography,
        rms_mm=0,
        held_out_mm=0,
    )


def pins(geometry, rows=7, columns=9, pitch_mm=1.6):
    x, y = np.meshgrid(np.arange(columns) - columns // 2, np.arange(rows) - rows // 2)
    return geometry.to_px(pitch_mm * np.stack([x, y], -1))


def picture(points, noise=1.0):
    """Dark spots on grey."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    image = np.full(SIZE, 150.0)
    for px, py in points.reshape(-1, 2):
        image -= 40 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 3.0**2))
    image += noise * np.random.default_rng(0).standard_normal(SIZE)
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("radial", [(0.0, 0.0), (2.0, 0.2), (-0.3, 0.0)])
def test_pixels_and_millimetres_are_inverse(radial):
    geometry = lens(radial)
    points = np.random.default_rng(1).uniform([0, 0], [SIZE[1], SIZE[0]], (200, 2))
    np.testing.assert_allclose(geometry.to_px(geometry.to_mm(points)), points, atol=1e-8)


@pytest.mark.parametrize("radial", [(2.0, 0.2), (-0.3, 0.0)])
def test_a_made_board_gives_its_lens_back(radial):
    true = lens(radial)
    found = find_pins(picture(pins(true)), np.full(SIZE, 150, np.uint8), rows=7, columns=9)
    np.testing.assert_allclose(found, pins(true), atol=0.3)
    fitted = fit_geometry(found, pitch_mm=1.6, size_px=SIZE)
    assert fitted.held_out_mm < 0.02
    assert fitted.mm_per_px == pytest.approx(true.mm_per_px, rel=0.01)
    inside = np.random.default_rng(2).uniform([60, 50], [260, 190], (100, 2))
    assert np.abs(fitted.to_mm(inside) - true.to_mm(inside)).max() < 0.03


def test_a_real_board():
    """9DTact, sensor 1: 7 × 9 pins 2.5 mm apart; its authors' scale at the middle is .0510 mm/px of 640 × 480."""
    sample, rest = (cv2.imread(str(BOARD / f"board_{name}.png"), cv2.IMREAD_GRAYSCALE) for name in ("sample", "ref"))
    found = find_pins(sample, rest, rows=7, columns=9)
    fitted = fit_geometry(found, pitch_mm=2.5, size_px=sample.shape)
    assert fitted.held_out_mm < 0.07
    assert fitted.mm_per_px * sample.shape[1] / 640 == pytest.approx(0.0510, rel=0.03)
    view = fitted.view(mm_per_px=0.08, size_px=(220, 290))
    again = find_pins(view(sample), view(rest), rows=7, columns=9)
    steps = np.diff(again, axis=1)[..., 0] * 0.08
    assert np.abs(steps - 2.5).max() < 0.35
    assert abs(steps.mean() - 2.5) < 0.03


def test_a_geometry_is_saved_and_loaded(tmp_path):
    lens().save(tmp_path / "g.json")
    loaded = CameraGeometry.load(tmp_path / "g.json")
    point = np.array([[10.0, 20.0]])
    np.testing.assert_array_equal(loaded.to_mm(point), lens().to_mm(point))
    (tmp_path / "g.json").write_text((tmp_path / "g.json").read_text().replace("0.06", "0.07", 1))
    refused(GeometryError, "is no geometry", CameraGeometry.load, tmp_path / "g.json")


@pytest.mark.parametrize(
    "change",
    [
        None,
        {"radial": [float("nan"), 0]},
        {"homography": [[1, 0], [0, 1]]},
        {"homography": [[0] * 3] * 3},
        {"size_px": ["a", 1]},
        {"size_px": [0, 8]},
    ],
)
def test_a_file_of_another_geometry_is_named(tmp_path, change):
    path = tmp_path / "g.json"
    lens().save(path)
    path.write_text("{}" if change is None else json.dumps(read_json(path) | change))
    refused(GeometryError, "is no geometry", CameraGeometry.load, path)


def test_bad_boards_are_refused():
    empty = np.full(SIZE, 150, np.uint8)
    points = pins(lens())
    refused(GeometryError, "must be of the background's", find_pins, empty, empty[:-1], rows=7, columns=9)
    refused(GeometryError, "of 63 pins", lambda: find_pins(picture(points[:4]), empty, rows=7, columns=9))
    refused(GeometryError, "press the board", lambda: find_pins(picture(points), empty, rows=9, columns=7))
    refused(GeometryError, "must be ≥ 4×4", fit_geometry, points[:3], pitch_mm=1.6, size_px=SIZE)
    with pytest.raises(GeometryError, match="measure the geometry in this mode"):
        lens().view(mm_per_px=0.1, size_px=(10, 10))(empty[:-1])


def test_no_flipped_bit_of_a_geometry_reads_as_another(tmp_path):
    path = tmp_path / "g.json"
    lens().save(path)
    content, whole = path.read_bytes(), CameraGeometry.load(path).hash
    for bit in range(0, 8 * len(content), 3):
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        try:
            assert CameraGeometry.load(path).hash == whole, bit
        except GeometryError:
            continue
