"""States and batches on a mesh of one device; `test_training` uses several."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.distributed.problems import ROWS, feed, words
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.placement import DeviceMesh, local_rows, place_batch, place_state, shard_step
from touchr1_jax.training.loop import SingleDevice

MESH = MeshConfig().build(jax.devices()[:1])


def test_a_single_process_reads_all_rows():
    np.testing.assert_array_equal(local_rows(MESH, 6), np.arange(6))


def test_a_placed_batch_is_what_was_read():
    rows = {"ids": np.arange(12).reshape(6, 2), "mask": np.arange(6) > 3}
    placed = place_batch(MESH, rows, 6)
    jax.tree.map(np.testing.assert_array_equal, placed, rows)


def test_other_rows_than_its_own_are_an_error():
    with pytest.raises(ValueError, match=r"batch ids has shape \(4, 2\): must have the 6 rows of `local_rows`"):
        place_batch(MESH, {"ids": np.zeros((4, 2))}, 6)


def test_a_placed_state_has_buffers_of_its_own():
    """A step gives those of its state away."""
    state = {"scale": jnp.ones(4), "step": jnp.int32(0), "key": jax.random.key(3)}
    step = shard_step(lambda s, b: ({**s, "step": s["step"] + 1}, {}), MESH, state, {"ids": np.zeros(2)})
    after, _ = step(place_state(MESH, state), {"ids": np.zeros(2)})
    after, _ = step(after, {"ids": np.zeros(2)})
    assert (int(state["step"]), int(after["step"])) == (0, 2)
    assert after["key"] == state["key"]


@pytest.mark.long
def test_a_stage_on_a_mesh_computes_what_one_device_does_and_compiles_its_step_once():
    problem, devices, traced = words(), DeviceMesh(MESH), []

    @jax.jit
    def step(state, batch):
        traced.append(batch)
        return problem.step(state, batch)

    losses = []
    for where in (SingleDevice(), devices, devices):
        state = jax.tree.map(jnp.copy, problem.state)
        placed, state, batches = where.shard(step, state, feed(problem), ROWS)
        losses.append([])
        for _ in range(3):
            state, metrics = placed(state, next(batches))
            losses[-1].append(float(metrics["loss"]))
        assert jax.tree.structure(where.gather(state.params)) == jax.tree.structure(problem.state.params)
    np.testing.assert_allclose(losses[1], losses[0], atol=1e-6)
    assert losses[1] == losses[2]
    assert len(traced) == 2  # on one device, on the mesh
    assert devices.local_rows(ROWS).tolist() == list(range(ROWS))
