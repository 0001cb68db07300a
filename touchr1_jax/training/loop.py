"""The training loop of every stage: fetch, step, log one step late, checkpoint, resume, stop when asked.

hooks = Hooks(log=print, checkpoints=Checkpoints(directory))
state = fit(step, state, batches, LoopConfig(steps=100), hooks)
"""

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

from touchr1_jax.skipping import count_skipped
from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.compilation import committed, return_memory
from touchr1_jax.types import SAMPLE, StepSample
from touchr1_jax.validation import at_least

Step = Callable[..., tuple[Any, dict[str, jax.Array]]]
"""(state, batch, *constants) → (state, metrics), jitted; it may donate its state."""

Log = Callable[[int, dict[str, float]], None]
"""Receives (step, metrics) in order; steps count from 0."""

SKIPPED = "skipped"
"""Metric of a step that left its update out: how many did so far.  Other steps have none of this name."""


HELD_OUT = "held_out"
"""Metric of a step after which held-out data were scored: the score."""


@runtime_checkable
class Batches(Protocol):
    """An iterator of batches with a position that can be saved and restored, such as Grain's."""

    def __next__(self) -> Any: ...
    def __iter__(self) -> Iterator[Any]: ...
    def get_state(self) -> Any: ...
    def set_state(self, state: Any) -> None: ...


