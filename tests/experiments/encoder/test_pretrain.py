"""Stage 1 as a stage and on the command line, shrunk: it resumes bit for bit, and a study starts from its encoder."""

import dataclasses
import io

import jax
import numpy as np
import pytest
from rich.console import Console

from experiments.core.artifacts import read_json
from experiments.core.context import Context, read_metrics
from experiments.encoder import pretrain_encoder
from experiments.encoder.pretrain import StageOneDataConfig, held_out_contacts, points, pretrain
from experiments.study.stages import run_sft
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


class Stop(RuntimeError):
    """The machine went away."""


class StoppedContext(Context):
    """A run that stops after the first checkpoint, before the measurement that follows it."""

    def done(self, stage):
        if stage == "probe/0/at2":
            raise Stop
        return super().done(stage)


def run(data, directory, context_class=Context):
    """Pretrain for four steps, measured every two; the state and the logged lines."""
    context = context_class(directory, directory, Console(file=io.StringIO()))
    held_out, config = held_out_contacts(data, "test", DATA), dataclasses.replace(PRETRAIN, steps=4)
    stage = {"stage": "dynamics/0", "seed": 0}
    try:
        state = pretrain(config, data.store, data.parts["sft"], data.clip, context, **stage, held_out=held_out)
    finally:
        context.close()
    return state, read_metrics(directory)


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    return run(data, tmp_path_factory.mktemp("whole"))


def test_it_measures_before_during_and_after(whole):
    lines = [line for line in whole[1] if line["stage"] == "probe/0"]
    assert [line["step"] for line in lines] == [0, 2, 4]
    assert "probe_lead" not in lines[0]
    np.testing.assert_allclose(lines[2]["probe_lead"], lines[2]["probe"] - lines[0]["probe"])
    assert [line["step"] for line in whole[1] if line["stage"] == "dynamics/0"] == [0, 1, 2, 3]


def test_a_stopped_run_resumes_bit_for_bit(whole, data, tmp_path):
    with pytest.raises(Stop):
        run(data, tmp_path, StoppedContext)
    state, lines = run(data, tmp_path)
    jax.tree.map(np.testing.assert_array_equal, state.params, whole[0].params)
    key = lambda line: (line["stage"], line["step"])
    assert sorted(lines, key=key) == sorted(whole[1], key=key)


@pytest.fixture(scope="module")
def directory(tmp_path_factory, cache_dir):
    config = pretrain_encoder.PretrainEncoderConfig(touch=DATA, pretrain=PRETRAIN, watch_fit=6)
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
    policy = build_policy(model, data.clip.sensors)
    params = run_sft(policy, data, evidence, untouched, context, seed=0, stage="sft/0", start={"tactile": tactile})
    jax.tree.map(np.testing.assert_array_equal, params["tactile"], load_encoder(directory).params)
    assert starting_model(tiny.STUDY.model, None, data.clip.sensors) == (tiny.STUDY.model, None)


def test_points_pool_attributes_by_object():
    found = points(np.array([[True, False], [True, True], [False, False]]), np.array([0, 0, 1]))
    assert (found.mean, found.low, found.high) == (50, 0, 75)
