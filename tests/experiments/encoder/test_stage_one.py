"""Stage 1 compared: measures of depth, choices on validation objects, and a shrunken run."""

import dataclasses

import numpy as np
import pytest

from experiments.encoder import stage_one
from experiments.encoder.pretrain import depth_measures
from experiments.encoder.stage_one import StageOneConfig, at_steps, chosen_steps, lead
from experiments.faults.trainings.small_study import MODEL, SCENES
from tests.experiments.shrunk import run_shrunk


def test_measures_of_depth_by_hand():
    """A dent of .4 mm in one of four nodes: its depth, rms .2, and the change along x and y at the one corner."""
    depth = np.zeros((1, 2, 2), np.float32)
    depth[0, 0, 0] = 0.4
    np.testing.assert_allclose(depth_measures(depth), [[0.4, 0.2, np.sqrt(0.32)]], rtol=1e-6)


def test_steps_are_chosen_for_each_number_of_labels_over_all_seeds():
    """Axes seed, count, steps, contact, attribute: with few labels short training is right, with many long."""
    right = np.zeros((2, 2, 2, 3, 3), bool)
    right[:, 0, 0], right[:, 1, 1] = True, True
    right[0, 0, 1, :2] = True
    steps = chosen_steps(right)
    assert list(steps) == [0, 1]
    assert at_steps(right, steps).shape == (2, 2, 3, 3)
    assert at_steps(right, steps).all()


def test_a_lead_pairs_contacts_and_is_in_points():
    a, b = np.ones((2, 1, 4, 3)), np.zeros((2, 1, 4, 3))
    b[:, :, :2] = 1
    found = lead(a, b, np.array([0, 0, 1, 1]))
    assert found.mean == 50
    assert (found.low, found.high) == (0, 100)


@pytest.mark.parametrize("change", [{"labelled": (30, 10)}, {"labelled": ()}, {"tune_steps": (0, 5)}, {"seeds": 0}])
def test_bad_settings_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        dataclasses.replace(StageOneConfig(), **change)


@pytest.mark.slow
def test_a_shrunken_run_writes_its_curves_and_encoders(tmp_path, cache_dir):
    small = dataclasses.replace(
        stage_one.SMOKE,
        touch=dataclasses.replace(stage_one.SMOKE.touch, scenes=SCENES),
        pretrain=dataclasses.replace(
            stage_one.SMOKE.pretrain,
            encoder=dataclasses.replace(MODEL.tactile, causal=True),
            frames=MODEL.frames,
            image_px=MODEL.image_px,
            steps=1,
            probe_every=1,
        ),
        labelled=(3, 5),
    )
    run = run_shrunk(stage_one, small, tmp_path, "--cache-dir", str(cache_dir))
    assert {path.stem for path in (run / "encoders").iterdir()} == {
        f"{method}-{seed}" for method in ("contrast", "physics") for seed in range(2)
    }
    assert (run / "results.json").exists()
