"""Stage 1 on the command line, shrunk, and a study that starts from what it leaves behind."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.encoder import pretrain_encoder
from experiments.encoder.data import StageOneDataConfig
from experiments.encoder.pretrain import PretrainConfig
from experiments.study.assembly import assemble
from experiments.study.pretrained import load_encoder
from experiments.study.stages import run_sft
from experiments.study.training import starting_model
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.training.evidence import ProbeConfig

TOUCH = StageOneDataConfig(scenes=tiny.SCENES, probe=ProbeConfig(folds=2, iterations=3))
PRETRAIN = PretrainConfig(
    encoder=dataclasses.replace(tiny.MODEL.tactile, causal=True),
    predictor=PredictorConfig(width=8, num_layers=1, num_heads=2),
    image_px=28,
    steps=2,
    batch_size=2,
    probe_every=2,
)


@pytest.fixture(scope="module")
def directory(tmp_path_factory, cache_dir):
    config = pretrain_encoder.PretrainEncoderConfig(touch=TOUCH, pretrain=PRETRAIN, watch_fit=6)
    return run_shrunk(pretrain_encoder, config, tmp_path_factory.mktemp("runs"), "--cache-dir", str(cache_dir))


def test_everything_is_reported(directory):
    results = read_json(directory / "results.json")
    names = [r["name"] for r in results["requirements"]]
    assert names == ["skill over copy-last", "probes over a random encoder"]
    assert [row[0] for row in results["tables"][0]["rows"]] == ["hardness", "roughness", "protrusion", "mean of three"]
    assert (directory / "plots" / "pretrain_encoder.svg").exists()
    assert load_encoder(directory).notes == {"steps": 2, "source": "generated"}


def test_a_study_starts_from_it(directory, data, context):
    """Before the first step of SFT its encoder is the pretrained one, causal as it was trained."""
    model, tactile = starting_model(tiny.STUDY.model, directory, data.clip.sensors)
    assert model.tactile.causal
    evidence = np.zeros((len(data.store), 4, 4, 9), np.float32)
    untouched = dataclasses.replace(tiny.STUDY.sft, steps=0)
    assembly = assemble(model, data.clip.sensors)
    params = run_sft(assembly, data, evidence, untouched, context, seed=0, stage="sft/0", tactile=tactile)
    wanted = load_encoder(directory).params
    assert jax.tree.structure(params["tactile"]) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(params["tactile"]), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(a, b)
    assert starting_model(tiny.STUDY.model, None, data.clip.sensors) == (tiny.STUDY.model, None)
