"""Operations of programs by hand, and the time that they take."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.engine.feed_demand import count_flops


def of(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def test_a_product_is_two_operations_for_each_pair():
    assert count_flops(lambda a, b: jnp.tanh(a @ b) + 1, of(3, 4), of(4, 5)) == 2 * 3 * 4 * 5
    assert count_flops(lambda a, b: jnp.einsum("bij,bkj->bik", a, b), of(7, 3, 4), of(7, 5, 4)) == 7 * 2 * 3 * 4 * 5


def test_a_convolution_is_two_operations_for_each_weight_that_an_output_reads():
    dense = lambda x, w: jax.lax.conv_general_dilated(x, w, (2, 2), "VALID")
    grouped = lambda x, w: jax.lax.conv_general_dilated(x, w, (2, 2), "VALID", feature_group_count=3)
    assert count_flops(dense, of(2, 3, 9, 9), of(6, 3, 3, 3)) == 2 * (2 * 6 * 4 * 4) * (3 * 3 * 3)
    assert count_flops(grouped, of(2, 3, 9, 9), of(6, 1, 3, 3)) == 2 * (2 * 6 * 4 * 4) * (1 * 3 * 3)


def test_a_gradient_is_twice_its_function():
    loss = lambda w, x: jnp.sum(x @ w)
    assert count_flops(jax.grad(loss), of(4, 5), of(3, 4)) == 2 * 2 * 3 * 4 * 5
    assert count_flops(jax.grad(loss, (0, 1)), of(4, 5), of(3, 4)) == 3 * 2 * 3 * 4 * 5


def test_loops_count_as_often_as_they_turn_and_a_choice_as_its_longest_branch():
    turned = lambda x, w: jax.lax.scan(lambda c, _: (c @ w, None), x, None, length=11)[0]
    nested = lambda x, w: jax.lax.map(lambda y: turned(y, w), x)
    assert count_flops(turned, of(3, 4), of(4, 4)) == 11 * 2 * 3 * 4 * 4
    assert count_flops(jax.jit(nested), of(5, 3, 4), of(4, 4)) == 5 * 11 * 2 * 3 * 4 * 4
    chosen = lambda p, x, w: jax.lax.cond(p, lambda: x @ w, lambda: x @ w @ w)
    assert count_flops(chosen, jax.ShapeDtypeStruct((), jnp.bool_), of(3, 4), of(4, 4)) == 2 * 2 * 3 * 4 * 4


def test_recomputed_layers_count_again():
    layer = jax.checkpoint(lambda x, w: jnp.tanh(jnp.tanh(x @ w) @ w))
    loss = lambda x, w: jnp.sum(layer(x, w))
    plain, once = 2 * 2 * 4 * 4 * 4, 2 * 4 * 4 * 4
    assert count_flops(jax.grad(loss), of(4, 4), of(4, 4)) == pytest.approx(2 * plain + plain, abs=once)


def test_a_loop_of_unknown_length_is_refused():
    endless = lambda x, w: jax.lax.while_loop(lambda c: c[0, 0] < 1, lambda c: c @ w, x)
    with pytest.raises(ValueError, match="a product stands in a while loop"):
        count_flops(endless, of(3, 4), of(4, 4))


def test_nothing_runs():
    calls = []
    x = np.ones((3, 3), np.float32)
    count_flops(lambda a: jax.pure_callback(lambda v: calls.append(1) or v, a, a) @ a, x)
    assert not calls
