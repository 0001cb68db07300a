"""Parts of generated presses: bits of the unchanged ones, what each change changes; the study on synthetic videos."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.runner import run_experiment
from experiments.recordings import sim_to_real
from experiments.recordings.scene_presses import AS_GENERATED, VARIANTS, press_pictures
from sensors_io.calibration.calibrate import calibrate
from sensors_io.calibration.generated_presses import generated_presses
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.schedule import press_slot
from sensors_io.scenes.sequence import make_sequence
from tests.experiments.recordings.test_physiclear import source
from tests.experiments.shrunk import only_run

SCENES = SceneConfig(objects=6, sites=1, image_px=28, contact_grid=24)


@pytest.fixture(scope="module")
def unchanged():
    return press_pictures(SCENES, 1)


@pytest.mark.long
def test_unchanged_presses_are_those_of_the_records(unchanged):
    stored = make_sequence(SCENES, 1, press_slot(SCENES, 1), 0, 0)
    assert np.array_equal(unchanged, stored.frames)


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in VARIANTS if name != AS_GENERATED])
def test_every_change_changes_the_pictures_and_leaves_their_kind(name, unchanged):
    changed = press_pictures(SCENES, 1, VARIANTS[name])
    assert changed.dtype == np.uint8
    assert changed.std() > 0
    assert changed.shape != unchanged.shape or not np.array_equal(changed, unchanged)


@pytest.mark.slow
def test_the_study_compares_parts_and_inputs(tmp_path):
    balls = generated_presses(6.31, 12, 0)
    made, _ = calibrate(balls, tuple(map(str, range(len(balls)))), "gelsight_mini")
    wide = dataclasses.replace(made, background=np.repeat(made.background, 2, 1)[:, 53:-54])  # 160 × 213 px, 3 : 4
    wide.save(tmp_path / "cal.npz")
    small = dataclasses.replace(sim_to_real.EXPERIMENT, scales={"smoke": sim_to_real.SMOKE})
    places = ["--runs-dir", str(tmp_path / "runs"), "--cache-dir", str(tmp_path / "cache")]
    data = ["--data-dir", str(source(tmp_path / "in")), "--calibration", str(tmp_path / "cal.npz"), "--objects", "6"]
    assert run_experiment(small, ["--scale", "smoke", *data, *places], "") == 0
    directory = only_run(tmp_path / "runs", "sim_to_real")
    parts, inputs = read_json(directory / "results.json")["tables"]
    assert [row[0] for row in parts["rows"]] == [*VARIANTS, sim_to_real.NO_SCENES]
    assert [row[0] for row in inputs["rows"]] == [
        sim_to_real.WITH_COURSE, sim_to_real.PICTURES, sim_to_real.FIELDS, sim_to_real.BOTH
    ]  # fmt: skip
    assert all((directory / "plots" / f"{name}.svg").stat().st_size > 1000 for name in ("parts", "inputs"))
