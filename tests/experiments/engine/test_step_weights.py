"""Steps of released shapes: their arguments in shapes alone, and the experiment on a tiny one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.engine import step_weights
from experiments.engine.load_checkpoints import SHAPES
from experiments.engine.step_shapes import StepShape, abstract_step, drawn
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.released_policy import ReleasedModel
from touchr1_jax.models.tactile_vit import TactileViTConfig

pytestmark = pytest.mark.long

TACTILE = TactileViTConfig(sensors=0, width=16, num_layers=1, num_heads=2, stem_width=4)
STEP = StepShape(
    tokens=4,
    text_tokens=8,
    lora=LoraConfig(rank=2),
    model=ReleasedModel(tactile=TACTILE, frames=2, image_px=28, view_px=56),
)


@pytest.mark.parametrize(("stage", "towers"), [("SFT", {"vision", "decoder"}), ("GRPO", {"decoder"})])
def test_what_is_frozen_is_bfloat16_and_what_is_trained_is_not(stage, towers):
    _, (state, *_, base) = abstract_step(SHAPES["3B"], STEP, stage)
    assert set(base) == towers
    assert {x.dtype for x in jax.tree.leaves(base)} == {jnp.dtype(jnp.bfloat16)}
    assert {x.dtype for x in jax.tree.leaves(state.params)} == {jnp.dtype(jnp.float32)}
    assert state.params["adapters"]["decoder"]["layers"]["q_proj"]["a"].shape == (35, 2048, 2)


def test_a_base_in_four_bits_has_three_tenths_of_the_bytes_of_bfloat16():
    size = lambda step: sum(
        x.size * x.dtype.itemsize for x in jax.tree.leaves(abstract_step(SHAPES["7B"], step, "SFT")[1][-1])
    )
    stored = dataclasses.replace(STEP, model=dataclasses.replace(STEP.model, four_bits=True))
    kernels = 28 * 3584 * (2 * 3584 + 2 * 512 + 3 * 18944)
    assert size(STEP) - size(stored) == kernels * (2 - 0.5 - 2 / 32)


def test_drawn_weights_are_small_and_scales_are_one():
    shape = lambda *n: jax.ShapeDtypeStruct(n, jnp.bfloat16)
    found = drawn({"kernel": shape(64, 32), "scale": shape(8), "ids": jax.ShapeDtypeStruct((4,), jnp.int32)})
    assert 0 < float(jnp.abs(found["kernel"]).max()) <= 0.0201
    assert len(np.unique(found["kernel"])) > 100
    assert (np.asarray(found["scale"]) == 1).all()
    assert (np.asarray(found["ids"]) == 0).all()


@pytest.mark.slow
def test_both_steps_run_on_a_tiny_shape(tmp_path):
    config = step_weights.StepWeightsConfig(size="tiny", shallow=0, step=STEP, run=True)
    results = read_json(run_shrunk(step_weights, config, tmp_path) / "results.json")
    assert [row[0] for row in results["tables"][0]["rows"]] == ["SFT", "GRPO"]
    assert len(results["requirements"]) == 6
