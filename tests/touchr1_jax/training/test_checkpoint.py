"""Checkpoints: what comes back is what went in, and nothing half-written counts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.training.stepping import feed, start, step
from touchr1_jax.training.checkpoint import Checkpoints


def test_an_empty_directory_holds_none(tmp_path):
    with Checkpoints(tmp_path / "new") as checkpoints:
        assert checkpoints.latest() is None
        assert checkpoints.restore(start()) is None


def test_state_key_and_iterator_come_back(tmp_path):
    batches = feed()
    state, _ = step(start(), next(batches))
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state, batches.get_state())
    expected = next(batches)
    with Checkpoints(tmp_path) as checkpoints:
        found = checkpoints.restore(start())
    assert found.step == 1
    assert found.state.key == state.key
    for a, b in zip(jax.tree.leaves(found.state.params), jax.tree.leaves(state.params), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    assert jax.tree.structure(found.state) == jax.tree.structure(state)
    again = feed()
    again.set_state(found.data)
    np.testing.assert_array_equal(next(again), expected)


def test_newest_are_kept(tmp_path):
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        for n in range(1, 6):
            checkpoints.save(n, {"x": jnp.full(3, n)}, n)
    assert sorted(int(p.name) for p in tmp_path.iterdir() if p.name.isdigit()) == [4, 5]
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        found = checkpoints.restore({"x": jnp.zeros(3, jnp.int32)})
    assert (found.step, found.data) == (5, 5)
    np.testing.assert_array_equal(found.state["x"], 5)


def test_saved_arrays_are_those_of_the_call_not_of_later_steps(tmp_path):
    """The writer works in the background while the next step takes the buffers over."""
    state = start()
    batches = feed()
    with Checkpoints(tmp_path) as checkpoints:
        state, _ = step(state, next(batches))
        expected = np.asarray(state.params["w"]).copy()
        checkpoints.save(1, state, None)
        for _ in range(20):
            state, _ = step(state, next(batches))
    with Checkpoints(tmp_path) as checkpoints:
        np.testing.assert_array_equal(checkpoints.restore(start()).state.params["w"], expected)


def test_another_shape_is_an_error(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, {"w": jnp.arange(3.0)}, None)
    with Checkpoints(tmp_path) as checkpoints, pytest.raises(ValueError, match="shape"):
        checkpoints.restore({"w": jnp.zeros(4)})


def test_another_tree_is_an_error(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, {"w": jnp.arange(3.0)}, None)
    with Checkpoints(tmp_path) as checkpoints, pytest.raises(ValueError, match="v"):
        checkpoints.restore({"v": jnp.zeros(3)})


def test_a_save_that_was_cut_off_does_not_count(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, {"w": jnp.arange(3.0)}, None)
    (tmp_path / "2.orbax-checkpoint-tmp").mkdir()
    (tmp_path / "2.orbax-checkpoint-tmp" / "state").mkdir()
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest() == 1
        assert checkpoints.restore({"w": jnp.zeros(3)}).step == 1
