"""Collapse, shrunk, and the failures and alarms of its outcomes."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.encoder import stability_encoder
from experiments.encoder.pretrain import StageOneDataConfig
from experiments.encoder.stability_encoder import ARMS, CollapseOutcome
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.training.linear_probe import ProbeConfig

TINY = dataclasses.replace(
    stability_encoder.SMOKE,
    touch=StageOneDataConfig(scenes=dataclasses.replace(tiny.SCENES, split_shares=(0.6, 0.2, 0.2))),
    encoder=dataclasses.replace(stability_encoder.DEFAULT.encoder, width=8, num_layers=0, stem_px=4, stem_width=2),
    batch_size=3,
    probe=ProbeConfig(folds=2, iterations=2),
)


@pytest.mark.slow
def test_every_arm_is_reported(tmp_path, cache_dir):
    directory = run_shrunk(stability_encoder, TINY, tmp_path, "--cache-dir", str(cache_dir))
    results = read_json(directory / "results.json")
    assert [row[0] for row in results["tables"][0]["rows"]] == [arm.name for arm in ARMS]
    assert (directory / "plots" / "stability_encoder.svg").exists()
    failed = {row[0]: row[5] for row in results["tables"][0]["rows"]}
    assert len(results["verdict"]) == 1 + sum(failed.get(arm.cures, 0) > 0 for arm in ARMS)


def test_failure_is_defined_at_the_end_and_alarms_during_training():
    """Seed 0 falls and recovers, seed 1 falls for good and keeps a third of its spread."""
    measured = {
        "kept": np.array([[0.2, 0.3, 0.9], [0.9, 0.4, 0.3]]),  # a fresh encoder raises no alarm
        "rank_share": np.full((2, 3), 0.5),
        "skill": np.full((2, 3), 0.3),
    }
    outcome = CollapseOutcome(arm=ARMS[0], measured=measured, kept=np.array([2.0, 0.3]), lead=np.array([-1.0, 0.0]))
    np.testing.assert_array_equal(outcome.failed, [False, True])
    np.testing.assert_array_equal(outcome.alarmed, [False, True])
    assert outcome.first_alarm(1) == 2
