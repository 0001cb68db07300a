"""Weights in four bits: codes against a search over all of them, a policy against one with the decoded matrices."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from tests.touchr1_jax import tiny
from tests.touchr1_jax.models.qwen import small_policy
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.rules import state_shardings
from touchr1_jax.models.lora import LoraConfig, init_adapters
from touchr1_jax.models.nf4 import BLOCK, QUANTILES, Nf4, encode, quantised
from touchr1_jax.models.stacked import ADAPTERS
from touchr1_jax.models.vmappable_dense import Dense

RNG = np.random.default_rng(0)
IS_NF4 = {"is_leaf": lambda x: isinstance(x, Nf4)}


def decoded(params):
    return jax.tree.map(lambda x: x.decode() if isinstance(x, Nf4) else x, params, **IS_NF4)


def test_quantiles_are_those_of_a_normal_distribution_with_an_exact_zero():
    """Dettmers et al. 2023, appendix E: 8 above 0 and 7 below at equal probabilities, over the largest."""
    quantile = lambda count: stats.norm.ppf(np.linspace(0.9677083, 0.5, count)[:-1])
    wanted = np.sort(np.concatenate([quantile(9), [0.0], -quantile(8)]))
    np.testing.assert_allclose(QUANTILES, wanted / wanted.max(), atol=1e-6)


@pytest.mark.parametrize("shape", [(64, 5), (3, BLOCK + 10, 4)])
def test_codes_are_the_nearest_of_all_sixteen(shape):
    w = RNG.standard_normal(shape).astype(np.float32)
    w[..., 0] = 0  # a column without any weight
    found = encode(jnp.asarray(w))
    assert (found.shape, found.dtype) == (shape, jnp.float32)
    scale = np.repeat(np.asarray(found.scale), BLOCK, -2)[..., : shape[-2], :]
    distance = np.abs(w[..., None] - QUANTILES * scale[..., None])
    wanted = np.take_along_axis(QUANTILES * scale[..., None], distance.argmin(-1)[..., None], -1)[..., 0]
    np.testing.assert_array_equal(found.decode(), wanted)
    blocks = [w[..., i : i + BLOCK, :] for i in range(0, shape[-2], BLOCK)]
    np.testing.assert_array_equal(found.scale, np.stack([np.abs(b).max(-2) for b in blocks], -2))


def test_bytes_of_a_matrix_of_bfloat16():
    found = jax.eval_shape(encode, jax.ShapeDtypeStruct((64, 8), jnp.bfloat16))
    assert [(x.shape, x.dtype) for x in found] == [((32, 8), jnp.uint8), ((2, 8), jnp.bfloat16)]


def test_an_odd_number_of_inputs_is_refused():
    with pytest.raises(ValueError, match="w has 3 inputs"):
        encode(jnp.ones((3, 2)))


def test_a_dense_layer_multiplies_with_the_decoded_matrix():
    x, w, b = (jnp.asarray(RNG.standard_normal(s), jnp.float32) for s in ((2, 3, 40), (40, 6), (6,)))
    layer, stored = Dense(6), encode(w)
    apply = lambda kernel, x: layer.apply({"params": {"kernel": kernel, "bias": b}}, x).sum()
    ours, theirs = (jax.value_and_grad(apply, argnums=1)(kernel, x) for kernel in (stored, stored.decode()))
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


@pytest.mark.long
def test_a_policy_and_its_adapters_see_the_decoded_matrices():
    lora = LoraConfig(rank=2)
    stored = quantised(small_policy.params())
    in_four = [x for x in jax.tree.leaves(stored, **IS_NF4) if isinstance(x, Nf4)]
    assert len(in_four) == 7 * small_policy.CONFIG.decoder.num_layers
    adapters = init_adapters(jax.random.key(0), {"decoder": stored["decoder"]}, lora)
    adapters = jax.tree.map(lambda x: x + 0.1, adapters)
    fns, layout = dataclasses.replace(small_policy.FNS, lora=lora), small_policy.LAYOUT
    features = jax.tree.map(lambda x: x[0], jax.jit(fns.encode)(stored, tiny.touch_batch()))
    prompt = jnp.asarray(layout.ids[0]), jnp.asarray(layout.mask[0]), jnp.zeros((2, 5), jnp.int32)

    def loss(adapters, base):
        on = dataclasses.replace(fns, base=base)
        logits = on.group_logits({ADAPTERS: adapters}, features, *prompt)
        return jax.nn.log_softmax(logits)[..., :9].sum()

    of = jax.jit(jax.value_and_grad(loss))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-5),
        of(adapters, stored),
        of(adapters, decoded(stored)),
    )


def test_both_parts_lie_on_a_mesh_as_the_matrix():
    kernel = jax.eval_shape(encode, jax.ShapeDtypeStruct((3, 64, 8), jnp.bfloat16))
    placed = state_shardings(MeshConfig(fsdp=2).abstract(), {"decoder": {"layers": {"q_proj": {"kernel": kernel}}}})
    assert [tuple(x.spec) for x in jax.tree.leaves(placed)] == [(None, "fsdp", "tensor")] * 2
