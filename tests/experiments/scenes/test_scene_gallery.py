"""The gallery, shrunk: every sheet is drawn, and what it shows is what was asked for."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.scenes import scene_gallery
from sensors_io.records import RecordStore
from sensors_io.scenes import objects
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS
from tests.experiments.shrunk import run_shrunk

TINY = dataclasses.replace(
    scene_gallery.SMOKE,
    views=3,
    columns=2,
    image_px=28,
    protocol=SceneConfig(objects=2, sequences=4 * 14, frames=20, contact_grid=24, solver_tolerance=1e-2),
)


@pytest.mark.slow
def test_sheets_without_a_solver_are_drawn() -> None:
    for sheet in (*scene_gallery.views(TINY), *scene_gallery.varied(TINY)):
        assert sheet.content.startswith(b"\x89PNG")
    (ranges,) = scene_gallery.ranges(TINY)
    assert all(name.encode() in ranges.content for name in ("hardness", "elasticity", "friction"))


def test_a_press_is_a_row_per_sensor(records: Path) -> None:
    contact = RecordStore(records).contact(0)
    sheet = scene_gallery.press_sheet([contact[sensor] for sensor in SENSORS], 3)
    image = cv2.imdecode(np.frombuffer(sheet.content, np.uint8), cv2.IMREAD_COLOR)
    assert sheet.name == "press-3"
    assert image.shape[0] == pytest.approx(150 * (0.25 + 6 * 1.25), abs=1)


@pytest.mark.slow  # compiles eight programs
def test_every_sheet_is_drawn(tmp_path: Path) -> None:
    directory = run_shrunk(scene_gallery, TINY, tmp_path)
    names = {path.name for path in (directory / "plots").iterdir()}
    assert names == {"views.png", "press-0.png", "motions.png", "varied.png", "properties.svg"}
    assert len(read_json(directory / "results.json")["tables"]) == 1


def test_arrows_point_along_the_displacement() -> None:
    still = np.zeros((4, 4))
    moved = np.zeros((4, 4, 2))
    moved[2, 1] = (0.5, 0.0)  # two cells to the right
    picture = scene_gallery.field_picture(still, moved, 1.0, px=80)
    assert picture[50, 40:68].min() > 200
    assert picture[50, 75].max() < 60


def test_letters_of_a_uniform_object_are_all_the_same() -> None:
    solid = objects.sample(np.random.default_rng(0), 0.0, 0.8)
    blank = np.zeros((120, 120, 3), np.uint8)
    marked = scene_gallery.mark_levels(blank, solid)[..., 0]
    corner, centre = marked[8:32, 10:34], marked[48:72, 50:74]
    assert corner.max() > 100
    assert marked.sum() == pytest.approx(9 * centre.sum(), rel=0.01)


def test_odds_of_a_material_sum_to_all_and_beat_a_guess() -> None:
    table = scene_gallery.odds()
    *materials, right = table.rows
    assert len(materials) == 9
    for row in materials:
        assert all(sum(map(int, cell.split(" · "))) == pytest.approx(100, abs=1) for cell in row[1:])
    assert all(33 < float(cell) < 75 for cell in right[1:])
