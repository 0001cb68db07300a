"""Stage 1 as a stage and on the command line, shrunk: it goes on where it stopped; a study starts from its encoder."""

import contextlib
import dataclasses

import jax
import numpy as np
import pytest
from rich.console import Console

from experiments.core.artifacts import read_json
from experiments.core.context import Context
from experiments.core.metric_log import read_metrics
from experiments.encoder import pretrain_encoder
from experiments.encoder.pretrain import StageOneDataConfig, held_out_contacts, pretrain
from experiments.study.seed import StudySeed
from experiments.study.training import starting_model
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.models.pretrained import load_encoder
from touchr1_jax.models.touch_policy import build_policy
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.training.pretraining import PretrainConfig

PRETRAIN = PretrainConfig(
    encoder=dataclasses.replace(tiny.MODEL.tactile, causal=True),
    predictor=PredictorConfig(width=8, num_layers=1, num_heads=2),
    image_px=28,
    steps=2,
    batch_size=2,
    probe_every=2,
)
DATA = StageOneDataConfig(scenes=tiny.SCENES, probe_fit=6, probe=ProbeConfig(folds=2, iterations=3))


class StoppedContext(Context):
    """A run that stops after the first checkpoint, before the measurement that follows it."""

    def done(self, stage):
        if stage == "probe/0/at2":
            raise KeyboardInterrupt
        return super().done(stage)


@pytest.mark.long
def test_a_stopped_run_goes_on_and_is_measured_before_during_and_after(data, tmp_path):
    held_out, config = held_out_contacts(data, "test", DATA), dataclasses.replace(PRETRAIN, steps=4)
    for kind in (StoppedContext, Context):
        context = kind(tmp_path, tmp_path, Console(quiet=True))
        order = {"stage": "dynamics/0", "seed": 0, "held_out": held_out}
        with contextlib.suppress(KeyboardInterrupt):
            pretrain(config, data.store, data.parts["sft"], data.clip, context, **order)
        context.close()
    logged = read_metrics(tmp_path)
    assert [line["step"] for line in logged if line["stage"] == "dynamics/0"] == [0, 1, 2, 3]
    before, during, after = (line for line in logged if line["stage"] == "probe/0")
    assert [before["step"], during["step"], after["step"]] == [0, 2, 4]
    assert "probe_lead" not in before
    np.testing.assert_allclose(after["probe_lead"], after["probe"] - before["probe"])


@pytest.fixture(scope="module")
def directory(tmp_path_factory, cache_dir):
    config = pretrain_encoder.PretrainEncoderConfig(touch=DATA, pretrain=PRETRAIN, watch_fit=6)
    return run_shrunk(pretrain_encoder, config, tmp_path_factory.mktemp("runs"), "--cache-dir", str(cache_dir))


@pytest.mark.long
def test_everything_is_reported(directory):
    results = read_json(directory / "results.json")
    names = [r["name"] for r in results["requirements"]]
    assert names == ["skill over copy-last", "probes over a random encoder"]
    assert [row[0] for row in results["tables"][0]["rows"]] == ["hardness", "roughness", "protrusion", "mean of three"]
    assert (directory / "plots" / "pretrain_encoder.svg").exists()
    assert load_encoder(directory).notes == {"steps": 2, "source": "generated"}


@pytest.mark.long
def test_a_study_starts_from_it(directory, data, context):
    """Before the first step of SFT its encoder is the pretrained one, causal as it was trained."""
    model, tactile = starting_model(tiny.STUDY.model, directory, data.clip.sensors)
    assert model.tactile.causal
    evidence = np.zeros((len(data.store), 4, 4, 9), np.float32)
    untouched = dataclasses.replace(tiny.STUDY.sft, steps=0)
    policy = build_policy(model, data.clip.sensors)
    seed = StudySeed(config=tiny.STUDY, data=data, policy=policy, evidence=evidence, context=context, seed=0)
    params = seed.run_sft(untouched, "sft", {"tactile": tactile})
    jax.tree.map(np.testing.assert_array_equal, params["tactile"], load_encoder(directory).params)
    assert starting_model(tiny.STUDY.model, None, data.clip.sensors) == (tiny.STUDY.model, None)