class NonFiniteGradientError(RuntimeError):
    """The gradient was NaN or infinite too often to go on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """Number of steps, steps between checkpoints, and how many updates in a row may be left out.

    An update is left out if its gradient, or the policy after it, is not finite (see `skipping`); of several updates in
    a step each counts.
    """

    steps: int
    save_every: int = 50
    most_skipped: int = 10

    def __post_init__(self) -> None:
        at_least(self, 0, "steps")
        at_least(self, 1, "save_every", "most_skipped")


@dataclasses.dataclass
class LoopTime:
    """Wall time of a loop's steps in one session, without the first step, which compiles.

    Attributes:
      steps: their number.
      total_s: their time, including saving.
      input_s: upper bound of the part in which the device waited for the next batch: if a batch came after the device
        had finished, the whole time of making the batch counts.
    """

    steps: int = 0
    total_s: float = 0.0
    input_s: float = 0.0

    def add(self, step_s: float, waited_s: float) -> None:
        """Add a step: its time, and how much of it was waiting."""
        self.steps += 1
        self.total_s += step_s
        self.input_s += waited_s

    @property
    def input_share(self) -> float:
        """Share of the time spent waiting for data; 0 if no step was timed."""
        return self.input_s / self.total_s if self.total_s else 0.0


class SingleDevice:
    """Training steps on one device, unchanged; a subclass splits them over a mesh."""

    shape: tuple[int, ...] = (1, 1, 1)
    """Devices along the axes of the mesh."""
    gather_params: Callable[[Any], Any] = staticmethod(lambda params: params)
    """All-gathers weights inside a traced step, as `make_grpo_step` takes it."""

    def local_rows(self, batch_size: int) -> np.ndarray:
        """Rows of a batch that this process must read, ascending."""
        return np.arange(batch_size)

    def shard(
        self, step: Step, state: Any, batches: Batches, batch_size: int, *constants: Any
    ) -> tuple[Step, Any, Batches]:
        """Place a step (state, batch) → (state, metrics), its first state and its batches on the devices.

        Args:
          step: (state, batch, *constants) → (state, metrics).
          state: the first one.
          batches: of the rows that this process reads.
          batch_size: rows of a whole batch.
          constants: arguments that no step changes.
        """
        del batch_size
        state, constants = committed((state, constants))
        return lambda s, b: step(s, b, *constants), state, batches

    def gather(self, tree: Any) -> Any:
        """Arrays that every process holds completely."""
        return tree


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hooks:
    """Side effects of a training stage; by default it has none and runs on one device.

    Attributes:
      log: receives (step, metrics) in order, each one step late; if an update was left out, the finite metrics and
        `SKIPPED`.
      checkpoints: save and restore state and batches; `None` saves nothing.
      resumed: receives the first step that is computed, 0 or that of the checkpoint, before any step.
      stopping: called after every step; if it is true, the state is saved and returned.
      times: receives the time of steps and their waiting for data.
      devices: where the steps run.
      sampled: receives (step, sample) if the step returns a sample; `None` requests no samples.
    """

    log: Log = lambda step, metrics: None
    checkpoints: Checkpoints | None = None
    resumed: Callable[[int], None] = lambda step: None
    stopping: Callable[[], bool] = lambda: False
    times: LoopTime | None = None
    devices: SingleDevice = SingleDevice()
    sampled: Callable[[int, StepSample], None] | None = None


SILENT = Hooks()


def fit(
    step: Step,
    state: Any,
    batches: Batches,
    config: LoopConfig,
    hooks: Hooks = SILENT,
    *,
    held_out: Callable[[Any], float] | None = None,
) -> Any:
    """Run `step` to `config.steps`, continuing from the newest checkpoint if there is one.

    Step t is dispatched, then batch t + 1 is made, then the metrics of step t − 1 are fetched: all this happens while
    the device computes, so that the device does not wait, and after a save the next batch is ready.  Resuming restores
    state and data iterator together: the result equals the uninterrupted run's bit for bit.

    Args:
      step: (state, batch) → (state, metrics).
      state: initial state of a run without checkpoint.
      batches: training data.
      config: number of steps, of steps between checkpoints, and of updates in a row that may be left out.
      hooks: log, checkpoints, stop signal.
      held_out: score of a state on held-out data, taken whenever a checkpoint is due and logged as `HELD_OUT`; the
        checkpoints keep the best.

    Raises:
      NonFiniteGradientError: more than `config.most_skipped` updates in a row were left out.
    """
    start, state = resume(state, batches, hooks.checkpoints)
    hooks.resumed(start)
    lines = _LateLines(hooks, config.most_skipped, _skipped_before(state))
    batch = next(batches) if start < config.steps else None
    for t in range(start, config.steps):
        began = time.perf_counter()
        state, metrics = step(state, batch)
        place, asked = batches.get_state(), time.perf_counter()
        if t + 1 < config.steps:
            batch = next(batches)
        waited_s = time.perf_counter() - asked if _computed(metrics) else 0.0
        if t == start:
            return_memory()  # the step is compiled by now
        lines.put(_Line(t, metrics, count_skipped(state)))
        due = (t + 1) % config.save_every == 0 or t + 1 == config.steps
        leaving = hooks.stopping()
        if due or leaving:
            score = held_out(state) if due and held_out is not None else None
            lines.flush({} if score is None else {HELD_OUT: score})
            if hooks.checkpoints is not None:
                hooks.checkpoints.save(t + 1, state, place, score)
        if t > start and hooks.times is not None:
            hooks.times.add(time.perf_counter() - began, waited_s)
        if leaving:
            break
    return state


def fit_best(
    step: Step,
    state: Any,
    batches: Batches,
    config: LoopConfig,
    hooks: Hooks = SILENT,
    *,
    held_out: Callable[[Any], float] | None,
) -> Any:
    """`fit`, then return the checkpoint with the highest held-out score; without `held_out`, the last state.

    Args:
      step, state, batches, config, hooks, held_out: as in `fit`.

    Raises:
      ValueError: `held_out` without checkpoints.
      CheckpointError: the best checkpoint is damaged.
      NonFiniteGradientError: as `fit`.
    """
    if held_out is not None and hooks.checkpoints is None:
        raise ValueError("hooks.checkpoints is None: must keep the best where held_out is given; set it")
    state = fit(step, state, batches, config, hooks, held_out=held_out)
    best = None if held_out is None or hooks.checkpoints is None else hooks.checkpoints.best(state)
    return state if best is None else best.state


def peek(batches: Batches) -> Any:
    """The next batch; the iterator will return it again."""
    place = batches.get_state()
    first = next(batches)
    batches.set_state(place)
    return first


def resume(state: Any, batches: Batches, checkpoints: Checkpoints | None) -> tuple[int, Any]:
    """Step and state of the newest intact checkpoint, whose position the batches get; without one, 0 and `state`."""
    restored = None if checkpoints is None else checkpoints.restore(state)
    if restored is None:
        return 0, state
    batches.set_state(restored.data)
    return restored.step, restored.state


def fetch(metrics: dict[str, jax.Array]) -> dict[str, float]:
    """Scalars of a metrics dictionary as Python floats."""
    return {name: float(value) for name, value in jax.device_get(metrics).items()}


class _Line(NamedTuple):
    """A step, its metrics, and `count_skipped` after it."""

    step: int
    metrics: dict[str, jax.Array]
    skipped: jax.Array | None


class _LateLines:
    """Logs each step once the next one is dispatched, and judges the updates that were left out."""

    def __init__(self, hooks: Hooks, most_skipped: int, skipped: int) -> None:
        self._log, self._sampled, self._most, self._skipped = hooks.log, hooks.sampled, most_skipped, skipped
        self._pending: _Line | None = None

    def put(self, line: _Line) -> None:
        """Log the line before this one."""
        self.flush()
        self._pending = line

    def flush(self, further: Mapping[str, float] = {}) -> None:
        """Log what is pending, with further values."""
        if self._pending is None:
            return
        (t, metrics, counts), self._pending = self._pending, None
        metrics = dict(metrics)
        sample: Any = metrics.pop(SAMPLE, None)
        if self._sampled is not None and sample is not None:
            self._sampled(t, jax.device_get(sample))
        values = {**fetch(metrics), **further}
        if counts is None:
            self._log(t, values)
            return
        skipped, in_a_row = (int(n) for n in jax.device_get(counts))
        if skipped > self._skipped:
            values = {name: x for name, x in values.items() if math.isfinite(x)} | {SKIPPED: float(skipped)}
        self._skipped = skipped
        self._log(t, values)
        if in_a_row > self._most:
            raise NonFiniteGradientError(
                f"step {t}: the gradient or the policy after it was not finite in {in_a_row} updates in a row, "
                f"{skipped} in all; at most {self._most} in a row may be left out: lower the learning rate, or look at "
                f"what the batches from step {t + 1 - in_a_row} on hold; nothing was saved since the last checkpoint"
            )


def _computed(metrics: dict[str, Any]) -> bool:
    """True if the device has finished the step of these metrics."""
    return all(array.is_ready() for array in jax.tree.leaves(metrics))


def _skipped_before(state: Any) -> int:
    counts = count_skipped(state)
    return 0 if counts is None else int(counts[0])
