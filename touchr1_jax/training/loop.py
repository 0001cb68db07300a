"""The training loop of every stage: fetch, step, log one step late, checkpoint, resume."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import jax

from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.compilation import return_memory


class Batches(Protocol):
    """An iterator of batches that can say where it is and go back there; Grain's iterators are such."""

    def __next__(self) -> Any: ...
    def __iter__(self) -> Iterator[Any]: ...
    def get_state(self) -> Any: ...
    def set_state(self, state: Any) -> None: ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """Number of steps, and every how many steps a checkpoint is saved."""

    steps: int
    save_every: int = 50


def fit(
    step: Callable[[Any, Any], tuple[Any, dict[str, jax.Array]]],
    state: Any,
    batches: Batches,
    config: LoopConfig,
    *,
    checkpoints: Checkpoints,
    log: Callable[[int, dict[str, float]], None],
) -> Any:
    """Run `step` to `config.steps`, continuing from the newest checkpoint where there is one.

    The metrics of step t are fetched after step t + 1 has been dispatched, so the device never waits for the host.
    Resuming restores state and data iterator together: the result equals the uninterrupted run's bit for bit.

    Args:
      step: jitted (state, batch) → (state, metrics); it may donate its state.
      state: where a run without a checkpoint begins.
      batches: training data.
      config: how long, and how often to save.
      checkpoints: where to save.
      log: receives (step, metrics) in order; steps count from 0.
    """
    restored = checkpoints.restore(state)
    start = 0
    if restored is not None:
        start, state = restored.step, restored.state
        batches.set_state(restored.data)
    pending: tuple[int, dict[str, jax.Array]] | None = None
    for t in range(start, config.steps):
        state, metrics = step(state, next(batches))
        if t == start:
            return_memory()  # the step is compiled by now
        if pending is not None:
            log(pending[0], fetch(pending[1]))
        pending = (t, metrics)
        if (t + 1) % config.save_every == 0 or t + 1 == config.steps:
            log(t, fetch(metrics))
            pending = None
            checkpoints.save(t + 1, state, batches.get_state())
    return state


def fetch(metrics: dict[str, jax.Array]) -> dict[str, float]:
    """Scalars of a metrics dictionary as Python floats."""
    return {name: float(value) for name, value in jax.device_get(metrics).items()}
