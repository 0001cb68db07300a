"""Time and cores that accelerators ask for, a simulated device, and the experiment, shrunken."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import pytest
from rich.console import Console

from experiments.core.context import Context
from experiments.engine import throughput_feed
from experiments.engine.matrix_floor import count_flops
from experiments.engine.throughput_feed import SMOKE, FeedScale, idle_share
from tests.experiments import tiny
from touchr1_jax.models.vmappable_dense import linear

STUDY = dataclasses.replace(tiny.STUDY, clip_memory_gib=0.0002)  # of a quarter of the clips, more or less


@pytest.fixture(scope="module")
def results(cache_dir, tmp_path_factory):
    scales = {"tiny": FeedScale(study=STUDY, devices=2, contacts=tiny.SCENES.objects)}
    context = Context(tmp_path_factory.mktemp("feed"), cache_dir, Console(quiet=True))
    findings = throughput_feed.run(dataclasses.replace(SMOKE, scales=scales), context)
    context.close()
    return findings


@pytest.mark.long
def test_every_feed_of_a_scale_is_held_to_the_bound(results):
    assert [r.name for r in results.requirements] == [
        "tiny, sft, memory: device stands still",
        "tiny, grpo, memory: device stands still",
    ]
    assert all(r.bound == 0.02 and 0 <= r.measured < 1 for r in results.requirements)


@pytest.mark.long
def test_cores_are_the_batch_over_the_step(results):
    (table,) = results.tables
    rows = [dict(zip((c.name for c in table.columns), row, strict=True)) for row in table.rows]
    assert [row["feed"] for row in rows] == ["tiny, sft, records", "tiny, sft, memory", "tiny, grpo, memory"]
    for row in rows:
        assert row["cores needed"] == pytest.approx(row["made in"] / row["step"])


def of(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def test_a_product_is_two_operations_for_each_pair():
    assert count_flops(lambda a, b: jnp.tanh(a @ b) + 1, of(3, 4), of(4, 5)) == 2 * 3 * 4 * 5
    assert count_flops(lambda a, b: jnp.einsum("bij,bkj->bik", a, b), of(7, 3, 4), of(7, 5, 4)) == 7 * 2 * 3 * 4 * 5


def test_a_dense_layer_is_a_product():
    """Also inside of `jit` and in the gradient, whose products for the input and for the weight are as large."""
    assert count_flops(jax.jit(linear), of(3, 4), of(4, 5)) == 2 * 3 * 4 * 5
    gradient = jax.grad(lambda x, w: jnp.sum(linear(x, w) ** 2), (0, 1))
    assert count_flops(gradient, of(3, 4), of(4, 5)) == 3 * 2 * 3 * 4 * 5


def test_a_convolution_is_two_operations_for_each_weight_that_an_output_reads():
    dense = lambda x, w: jax.lax.conv_general_dilated(x, w, (2, 2), "VALID")
    grouped = lambda x, w: jax.lax.conv_general_dilated(x, w, (2, 2), "VALID", feature_group_count=3)
    assert count_flops(dense, of(2, 3, 9, 9), of(6, 3, 3, 3)) == 2 * (2 * 6 * 4 * 4) * (3 * 3 * 3)
    assert count_flops(grouped, of(2, 3, 9, 9), of(6, 1, 3, 3)) == 2 * (2 * 6 * 4 * 4) * (1 * 3 * 3)


def test_loops_count_as_often_as_they_turn_and_a_choice_as_its_longest_branch():
    turned = lambda x, w: jax.lax.scan(lambda c, _: (c @ w, None), x, None, length=11)[0]
    nested = lambda x, w: jax.lax.map(lambda y: turned(y, w), x)
    assert count_flops(turned, of(3, 4), of(4, 4)) == 11 * 2 * 3 * 4 * 4
    assert count_flops(jax.jit(nested), of(5, 3, 4), of(4, 4)) == 5 * 11 * 2 * 3 * 4 * 4
    chosen = lambda p, x, w: jax.lax.cond(p, lambda: x @ w, lambda: x @ w @ w)
    assert count_flops(chosen, jax.ShapeDtypeStruct((), jnp.bool_), of(3, 4), of(4, 4)) == 2 * 2 * 3 * 4 * 4


def test_a_loop_of_unknown_length_is_refused():
    endless = lambda x, w: jax.lax.while_loop(lambda c: c[0, 0] < 1, lambda c: c @ w, x)
    with pytest.raises(ValueError, match="a product stands in a while loop"):
        count_flops(endless, of(3, 4), of(4, 4))


class SlowBatches:
    """Batches that take as many seconds as given, by sleeping."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def __iter__(self):
        return self

    def __next__(self):
        time.sleep(self.seconds)
        return {"x": bytes(8)}

    def get_state(self, state=None):
        return state

    set_state = get_state


@pytest.mark.long
@pytest.mark.parametrize(("batch_s", "step_s", "idle", "off"), [(0.0, 0.15, 0.0, 0.05), (0.3, 0.1, 2 / 3, 0.1)])
def test_a_device_stands_still_for_as_long_as_its_batch_is_late(context, batch_s, step_s, idle, off):
    assert idle_share(SlowBatches(batch_s), step_s, 6, context, "slow/0") == pytest.approx(idle, abs=off)
