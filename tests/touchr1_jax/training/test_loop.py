"""Stopping and going on is the same as never stopping, bit for bit."""

import jax
import numpy as np
import pytest

from tests.touchr1_jax.training.stepping import feed, start, step
from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.loop import LoopConfig, fetch, fit

STEPS = 10
CONFIG = LoopConfig(steps=STEPS, save_every=3)


class Broken(RuntimeError):
    """The machine went away."""


class Failing:
    """Grain's iterator, until batch n."""

    def __init__(self, after: int) -> None:
        self._batches, self._left = feed(), after

    def __iter__(self):
        return self

    def __next__(self):
        if self._left == 0:
            raise Broken
        self._left -= 1
        return next(self._batches)

    def get_state(self):
        return self._batches.get_state()

    def set_state(self, state):
        self._batches.set_state(state)


def run(directory, batches, config: LoopConfig = CONFIG):
    """State at the end and the lines that were logged."""
    lines = []
    with Checkpoints(directory) as checkpoints:
        state = fit(step, start(), batches, config, checkpoints=checkpoints, log=lambda t, m: lines.append((t, m)))
    return state, lines


def arrays(state) -> list[np.ndarray]:
    return [
        np.asarray(jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(state)
    ]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("whole")


@pytest.fixture(scope="module")
def whole(home):
    return run(home, feed())


def test_lines_come_in_order_once_each_from_zero(whole):
    assert [t for t, _ in whole[1]] == list(range(STEPS))
    assert int(whole[0].step) == STEPS


def test_lines_belong_to_their_steps(whole):
    """They are fetched one step late: the batch that each of them names is the one of its own step."""
    batches = feed()
    assert [line["first"] for _, line in whole[1]] == [float(next(batches)[0]) for _ in range(STEPS)]


LATER = [pytest.param(after, marks=pytest.mark.slow) for after in (4, 9)]


@pytest.mark.parametrize("after", [1, 3, 8, *LATER])
def test_resumed_run_equals_the_uninterrupted_one(whole, tmp_path, after):
    """It breaks before, at and between the checkpoints at 3, 6 and 9; lines after the last one are written again."""
    with pytest.raises(Broken):
        run(tmp_path, Failing(after))
    with Checkpoints(tmp_path) as checkpoints:
        saved = checkpoints.latest() or 0
    assert saved == after // 3 * 3
    state, lines = run(tmp_path, feed())
    assert [t for t, _ in lines] == list(range(saved, STEPS))
    assert lines == whole[1][saved:]
    for a, b in zip(arrays(state), arrays(whole[0]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_two_breaks_are_as_good_as_none(whole, tmp_path):
    for after in (4, 5):  # the second one counts from the checkpoint at 3
        with pytest.raises(Broken):
            run(tmp_path, Failing(after))
    state, _ = run(tmp_path, feed())
    for a, b in zip(arrays(state), arrays(whole[0]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_finished_run_does_nothing_more(whole, home):
    state, lines = run(home, Failing(0))
    assert lines == []
    for a, b in zip(arrays(state), arrays(whole[0]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_longer_run_goes_on_from_a_shorter_one(tmp_path):
    run(tmp_path, feed(), LoopConfig(steps=4, save_every=3))
    _, lines = run(tmp_path, feed())
    assert [t for t, _ in lines] == list(range(4, STEPS))


def test_metrics_become_floats():
    assert fetch({"a": jax.numpy.float32(0.5), "b": jax.numpy.int32(3)}) == {"a": 0.5, "b": 3.0}
