"""Stopping and going on is the same as never stopping, bit for bit."""

import time

import jax
import numpy as np
import pytest

from tests.touchr1_jax.training.stepping import feed, guarded_start, guarded_step, start, step
from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.loop import (
    HELD_OUT,
    SKIPPED,
    Hooks,
    LoopConfig,
    LoopTime,
    NonFiniteGradientError,
    fit,
    fit_best,
)
from touchr1_jax.types import SAMPLE

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
        state = fit(
            step, start(), batches, config, Hooks(checkpoints=checkpoints, log=lambda t, m: lines.append((t, m)))
        )
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


@pytest.mark.long
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
    """It breaks where the batch after step 0, 2, 3, 7 or 8 is made, of which 2 and 8 are not saved for that."""
    with pytest.raises(Broken):
        run(tmp_path, Failing(after))
    with Checkpoints(tmp_path) as checkpoints:
        saved = checkpoints.latest() or 0
    assert saved == (after - 1) // 3 * 3
    state, lines = run(tmp_path, feed())
    assert [t for t, _ in lines] == list(range(saved, STEPS))
    assert lines == whole[1][saved:]
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


def test_without_hooks_it_trains_from_the_beginning(whole):
    for a, b in zip(arrays(fit(step, start(), feed(), CONFIG)), arrays(whole[0]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_samples_are_passed_on_and_are_no_metrics():
    def sampling(state, batch):
        state, metrics = step(state, batch)
        return state, {**metrics, SAMPLE: jax.numpy.arange(2)}

    seen, lines = [], []
    hooks = Hooks(log=lambda t, m: lines.append(m), sampled=lambda t, sample: seen.append((t, sample.tolist())))
    fit(sampling, start(), feed(), LoopConfig(steps=2), hooks)
    assert seen == [(0, [0, 1]), (1, [0, 1])]
    assert not any(SAMPLE in line for line in lines)


class TestSkipping:
    """The loss has a NaN in the batches that hold a negative number."""

    def run(self, directory, poisoned: set[int], most_skipped: int = 2, steps: int = STEPS):
        lines = []
        config = LoopConfig(steps=steps, save_every=3, most_skipped=most_skipped)
        with Checkpoints(directory) as checkpoints:
            log = lambda t, m: lines.append((t, m))
            state = fit(
                guarded_step, guarded_start(), Poisoned(poisoned), config, Hooks(checkpoints=checkpoints, log=log)
            )
        return state, lines

    def test_a_bad_update_is_left_out_and_counted(self, tmp_path):
        state, lines = self.run(tmp_path, {2, 5, 6})
        assert [t for t, m in lines if SKIPPED in m] == [2, 5, 6]
        assert [m[SKIPPED] for _, m in lines if SKIPPED in m] == [1, 2, 3]
        assert all(np.isfinite(list(m.values())).all() for _, m in lines)
        assert "loss" not in lines[2][1]
        assert all(np.isfinite(x).all() for x in arrays(state))
        assert int(state.opt_state.inner[0].count) == STEPS - 3

    def test_too_many_in_a_row_stop_training(self, tmp_path):
        with pytest.raises(NonFiniteGradientError, match=r"step 7: .* 3 updates in a row, 4 in all.*from step 5 on"):
            self.run(tmp_path, {1, 5, 6, 7})
        with Checkpoints(tmp_path) as checkpoints:
            assert checkpoints.latest() == 6  # whose own update was left out: it holds what came before

    def test_the_count_goes_on_after_a_break(self, tmp_path):
        """A session that begins between bad updates stops at the step at which an uninterrupted one stops."""
        self.run(tmp_path, {4, 5}, steps=6)
        with pytest.raises(NonFiniteGradientError, match=r"step 6: .* 3 updates in a row, 3 in all"):
            self.run(tmp_path, {4, 5, 6})


class Poisoned(Failing):
    """The same batches, some of them negative."""

    def __init__(self, steps: set[int]) -> None:
        super().__init__(1000)
        self._steps = steps

    def __next__(self):
        count = 1000 - self._left
        batch = super().__next__()
        return -batch - 1 if count in self._steps else batch

    def get_state(self):
        return {"left": self._left, "batches": super().get_state()}

    def set_state(self, state):
        self._left = state["left"]
        super().set_state(state["batches"])


def test_a_request_to_stop_saves_where_it_is(whole, tmp_path):
    """At a step at which no checkpoint is due; going on gives the same end."""
    lines = []
    log = lambda t, m: lines.append((t, m))
    with Checkpoints(tmp_path) as checkpoints:
        stopping = lambda: len(lines) >= 4
        stopped = fit(step, start(), feed(), CONFIG, Hooks(checkpoints=checkpoints, log=log, stopping=stopping))
        assert checkpoints.latest() == int(stopped.step) == 5
    state, more = run(tmp_path, feed())
    assert lines + more == whole[1]
    for a, b in zip(arrays(state), arrays(whole[0]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_best_held_out_state_is_returned(tmp_path):
    """Scores are taken where a checkpoint is due: after steps 3, 6, 9 and 10."""
    scores, lines = iter([1.0, 4.0, 2.0, 3.0]), {}
    with Checkpoints(tmp_path, keep=1, better="higher") as checkpoints:
        held_out = lambda state: next(scores)
        hooks = Hooks(checkpoints=checkpoints, log=lines.__setitem__)
        assert int(fit_best(step, start(), feed(), CONFIG, hooks, held_out=held_out).step) == 6
        assert int(checkpoints.restore(start()).state.step) == STEPS
    assert {t: line[HELD_OUT] for t, line in lines.items() if HELD_OUT in line} == {2: 1.0, 5: 4.0, 8: 2.0, 9: 3.0}


def test_the_best_state_needs_checkpoints():
    with pytest.raises(ValueError, match=r"hooks.checkpoints is None: must keep the best"):
        fit_best(step, start(), feed(), CONFIG, held_out=lambda state: 0.0)
    assert int(fit_best(step, start(), feed(), CONFIG, held_out=None).step) == STEPS


class Slow(Failing):
    """Each batch takes a twentieth of a second, in which any step here is long done."""

    def __next__(self):
        time.sleep(0.05)
        return super().__next__()


def test_each_batch_is_made_once_and_none_beyond_the_last(whole, tmp_path):
    """The batch of the next step is there before this one is saved; what is saved is the place before it."""
    batches = Failing(STEPS)
    assert run(tmp_path, batches)[1] == whole[1]
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.restore(start()).data == batches.get_state()
    with pytest.raises(Broken):
        next(batches)


def test_time_without_a_batch_counts_as_waiting():
    slow, quick = LoopTime(), LoopTime()
    for batches, times in ((Slow(1000), slow), (feed(), quick)):
        fit(step, start(), batches, CONFIG, Hooks(times=times))
    assert slow.steps == quick.steps == STEPS - 1  # all but the first, which compiles
    assert slow.input_s >= 0.05 * (slow.steps - 1)  # the last step needs no further batch
    assert slow.input_s <= slow.total_s
    assert quick.input_s < slow.input_s
    assert LoopTime().input_share == 0


@pytest.mark.parametrize("field", ["steps", "save_every", "most_skipped"])
def test_a_loop_of_nothing_is_refused(field):
    with pytest.raises(ValueError, match=f"{field} is -1: must be at least"):
        LoopConfig(**{"steps": 3, field: -1})
