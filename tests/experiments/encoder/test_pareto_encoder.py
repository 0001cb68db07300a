"""Variants of the encoder: their tokens, the choice among them, the report of all, shrunk."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.encoder import pareto_encoder
from experiments.encoder.pareto_encoder import MeasuredVariant, choose, loss, part_table
from experiments.encoder.pretrain import StageOneDataConfig
from experiments.encoder.speed import CompiledProgram
from experiments.encoder.variants import REFERENCE, STUDIED, FieldsOnly, variants
from sensors_io.pipeline import make_clip
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.training.pretraining import PretrainConfig

VARIANTS = {v.name: v for v in variants(PretrainConfig(frames=8))}


def measured(name: str, seconds: float, choosing: list[bool], right: list[bool]) -> MeasuredVariant:
    answers = {"choosing": np.array(choosing)[:, None], "right": np.array(right)[:, None]}
    return MeasuredVariant(variant=VARIANTS[name], **answers, seconds=seconds, gflop=1.0)


def test_the_fastest_within_a_point_on_validation_is_chosen_whatever_the_test_says():
    eight, seven = [True] * 8 + [False] * 2, [True] * 7 + [False] * 3
    found = {
        REFERENCE: measured(REFERENCE, 0.4, eight, eight),
        "64 tokens": measured("64 tokens", 0.05, eight, seven),
        "32 tokens": measured("32 tokens", 0.01, seven, seven),
    }
    assert choose(found).variant.name == "64 tokens"
    assert choose(found).rate == 160
    lost = loss(found["32 tokens"], found, np.arange(10))
    assert lost.mean == 10
    assert lost.low <= 10 <= lost.high


def test_parts_add_up_to_the_whole():
    best = measured("64 tokens", 0.008, [True], [True])
    pieces = {name: CompiledProgram(call=list, gflop=work) for name, work in (("a", 0.1), ("b", 0.5), ("c", 0.6))}
    table = part_table(best, pieces, {"a": 0.002, "b": 0.006, "c": 0.008}, 200.0)
    assert [round(row[2]) for row in table.rows] == [25, 50, 25]
    np.testing.assert_allclose([row[1] for row in table.rows], [0.25, 0.5, 0.25])
    np.testing.assert_allclose(table.rows[1][4], 0.4 / 0.004 / 200)


def test_fields_take_the_place_of_pictures(data):
    fields, card = FieldsOnly(data.store), data.store.objects[data.object_ids[0]]
    clip = make_clip(fields.contact(0, fields=False), card, data.clip)
    pictures = make_clip(data.store.contact(0), card, data.clip)
    assert clip.frames.shape == pictures.frames.shape
    assert (clip.frames[0] != pictures.frames[0]).any()
    np.testing.assert_array_equal(clip.force_n, pictures.force_n)
    assert len(fields) == len(data.store)


@pytest.mark.parametrize(
    ("tokens", "names"),
    [
        (256, {REFERENCE}),
        (128, {"128 tokens"}),
        (64, {"64 tokens", STUDIED, "56²", "width 48", "fields"}),
        (32, {"8 patches", "32 tokens", "4 frames, 8 patches"}),
        (16, {"4 patches"}),
        (20, {"4 patches and the rest"}),
    ],
)
def test_variants_have_their_tokens(tokens, names):
    assert {name for name, variant in VARIANTS.items() if variant.tokens == tokens} == names
    studied, default = VARIANTS[STUDIED].config, PretrainConfig()
    assert (studied.encoder, studied.frames_kept) == (default.encoder, default.frames)


@pytest.mark.slow
def test_every_variant_is_reported(tmp_path, cache_dir):
    config = pareto_encoder.ParetoEncoderConfig(
        touch=StageOneDataConfig(
            scenes=dataclasses.replace(tiny.SCENES, frames=8), probe=ProbeConfig(folds=2, iterations=2)
        ),
        pretrain=PretrainConfig(
            encoder=dataclasses.replace(PretrainConfig().encoder, width=12, num_layers=1),
            predictor=PredictorConfig(width=12, num_layers=1),
            frames=8,
            steps=1,
            batch_size=2,
            probe_every=1,
        ),
        rounds=1,
    )
    directory = run_shrunk(pareto_encoder, config, tmp_path, "--cache-dir", str(cache_dir))
    results = read_json(directory / "results.json")
    assert [row[0] for row in results["tables"][0]["rows"]] == list(VARIANTS)
    assert (directory / "plots" / "pareto_encoder.svg").exists()
