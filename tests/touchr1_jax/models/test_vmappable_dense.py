"""The product with a weight matrix: what `dot_general` gives, under every transformation, and what becomes of it."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from jax.extend.core import jaxprs_in_params

from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.models.layers import mrope
from touchr1_jax.models.lm import DecoderConfig, DecoderLayer, Rematerialised
from touchr1_jax.models.vmappable_dense import Dense, Embed, linear, linear_p, product_with_weights

pytestmark = pytest.mark.long

DECODER = DecoderConfig(vocab_size=16)
RNG = np.random.default_rng(0)
X, W = (jnp.asarray(RNG.normal(size=shape), jnp.float32) for shape in ((2, 3, 5, 4), (4, 6)))


def value(product, w, x):
    """A function of the product that is not linear, of all sequences at once or of each by itself."""
    return jnp.sum(jnp.sin(product(x, w)))


def batched(product, w, x):
    return jnp.sum(jax.vmap(jax.vmap(lambda one: jnp.sin(product(one, w))))(x))


@pytest.mark.parametrize("of", [value, batched])
@pytest.mark.parametrize("weight", [W, W[:, :3]], ids=["wider", "narrower"])
def test_value_and_gradients_are_those_of_the_plain_product(of, weight):
    ours, theirs = (jax.value_and_grad(lambda w, x, p=p: of(p, w, x), (0, 1))(weight, X) for p in (linear, jnp.matmul))
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_gradients_by_example_stay_apart():
    """`vmap` of `grad`, where a sum over the batch would go unnoticed by shape alone."""
    ours, theirs = (
        jax.vmap(jax.grad(lambda w, x, p=p: value(p, w, x)), in_axes=(None, 0))(W, X) for p in (linear, jnp.matmul)
    )
    assert ours.shape == (2, 4, 6)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def test_weights_may_be_batched_too():
    many = jnp.stack([W, 2 * W, -W])
    np.testing.assert_allclose(
        jax.vmap(linear, in_axes=(None, 0))(X, many), jax.vmap(jnp.matmul, in_axes=(None, 0))(X, many), rtol=1e-6
    )
    pairs = jax.vmap(linear, in_axes=(1, 0))(X, many)
    np.testing.assert_allclose(pairs, jax.vmap(jnp.matmul, in_axes=(1, 0))(X, many), rtol=1e-6)


def test_tangents_and_second_derivatives():
    ours, theirs = (jax.hessian(lambda w, p=p: value(p, w, X[0, 0]))(W) for p in (linear, jnp.matmul))
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


def test_the_weight_gradient_is_one_contraction_over_all_rows():
    """What the primitive is for: not one over the batch axes of every `vmap`."""
    jaxpr = str(jax.make_jaxpr(jax.grad(lambda w: batched(linear, w, X)))(W))
    (found,) = re.findall(r"dot_general\[\s*dimension_numbers=\(\(\[(.*?)\], \[(.*?)\]\)", jaxpr)
    assert found == ("0", "0")
    plain = str(jax.make_jaxpr(jax.grad(lambda w: batched(jnp.matmul, w, X)))(W))
    assert "[0, 1, 2], [0, 1, 2]" in plain


def products(jaxpr) -> int:
    """How often a program multiplies with weights, in all that it calls."""
    inner = [jaxpr for eqn in jaxpr.eqns for jaxpr in jaxprs_in_params(eqn.params)]
    return sum(eqn.primitive is linear_p for eqn in jaxpr.eqns) + sum(map(products, inner))


def test_rematerialised_layers_multiply_with_no_weight_twice():
    """The backward pass keeps what they make of weights; of a policy that keeps nothing the count is larger."""
    x, mask = jnp.ones((5, DECODER.hidden_size)), jnp.ones(5, bool)
    rotation = mrope(jnp.zeros((3, 5), jnp.int32), DECODER.head_dim, DECODER.mrope_section, DECODER.rope_theta)
    nothing = nn.remat(DecoderLayer, methods=("over_prompt",))
    found = []
    for kind in (DecoderLayer, Rematerialised, nothing):
        layer = kind(DECODER)
        init = lambda key, layer=layer: layer.init(key, x, rotation, mask, method="over_prompt")
        params = draw_params(jax.eval_shape(init, jax.random.key(0)))
        cost = lambda p, layer=layer: jnp.sum(layer.apply(p, x, rotation, mask, method="over_prompt")[0] ** 2)
        found.append(products(jax.make_jaxpr(jax.grad(cost))(params).jaxpr))
    assert found[0] == found[1] < found[2]


@pytest.mark.parametrize(("outputs", "repeated"), [(8, 0), (9, 1)])
def test_a_product_with_few_inputs_and_many_outputs_is_repeated(outputs, repeated):
    """As the second of an adapter, x A B with A [4, 1] and B [1, o]: x A is kept, (x A) B is not."""
    a, b = jnp.ones((4, 1)), jnp.ones((1, outputs))
    f = lambda x: jnp.sum(jnp.sin(linear(linear(x, a), b)))
    count = lambda f: products(jax.make_jaxpr(jax.grad(f))(X).jaxpr)
    assert count(jax.checkpoint(f, policy=product_with_weights)) == count(f) + repeated


def test_types_are_joined_and_kept():
    assert linear(X.astype(jnp.bfloat16), W.astype(jnp.bfloat16)).dtype == jnp.bfloat16
    assert linear(X.astype(jnp.bfloat16), W).dtype == jnp.float32


@pytest.mark.parametrize("shape", [(5, 6), (4,), (4, 6, 1)])
def test_shapes_that_do_not_fit_are_refused(shape):
    with pytest.raises(ValueError, match=r"must be \[\*n, i\] and \[i, o\]"):
        linear.__wrapped__(X, jnp.zeros(shape))


def test_the_dense_layer_is_flax_s():
    key = jax.random.key(0)
    ours, theirs = Dense(6), nn.Dense(6)
    params = theirs.init(key, X)
    assert jax.tree.map(jnp.shape, ours.init(key, X)) == jax.tree.map(jnp.shape, params)
    np.testing.assert_allclose(ours.apply(params, X), theirs.apply(params, X), rtol=1e-6)


def test_logits_of_the_table_are_flax_s():
    key, query = jax.random.key(0), X
    ours, theirs = Embed(9, 4), nn.Embed(9, 4)
    params = theirs.init(key, jnp.zeros(2, jnp.int32))
    np.testing.assert_allclose(
        ours.apply(params, query, method="attend"), theirs.apply(params, query, method="attend"), rtol=1e-6
    )
