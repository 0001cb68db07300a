"""The tactile encoder: which pixels and frames reach which token."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.tactile_vit import (
    QueryPool,
    TactileViT,
    TactileViTConfig,
    force_features,
    patch_tokens,
    sinusoid,
)

CONFIG = dataclasses.replace(tiny.CONFIG.tactile, patch_cells=2, stem_px=2)  # patches of 4 px
F, H, W = 4, 8, 12


class Patches(nn.Module):
    """`patch_tokens` as a module."""

    config: TactileViTConfig = CONFIG

    @nn.compact
    def __call__(self, frames):
        return patch_tokens(frames, self.config)


@pytest.fixture(scope="module", params=["energy", "linear"])
def patches(request):
    """Jitted frames [F, H, W, 3] → tokens [step, patch, D], of either stem."""
    module = Patches(dataclasses.replace(CONFIG, stem=request.param))
    frames = jnp.zeros((F, H, W, 3))
    params = module.init(jax.random.key(0), frames)
    return jax.jit(lambda x: module.apply(params, x))


@pytest.mark.long
def test_a_patch_sees_its_own_pixels_and_no_others(patches):
    """Patch p of a step lies in row p // 3, column p % 3 of the 4 px grid, in the two frames of its step."""
    rng = np.random.default_rng(0)
    frames = rng.uniform(0, 255, (F, H, W, 3)).astype(np.float32)
    before = patches(frames)
    for f, y, x in [(2, 0, 0), (3, 3, 3), (2, 5, 11), (3, 7, 4)]:
        touched = frames.copy()
        touched[f, y, x] += 50
        changed = np.any(np.asarray(patches(touched) != before), -1)
        expected = np.zeros((2, 6), bool)
        expected[f // 2, y // 4 * 3 + x // 4] = True
        np.testing.assert_array_equal(changed, expected)


def test_a_stem_cell_is_a_square_of_pixels():
    """Cells of 2 px, four to a patch, row by row: one pixel moves the response of one cell."""
    module, frames = Patches(), np.zeros((F, H, W, 3), np.float32)
    params = module.init(jax.random.key(0), jnp.asarray(frames))

    def cells_of(x):
        _, state = module.apply(params, jnp.asarray(x), capture_intermediates=lambda m, _: m.name == "stem")
        return np.asarray(state["intermediates"]["stem"]["__call__"][0]).reshape(F, 6, 4, -1)

    for f, y, x in [(0, 1, 0), (1, 1, 3), (3, 6, 10)]:
        lit = frames.copy()
        lit[f, y, x, 1] = 255
        changed = np.any(cells_of(lit) != cells_of(frames), -1)
        expected = np.zeros((F, 6, 4), bool)
        expected[f, y // 4 * 3 + x // 4, y % 4 // 2 * 2 + x % 4 // 2] = True
        np.testing.assert_array_equal(changed, expected)


@pytest.mark.long
def test_the_first_frame_is_what_changes_are_measured_from(patches):
    frames = np.random.default_rng(1).uniform(0, 255, (F, H, W, 3)).astype(np.float32)
    touched = frames.copy()
    touched[0, 1, 1] += 50
    changed = np.any(np.asarray(patches(touched) != patches(frames)), -1)
    np.testing.assert_array_equal(changed, [[True] + [False] * 5] * 2)  # its patch, in every step


def test_the_plain_patch_embedding_by_hand():
    """Pixels and their change since the first frame, on a scale of −1 to 1, times one matrix."""
    module = Patches(dataclasses.replace(CONFIG, stem="linear"))
    frames = np.random.default_rng(2).uniform(0, 255, (F, H, W, 3)).astype(np.float32)
    params = module.init(jax.random.key(0), jnp.asarray(frames))
    kernel, bias = (np.asarray(params["params"]["patch"][name]) for name in ("kernel", "bias"))
    cells = lambda f: [frames[f, y : y + 2, 8 + x : 10 + x].ravel() / 127.5 - 1 for y in (4, 6) for x in (0, 2)]
    pixels, first = (np.concatenate(cells(f)) for f in (3, 0))
    third = np.concatenate(cells(2))
    row = np.concatenate([third, third - first, pixels, pixels - first])  # both frames of the second step
    np.testing.assert_allclose(module.apply(params, jnp.asarray(frames))[1, 5], row @ kernel + bias, rtol=1e-4)


@pytest.mark.parametrize("shape", [(4, 8, 10, 3), (4, 6, 12, 3), (3, 8, 12, 3)])
def test_frames_must_divide(shape):
    with pytest.raises(ValueError, match="must divide into 4 px patches and steps of 2; resize them"):
        Patches().init(jax.random.key(0), jnp.zeros(shape))


encode = jax.jit(
    lambda p, b: tiny.FNS.encode_streams(p, b.frames, b.force_n, b.frame_index, b.frame_mask, jnp.arange(2)[None])
)


def test_every_input_reaches_the_tokens():
    """Frames, force, frame indices, frame mask: a silently omitted one would not show in any loss."""
    batch, params = tiny.touch_batch(0), tiny.params()
    before = encode(params, batch)
    assert before.shape == (1, tiny.S, tiny.N, tiny.CONFIG.decoder.hidden_size)
    mask = batch.frame_mask.copy()
    mask[0, 0, 2:] = False
    changes = {
        "frames": 255 - batch.frames,
        "force_n": -batch.force_n,
        "frame_index": batch.frame_index + 7,
        "frame_mask": mask,
    }
    for name, value in changes.items():
        assert float(jnp.abs(encode(params, batch.replace(**{name: value})) - before).max()) > 1e-3, name


def test_frames_that_do_not_exist_hold_nothing():
    """Frames inside a step, the first of one, a whole step: other pixels, forces and indices there change no bit."""
    batch, params = tiny.touch_batch(0), tiny.params()
    mask = batch.frame_mask.copy()
    mask[0, 0, 1:3], mask[0, 1, 2:] = False, False
    short = batch.replace(frame_mask=mask)
    other = tiny.touch_batch(1)
    filled = short.replace(
        frames=np.where(mask[..., None, None, None], batch.frames, other.frames),
        force_n=np.where(mask[..., None], batch.force_n, other.force_n),
        frame_index=np.where(mask, batch.frame_index, 99),
    )
    ours, theirs = encode(params, short), encode(params, filled)
    np.testing.assert_array_equal(ours, theirs)
    assert not (ours == encode(params, batch)).all()


def test_sensors_have_embeddings_of_their_own():
    batch, params = tiny.touch_batch(0), tiny.params()
    same = jax.tree.map(lambda x: x.copy(), batch)
    same.frames[:, 1], same.force_n[:, 1], same.frame_index[:, 1] = (
        batch.frames[:, 0],
        batch.force_n[:, 0],
        batch.frame_index[:, 0],
    )
    tokens = encode(params, same)
    assert float(jnp.abs(tokens[:, 0] - tokens[:, 1]).max()) > 1e-3


def test_force_can_be_switched_off():
    config = dataclasses.replace(tiny.CONFIG, tactile=dataclasses.replace(tiny.CONFIG.tactile, use_force=False))
    batch = tiny.touch_batch(0)
    fns, params = tiny.make_fns(config), tiny.params()
    blind = {**params, "tactile": {k: v for k, v in params["tactile"].items() if not k.startswith("force")}}
    run = jax.jit(lambda b: fns.encode(blind, b).touch)
    np.testing.assert_array_equal(run(batch), run(batch.replace(force_n=-3 * batch.force_n)))


def test_force_features_by_hand():
    force = jnp.array([[0.0, 0, 0], [1.0, -2, -20]])
    np.testing.assert_allclose(
        force_features(force), [[0, 0, 0, 0, 0], [0.1, -0.2, -2, np.log(201) - 2, 1]], rtol=1e-6, atol=1e-7
    )


def test_sinusoid_tells_frame_indices_apart():
    rows = np.asarray(sinusoid(jnp.arange(90), 32))
    distance = np.linalg.norm(rows[:, None] - rows, axis=-1) + np.eye(90)
    assert distance.min() > 0.1


def test_pool_by_hand():
    """One query, two patches: softmax of q·k/√D over the patches, then their values."""
    params = {"query": jnp.array([[2.0]]), "kv": {"kernel": jnp.array([[1.0, 10.0]]), "bias": jnp.zeros(2)}}
    out = QueryPool(1).apply({"params": params}, jnp.array([[0.0], [1.0]]))
    p = 1 / (1 + np.exp(-2))
    np.testing.assert_allclose(out, [[10 * p]], rtol=1e-6)


WIDE = TactileViTConfig(sensors=2, width=8, num_layers=2, num_heads=2, stem_width=2, patch_cells=2, stem_px=2)


def encode_alone(config: TactileViTConfig, frames: np.ndarray, seed: int = 0):
    """Patch tokens and pooled tokens of one stream."""
    f = len(frames)
    streams = (jnp.zeros((f, 3)), jnp.arange(f), jnp.ones(f, bool), jnp.int32(0))
    module = TactileViT(config)
    params = jax.jit(module.init)(jax.random.key(seed), jnp.asarray(frames), *streams)
    return jax.jit(lambda x: module.apply(params, x, *streams, method=TactileViT.encode))(jnp.asarray(frames))


@pytest.mark.long
def test_a_causal_encoder_does_not_look_ahead():
    frames = np.random.default_rng(0).uniform(0, 255, (F, H, W, 3)).astype(np.float32)
    later = frames.copy()
    later[2:] = 255 - later[2:]
    for causal in (False, True):
        config = dataclasses.replace(WIDE, causal=causal)
        before, after = encode_alone(config, frames).pooled, encode_alone(config, later).pooled
        same = np.asarray(before == after).all((1, 2))
        np.testing.assert_array_equal(same, [causal, causal, False, False])


@pytest.mark.long
def test_kept_patches_are_the_busy_ones_in_their_places():
    """Two of six patches change: the others are never read, and the kept ones embed as they do among all."""
    frames = np.full((F, H, W, 3), 90.0, np.float32)
    frames[1:, :4, 4:8] += 60
    frames[2:, 4:, 8:] += 40
    shallow = dataclasses.replace(WIDE, num_layers=0)
    every = encode_alone(shallow, frames).patches
    kept = encode_alone(dataclasses.replace(shallow, patches_kept=2), frames).patches
    np.testing.assert_allclose(kept, every[:, [1, 5]], rtol=1e-5, atol=1e-6)
    dull = frames.copy()
    dull[:, 4:, :4] = 91
    np.testing.assert_array_equal(encode_alone(dataclasses.replace(shallow, patches_kept=2), dull).patches, kept)


@pytest.mark.long
def test_the_rest_is_one_more_token():
    frames = np.random.default_rng(0).uniform(0, 255, (F, H, W, 3)).astype(np.float32)
    merged = jax.eval_shape(lambda x: encode_alone(dataclasses.replace(WIDE, patches_kept=2, rest="merge"), x), frames)
    assert merged.patches.shape == (F, 3, WIDE.width)
    assert merged.pooled.shape == (F, WIDE.tokens_per_step, WIDE.width)


@pytest.mark.parametrize("count", [0, 7])
def test_more_patches_than_there_are_cannot_be_kept(count):
    with pytest.raises(ValueError, match=rf"patches_kept is {count}: must lie in 1\.\.6"):
        encode_alone(dataclasses.replace(WIDE, patches_kept=count), np.zeros((F, H, W, 3), np.float32))
