"""Stage 1 as a stage: it resumes bit for bit, measures once, and others start from it."""

import dataclasses
import io

import jax
import numpy as np
import pytest
from rich.console import Console

from experiments.core.context import Context, read_metrics
from experiments.encoder import pretrain as module
from experiments.encoder.data import StageOneDataConfig, watched
from experiments.encoder.pretrain import PretrainConfig, encoder_of, pretrain, starting_from, untrained
from experiments.encoder.variants import STUDIED, FieldsOnly, variants
from sensors_io.pipeline import make_clip
from tests.experiments import tiny
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.training.evidence import ProbeConfig

CONFIG = PretrainConfig(
    encoder=dataclasses.replace(tiny.MODEL.tactile, causal=True),
    predictor=PredictorConfig(width=8, num_layers=1, num_heads=2),
    image_px=28,
    steps=4,
    batch_size=2,
    probe_every=2,
)
TOUCH = StageOneDataConfig(probe_fit=6, probe=ProbeConfig(folds=2, iterations=3))


class Stop(RuntimeError):
    """The machine went away."""


def run(data, context, **options):
    rows = data.parts["sft"]
    return pretrain(CONFIG, data.store, rows, data.clip, context, stage="dynamics/0", seed=0, **options)


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """An uninterrupted run: its state and its lines."""
    directory = tmp_path_factory.mktemp("whole")
    context = Context(directory, directory, Console(file=io.StringIO()))
    state = run(data, context, watched=watched(data, "test", TOUCH))
    context.close()
    return state, read_metrics(directory)


def test_it_measures_before_during_and_after(whole):
    lines = [line for line in whole[1] if line["stage"] == "probe/0"]
    assert [line["step"] for line in lines] == [0, 2, 4]
    assert "probe_lead" not in lines[0]
    np.testing.assert_allclose(lines[2]["probe_lead"], lines[2]["probe"] - lines[0]["probe"])
    assert [line["step"] for line in whole[1] if line["stage"] == "dynamics/0"] == [0, 1, 2, 3]


def test_a_stopped_run_goes_on_bit_for_bit(whole, data, context, monkeypatch):
    """It stops right after the first checkpoint, before that is measured."""
    calls = iter(range(9))
    measure = module._measure
    monkeypatch.setattr(module, "_measure", lambda *a: _raise() if next(calls) == 1 else measure(*a))
    with pytest.raises(Stop):
        run(data, context, watched=watched(data, "test", TOUCH))
    monkeypatch.setattr(module, "_measure", measure)
    state = run(data, context, watched=watched(data, "test", TOUCH))
    for a, b in zip(jax.tree.leaves(state.params), jax.tree.leaves(whole[0].params), strict=True):
        np.testing.assert_array_equal(a, b)
    key = lambda line: (line["stage"], line["step"])
    assert sorted(read_metrics(context.directory), key=key) == sorted(whole[1], key=key)


def _raise():
    raise Stop


def test_training_can_start_from_an_encoder(whole, data):
    encoder = encoder_of(CONFIG, whole[0], data.clip.sensors)
    fresh = untrained(CONFIG, data.store, data.parts["sft"], data.clip, 0)
    state = starting_from(fresh, encoder)
    for a, b in zip(jax.tree.leaves(state.params["encoder"]), jax.tree.leaves(whole[0].target), strict=True):
        np.testing.assert_array_equal(a, b)
    narrow = dataclasses.replace(encoder, params={**encoder.params, "norm": {"scale": np.ones(3)}})
    with pytest.raises(ValueError, match="start has shapes"):
        starting_from(fresh, narrow)


def test_fields_take_the_place_of_pictures(data):
    fields = FieldsOnly(data.store)
    clip = make_clip(fields.contact(0, fields=False), data.store.objects[data.object_ids[0]], data.clip)
    pictures = make_clip(data.store.contact(0), data.store.objects[data.object_ids[0]], data.clip)
    assert clip.frames.shape == pictures.frames.shape
    assert (clip.frames[0] != pictures.frames[0]).any()
    np.testing.assert_array_equal(clip.force_n, pictures.force_n)
    assert len(fields) == len(data.store)


def test_variants_say_how_many_tokens_they_have():
    tokens = {v.name: v.tokens for v in variants(PretrainConfig(frames=8))}
    assert tokens["256 tokens"] == 256
    assert tokens["128 tokens"] == 128
    assert tokens["64 tokens"] == tokens["4 frames by salience"] == tokens["56²"] == tokens["fields"] == 64
    assert tokens["8 patches"] == tokens["32 tokens"] == tokens["4 frames, 8 patches"] == 32
    assert (tokens["4 patches"], tokens["4 patches and the rest"]) == (16, 20)


def test_one_variant_is_the_encoder_of_the_studies():
    studied = next(v.config for v in variants(PretrainConfig(frames=8)) if v.name == STUDIED)
    assert (studied.encoder, studied.frames_kept) == (PretrainConfig().encoder, PretrainConfig().frames)
