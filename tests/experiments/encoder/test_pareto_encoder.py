"""Variants of the encoder: their tokens, the choice among them, the report of all, shrunk."""

import numpy as np
import pytest

from experiments.encoder.pareto_encoder import MeasuredVariant, choose, loss, part_table
from experiments.encoder.speed import CompiledProgram
from experiments.encoder.variants import REFERENCE, STUDIED, variants
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
