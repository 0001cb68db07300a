"""Layers against their equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchr1_jax.models.layers import MASKED, GatedMLP, KeySource, RMSNorm, attend, gated, mrope, rotate
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig

pytestmark = pytest.mark.long

RNG = np.random.default_rng(0)


def normal(*shape: int) -> jax.Array:
    return jnp.asarray(RNG.normal(size=shape), jnp.float32)


def test_rms_norm_by_hand():
    x = jnp.array([3.0, 4.0])  # mean square 12.5
    y = RMSNorm().apply({"params": {"scale": jnp.array([1.0, 2.0])}}, x)
    np.testing.assert_allclose(y, [3 / 12.5**0.5, 8 / 12.5**0.5], rtol=1e-6)


def test_rms_norm_computes_in_float32():
    """In bfloat16 the mean square of 1 … 1 and 1/64 would lose the small ones."""
    x = jnp.full(4096, 300.0, jnp.bfloat16)  # 300² overflows float16 and rounds in bfloat16
    y = RMSNorm().apply({"params": {"scale": jnp.ones(4096)}}, x)
    assert y.dtype == jnp.bfloat16
    np.testing.assert_allclose(y.astype(np.float32), 1.0, rtol=1e-2)


def test_gated_mlp_by_hand():
    weights = {"gate": [[1.0, -1.0]], "up": [[2.0, 3.0]], "down": [[1.0], [10.0]]}
    params = {name: {"kernel": jnp.array(w)} for name, w in weights.items()}
    y = GatedMLP(2).apply({"params": params}, jnp.array([[2.0]]))
    silu = lambda v: v / (1 + np.exp(-v))
    np.testing.assert_allclose(y, [[silu(2) * 4 + 10 * silu(-2) * 6]], rtol=1e-6)


def test_the_gradient_of_the_gate_is_that_of_its_equation():
    gate, up, weight = normal(50) * 4, normal(50), normal(50)
    plain = lambda gate, up: jnp.sum(weight * jax.nn.silu(gate) * up)
    found = jax.grad(lambda gate, up: jnp.sum(weight * gated(gate, up)), argnums=(0, 1))(gate, up)
    for mine, whole in zip(found, jax.grad(plain, argnums=(0, 1))(gate, up), strict=True):
        np.testing.assert_allclose(mine, whole, rtol=1e-5, atol=1e-6)


def test_mrope_angles_by_hand():
    """Head of 8: four frequencies 1, 100^-¼, 100^-½, 100^-¾; one follows time, one the row, two the column."""
    positions = jnp.array([[5, 0], [7, 0], [11, 0]])
    rotation = mrope(positions, 8, (1, 1, 2), 100.0)
    angle = np.array([5 * 1, 7 * 100**-0.25, 11 * 100**-0.5, 11 * 100**-0.75])
    np.testing.assert_allclose(rotation.cos[0], np.cos(angle), atol=1e-6)
    np.testing.assert_allclose(rotation.sin[0], np.sin(angle), atol=1e-6)
    np.testing.assert_array_equal(rotation.cos[1], 1)


@pytest.mark.parametrize("sections", [(1, 1, 1), (4,), (2, 2), (2, 2, 2)])
def test_mrope_sections_must_be_three_and_fill_half_a_head(sections):
    with pytest.raises(ValueError, match=r"must be three that sum to head_dim/2 = 4"):
        mrope(jnp.zeros((3, 1), jnp.int32), 8, sections, 1e4)


def test_rotation_of_a_unit_vector_by_hand():
    rotation = mrope(jnp.full((3, 1), 1), 4, (1, 1, 0), 100.0)
    np.testing.assert_allclose(
        rotate(jnp.array([[[1.0, 0, 0, 1.0]]]), rotation)[0, 0],
        [np.cos(1), -np.sin(0.1), np.sin(1), np.cos(0.1)],
        atol=1e-6,
    )


@given(shift=st.integers(0, 200), gap=st.tuples(*[st.integers(-20, 20)] * 3))
@settings(max_examples=20, deadline=None)
def test_scores_depend_on_the_difference_of_positions_alone(shift, gap):
    q, k = np.random.default_rng(1).normal(size=(2, 1, 8)).astype(np.float32)
    at = lambda x, p: rotate(jnp.asarray(x)[None], mrope(jnp.asarray(p)[:, None], 8, (1, 1, 2), 1e4))[0]
    score = lambda base: at(q, np.full(3, base)) @ at(k, base + np.array(gap)).T
    np.testing.assert_allclose(score(30), score(30 + shift), atol=2e-4)


def test_attend_over_blocks_is_attention_over_their_union():
    """Oracle: one softmax over the concatenated keys, head by head; query head h reads key head h // 2."""
    t, kv, r, d, sizes = 3, 2, 2, 4, (5, 3)
    q = normal(t, kv, r, d)
    blocks = [(normal(kv, n, d), normal(kv, n, d)) for n in sizes]
    masks = [jnp.asarray(RNG.random(sizes[0]) < 0.6), jnp.tril(jnp.ones((t, sizes[1]), bool))]
    ours = attend(q, [KeySource(k, v, m) for (k, v), m in zip(blocks, masks, strict=True)])
    keys, values = (jnp.concatenate([b[i] for b in blocks], 1) for i in (0, 1))
    mask = jnp.concatenate([jnp.broadcast_to(m, (t, n)) for m, n in zip(masks, sizes, strict=True)], 1)
    heads = []
    for h in range(kv * r):
        scores = q[:, h // r, h % r] @ keys[h // r].T / d**0.5
        heads.append(jax.nn.softmax(jnp.where(mask, scores, -jnp.inf), -1) @ values[h // r])
    np.testing.assert_allclose(ours, jnp.concatenate(heads, -1), rtol=1e-5, atol=1e-6)


def test_attend_survives_scores_that_overflow_exp():
    k = jnp.array([[[200.0], [-200.0]]])
    out = attend(jnp.full((1, 1, 1, 1), 100.0), [KeySource(k, k, jnp.ones(2, bool))])
    np.testing.assert_allclose(out, [[200.0]])


def test_masked_keys_have_weight_and_gradient_exactly_zero():
    q, k, v = normal(2, 1, 1, 4), normal(1, 3, 4), normal(1, 3, 4)
    mask = jnp.array([True, False, True])
    gradient = jax.grad(lambda k, v: attend(q, [KeySource(k, v, mask)]).sum(), (0, 1))(k, v)
    for g in gradient:
        assert not g[:, 1].any()
        assert g[:, 0].any()


def test_two_masked_scores_differ_by_zero():
    assert jnp.float32(MASKED) - jnp.float32(MASKED) == 0
    assert 0 * jnp.float32(MASKED) == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DecoderConfig(vocab_size=0, num_heads=0), "num_heads is 0: must be at least 1"),
        (
            lambda: DecoderConfig(vocab_size=8, num_heads=3, num_kv_heads=2),
            "num_heads is 3: must be a multiple of num_kv_heads 2",
        ),
        (lambda: TactileViTConfig(sensors=1, width=97), "width 97 must be a multiple of num_heads 3"),
        (lambda: TactileViTConfig(sensors=1, patch_cells=0), "patch_cells is 0: must be at least 1"),
        (lambda: DecoderConfig(vocab_size=9, num_layers=0), "num_layers is 0: must lie in 1 … 1000"),
        (lambda: DecoderConfig(vocab_size=9, num_layers=10**9), "num_layers is 1000000000: must lie in 1 … 1000"),
        (lambda: TactileViTConfig(sensors=1, num_layers=10**9), "num_layers is 1000000000: must lie in 0 … 1000"),
        (lambda: VisionConfig(num_layers=-1), "num_layers is -1: must lie in 0 … 1000"),
        (lambda: VisionConfig(width=63), "width 63 must be a multiple of num_heads 2"),
        (lambda: VisionConfig(patch_px=13), "image_px 64 must be a multiple of 2 · patch_px = 26"),
    ],
)
def test_sizes_that_no_tower_has_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
