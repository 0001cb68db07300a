"""Supply of batches by CPU cores: seconds per batch, and the idle time of a device when batches arrive late."""

import time
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.loops import run_loop
from touchr1_jax.training.loop import Batches, LoopConfig


class BatchCost(NamedTuple):
    """Cost of one batch: seconds of one core, and bytes sent to the device."""

    cpu_s: float
    size_bytes: int


class SimulatedDevice:
    """A device that computes nothing for as long as a step would take, and knows how long it had nothing to do.

    Like a real one it takes the next step while it is at one, and whoever reads a step's metrics waits for its end.

    Args:
      step_s: seconds of a step.
    """

    def __init__(self, step_s: float) -> None:
        self._step_s, self._free_at = step_s, 0.0
        self.idle_s, self.steps = 0.0, 0

    def step(self, state: Any, batch: Any) -> tuple[Any, dict[str, Any]]:
        """Begin a step as soon as the one before has ended."""
        del batch
        now = time.perf_counter()
        if self._free_at:  # nobody makes the first step wait
            self.idle_s += max(0.0, now - self._free_at)
            self.steps += 1
        self._free_at = max(now, self._free_at) + self._step_s
        return state, {"idle_s": _PendingMetric(self._free_at, self.idle_s)}

    @property
    def idle_share(self) -> float:
        """Share of the time from the first step's end to the last one's in which it stood still."""
        return self.idle_s / (self.idle_s + self.steps * self._step_s)


class _PendingMetric:
    """A number that is there when a step ends, with what is asked of arrays on a device."""

    def __init__(self, at: float, value: float) -> None:
        self._at, self._value = at, value

    def is_ready(self) -> bool:
        return time.perf_counter() >= self._at

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        time.sleep(max(0.0, self._at - time.perf_counter()))
        return np.array(self._value, dtype)


def make_seconds(batches: Iterator[Any], rounds: Iterable[object], ahead: Iterable[object]) -> BatchCost:
    """Mean over some batches, of the processor's clock: all threads together, and nobody else's load.

    Args:
      batches: endless.
      rounds: a batch is timed for each item.
      ahead: batches that may have been made before the first is asked for; one is drawn first for each item.
    """
    for _ in ahead:
        next(batches)
    spent = []
    for _ in rounds:
        began = time.process_time()
        batch = next(batches)
        spent.append(time.process_time() - began)
    return BatchCost(float(np.mean(spent)), sum(np.asarray(x).nbytes for x in jax.tree.leaves(batch)))


def idle_share(batches: Batches, step_s: float, steps: int, context: Context, stage: str) -> float:
    """Share of the time that a device stands still in the loop that trains, fed by these batches.

    Args:
      batches: of the stage.
      step_s: that a step lasts.
      steps: of them.
      context: the run.
      stage: its name.
    """
    device = SimulatedDevice(step_s)
    run_loop(
        device.step, {"nothing": jnp.zeros(())}, batches, LoopConfig(steps=steps, save_every=steps), context, stage
    )
    return device.idle_share
