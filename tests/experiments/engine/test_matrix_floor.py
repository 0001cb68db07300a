"""Matrix products of a traced program, counted by hand and in the timed job."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from experiments.engine import speed_grpo
from experiments.engine.job import Job, config_of
from experiments.engine.matrix_floor import SHOWN, TimedProduct, floor_table, products, time_products

TINY = speed_grpo.SMOKE.size


def traced(size, prefix):
    return Job(size, prefix, config_of(size)).traced()


def program(x, w, keys):
    """Three rounds of [2, 4] · [4, 4], and in a loop that ends by its data 5 × ([2, 4] · [4, 3])."""
    x, _ = jax.lax.scan(lambda x, _: (x @ w, None), x, length=3)
    batched = lambda s: s + jnp.einsum("bk,nkm->nbm", x, keys).sum()
    return jax.lax.while_loop(lambda s: s < 1.0, batched, x.sum())


def test_products_are_counted_through_loops():
    traced = jax.make_jaxpr(program)(jnp.ones((2, 4)), jnp.ones((4, 4)), jnp.ones((5, 4, 3)))
    found = products(traced.jaxpr, loops=7)
    assert sorted(found.values()) == [3, 7]
    flops = {count: product.flops for product, count in found.items()}
    assert flops == {3: 2 * 2 * 4 * 4, 7: 2 * 5 * 2 * 4 * 3}


@pytest.mark.long
def test_the_work_of_the_job_grows_with_the_prefix_as_it_must():
    """Of the last of four layers the prompt needs keys and values alone: at most a quarter less than by its tokens."""
    size = dataclasses.replace(TINY, num_layers=4)
    work = lambda prefix: sum(n * p.flops for p, n in products(traced(size, prefix), size.length).items())
    grown, needed = work(80) - work(16), 1e9 * (size.gflop(80) - size.gflop(16))
    assert 0.75 * needed <= grown <= 1.1 * needed


def test_a_table_ends_with_the_rest_and_the_sum():
    found = [TimedProduct(str(i), 1, 2e9, 0.5 / (i + 1)) for i in range(SHOWN + 2)]
    rows = floor_table(64, found, 2.0).rows
    assert [row[0] for row in rows[-2:]] == ["2 others", "all"]
    assert rows[0] == ("0", 1, 2.0, 4.0, 500.0, 0.25)
    assert rows[-1][1:3] == (SHOWN + 2, pytest.approx(2.0 * (SHOWN + 2)))


@pytest.mark.long
def test_single_products_take_time():
    square = jax.make_jaxpr(lambda x: x @ x)(jnp.ones((4, 4)))
    (one,) = time_products(square.jaxpr, 1, rounds=2)
    assert (one.name, one.number, one.flops) == ("4 × 4 · 4 × 4", 1, 128.0)
    assert one.seconds > 0
