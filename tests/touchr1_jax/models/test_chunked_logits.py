"""Rows in blocks are the rows at once, value and gradient, and what is made of them never exists together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.models.chunked_logits import MAX_LOGITS, by_blocks

N, D, V = 7, 5, 24


@pytest.fixture(scope="module")
def given():
    rng = np.random.default_rng(0)
    states, table = (jnp.asarray(rng.normal(0, 2, s), jnp.float32) for s in ((N, D), (V, D)))
    return {"state": states, "token": jnp.asarray(rng.integers(0, V, N))}, table


def log_prob(table):
    """Log-probability of each token, and whether it is the likeliest."""

    def f(rows):
        log_p = jax.nn.log_softmax(rows["state"] @ table.T)
        right = jnp.argmax(log_p, -1) == rows["token"]
        return {"log_prob": jnp.take_along_axis(log_p, rows["token"][:, None], 1)[:, 0], "right": right}

    return f


@pytest.mark.parametrize("most", [1, V, 3 * V, 4 * V + 1, 100 * V])
def test_blocks_of_any_size_give_the_same(given, most):
    """One row at a time, blocks that do not divide the rows, and all at once."""
    rows, table = given
    whole = log_prob(table)(rows)
    ours = jax.jit(lambda r: by_blocks(log_prob(table), r, width=V, most=most))(rows)
    np.testing.assert_allclose(ours["log_prob"], whole["log_prob"], rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(ours["right"], whole["right"])


def test_gradients_reach_the_rows_and_what_they_share(given):
    rows, table = given
    weight = jnp.asarray(np.random.default_rng(1).normal(size=N), jnp.float32)

    def total(states, w, most):
        found = by_blocks(log_prob(w), rows | {"state": states}, width=V, most=most)
        return jnp.sum(weight * found["log_prob"])

    whole, ours = (jax.jit(jax.grad(total, (0, 1)), static_argnums=2)(rows["state"], table, m) for m in (N * V, 2 * V))
    for a, b in zip(ours, whole, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_few_rows_are_given_over_as_they_are(given):
    """No loop and nothing computed twice, where all of it fits; a policy of some hundred words never pays."""
    rows, table = given
    whole, looped = (
        str(jax.make_jaxpr(lambda r, m=most: by_blocks(log_prob(table), r, width=V, most=m))(rows))
        for most in (N * V, N * V - 1)
    )
    assert "scan" not in whole
    assert "scan" in looped
    assert 8 * 64 * 512 < MAX_LOGITS < 512 * 152_064  # the timed job's logits; a language model's


def test_no_array_has_the_whole_vocabulary_for_every_row():
    """In the compiled value and gradient: [n, V] would be 40 MB, what is needed is far less."""
    n, d, v = 1000, 8, 10_000
    tokens = jnp.zeros(n, jnp.int32)

    def loss(states, table):
        rows = {"state": states, "token": tokens}
        return jnp.sum(by_blocks(log_prob(table), rows, width=v, most=50 * v)["log_prob"])

    shapes = (jax.ShapeDtypeStruct(s, jnp.float32) for s in ((n, d), (v, d)))
    memory = jax.jit(jax.grad(loss, (0, 1))).lower(*shapes).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 0.4 * 4 * n * v


@pytest.mark.parametrize(("width", "most"), [(0, 5), (5, 0)])
def test_bounds_below_one_are_refused(given, width, most):
    rows, table = given
    with pytest.raises(ValueError, match=f"width is {width} and most {most}: must be at least 1"):
        by_blocks(log_prob(table), rows, width=width, most=most)
