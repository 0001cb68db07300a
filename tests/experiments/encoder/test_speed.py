"""Programs whose differences say where the time goes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.encoder.speed import by_contact, parts
from tests.experiments import tiny
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.models.tactile_vit import TactileViT, TactileViTConfig
from touchr1_jax.training.dynamics import DynamicsConfig, encode_batch, read_frames
from touchr1_jax.types import TouchBatch

ENCODER = dataclasses.replace(tiny.MODEL.tactile, sensors=2, causal=True, num_layers=1, patches_kept=1)


def touched(p: int = 2, s: int = 2, f: int = 3, px: int = 28) -> TouchBatch:
    rng = np.random.default_rng(0)
    return TouchBatch(
        frames=jnp.asarray(rng.integers(0, 256, (p, s, f, px, px, 3), dtype=np.uint8)),
        force_n=jnp.ones((p, s, f, 3)),
        frame_index=jnp.tile(jnp.arange(f), (p, s, 1)),
        frame_mask=jnp.ones((p, s, f), bool),
        stream_mask=jnp.ones((p, s), bool),
        view=jnp.zeros((p, 1, 1, 3), jnp.uint8),
        view_mask=jnp.ones(p, bool),
        label=jnp.zeros((p, 4), jnp.int32),
    )


@pytest.mark.long
@pytest.mark.parametrize("rest", ["drop", "merge"])
def test_the_last_part_is_the_whole_encoder(rest):
    encoder: TactileViTConfig = dataclasses.replace(ENCODER, rest=rest, patch_cells=1, stem_px=14)
    networks = DynamicsConfig(encoder=encoder, predictor=PredictorConfig(), frames_kept=2)
    batch = touched()
    short = read_frames(networks, batch)
    streams = (short.frames, short.force_n, short.frame_index, short.frame_mask, jnp.zeros((2, 2), jnp.int32))
    params = jax.jit(TactileViT(encoder).init)(jax.random.key(0), *streams)["params"]
    programs = {name: make() for name, make in parts(networks, params, batch).items()}
    assert [p.gflop > 0 for p in programs.values()] == [True] * 4
    assert programs["transformer"].gflop > programs["time, force, pooling"].gflop
    whole = jax.jit(lambda b: encode_batch(encoder, params, read_frames(networks, b)))(batch)
    np.testing.assert_allclose(programs["transformer"].call(), whole, rtol=1e-4, atol=1e-5)


def test_arithmetic_is_that_of_all_contacts():
    """XLA counts a loop's body once: as many contacts must be so many times as much work, the products by hand."""
    weights = jnp.ones((5, 7))
    read = lambda w, b: jax.lax.map(lambda frames: frames.reshape(-1, 5) @ w, b.frames.astype(jnp.float32))
    few, many = (by_contact(read, weights, touched(p=p, px=10)) for p in (1, 4))
    rows = 2 * 3 * 10 * 10 * 3 // 5
    np.testing.assert_allclose(few.gflop, 2e-9 * rows * 5 * 7, rtol=0.1)  # and some for the cast to float
    np.testing.assert_allclose(many.gflop, 4 * few.gflop)
