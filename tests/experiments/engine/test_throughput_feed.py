"""Time and cores that accelerators ask for, a simulated device, and the experiment, shrunken."""

import dataclasses
import time

import grain
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


def convolved(groups):
    return lambda x, w: jax.lax.conv_general_dilated(x, w, (2, 2), "VALID", feature_group_count=groups)


def turned(x, w):
    return jax.lax.scan(lambda c, _: (c @ w, None), x, None, length=11)[0]


def counted(work, *shapes):
    return count_flops(work, *(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes))


@pytest.mark.parametrize(
    ("work", "shapes", "flops"),
    [
        (lambda a, b: jnp.tanh(a @ b) + 1, [(3, 4), (4, 5)], 2 * 3 * 4 * 5),
        (lambda a, b: jnp.einsum("bij,bkj->bik", a, b), [(7, 3, 4), (7, 5, 4)], 7 * 2 * 3 * 4 * 5),
        (jax.jit(linear), [(3, 4), (4, 5)], 2 * 3 * 4 * 5),
        (jax.grad(lambda x, w: jnp.sum(linear(x, w) ** 2), (0, 1)), [(3, 4), (4, 5)], 3 * 2 * 3 * 4 * 5),
        (convolved(1), [(2, 3, 9, 9), (6, 3, 3, 3)], 2 * (2 * 6 * 4 * 4) * (3 * 3 * 3)),
        (convolved(3), [(2, 3, 9, 9), (6, 1, 3, 3)], 2 * (2 * 6 * 4 * 4) * (1 * 3 * 3)),
        (turned, [(3, 4), (4, 4)], 11 * 2 * 3 * 4 * 4),
        (jax.jit(lambda x, w: jax.lax.map(lambda y: turned(y, w), x)), [(5, 3, 4), (4, 4)], 5 * 11 * 2 * 3 * 4 * 4),
        (
            lambda p, x, w: jax.lax.cond(p > 0, lambda: x @ w, lambda: x @ w @ w),
            [(), (3, 4), (4, 4)],
            2 * 2 * 3 * 4 * 4,
        ),
    ],
    ids=["product", "batch", "dense", "gradient", "convolution", "groups", "loop", "nested loop", "longest branch"],
)
def test_operations_by_hand(work, shapes, flops):
    assert counted(work, *shapes) == flops


def test_a_loop_of_unknown_length_is_refused():
    with pytest.raises(ValueError, match="a product stands in a while loop"):
        counted(lambda x, w: jax.lax.while_loop(lambda c: c[0, 0] < 1, lambda c: c @ w, x), (3, 4), (4, 4))


@pytest.mark.long
@pytest.mark.parametrize(("batch_s", "step_s", "idle", "off"), [(0.0, 0.15, 0.0, 0.05), (0.3, 0.1, 2 / 3, 0.1)])
def test_a_device_stands_still_for_as_long_as_its_batch_is_late(context, batch_s, step_s, idle, off):
    make = lambda i: time.sleep(batch_s) or {"x": bytes(8)}
    batches = grain.MapDataset.range(100).map(make).to_iter_dataset(grain.ReadOptions(num_threads=0))
    assert idle_share(iter(batches), step_s, 6, context, "slow/0") == pytest.approx(idle, abs=off)
