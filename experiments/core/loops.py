"""A training loop as a stage of a run: checkpoints, log, progress bar, wall time, an end when a signal asks for it."""

from collections.abc import Callable
from typing import Any

from experiments.core.context import Context
from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.loop import Batches, Log, LoopConfig, LoopTime, fit, resume

STEPPING, WAITING = "in steps", "waiting for data"
"""Names in `timing` of the steps after the first and of their waiting for a batch, each followed by `/STAGE`."""


def plain_log(context: Context, stage: str, start: int) -> Log:
    """Log the metrics of each step unchanged."""
    del start
    return lambda t, metrics: context.log(stage, t, **metrics)


def run_loop(
    step: Callable[[Any, Any], Any],
    state: Any,
    batches: Batches,
    loop: LoopConfig,
    context: Context,
    stage: str,
    *,
    make_log: Callable[[Context, str, int], Log] = plain_log,
    held_out: Callable[[Any], float] | None = None,
) -> Any:
    """Run `fit` as a stage, from its newest checkpoint, so that an interrupted stage ends in the same state.

    Args:
      step: jitted (state, batch) → (state, metrics).
      state: the first one of a stage without a checkpoint.
      batches: training data.
      loop: number of steps, and of those between checkpoints.
      context: the run.
      stage: its name, `PHASE/SEED` or `PHASE/ARM/SEED`.
      make_log: from context, stage and first step to a function of (step, metrics).
      held_out: score of a state on unseen data, higher is better, computed at every checkpoint; the best one is kept.
    """
    times = LoopTime()
    with (
        Checkpoints(
            context.checkpoint_dir(stage), better=None if held_out is None else "higher", say=context.print
        ) as checkpoints,
        context.timed(stage),
        context.stopping.patient(context.processes.any) as stopping,
    ):
        start, state = resume(state, batches, checkpoints)
        context.require_logged(stage, start)
        context.rewind(stage, start)
        write = make_log(context, stage, start)
        with context.progress(stage, loop.steps, min(start, loop.steps)) as advance:

            def log(t: int, metrics: dict[str, float]) -> None:
                write(t, metrics)
                advance()

            state = fit(
                step, state, batches, loop,
                checkpoints=checkpoints, log=log, start=start, stopping=stopping, held_out=held_out, times=times,
            )  # fmt: skip
        if times.steps:
            context.add_time(f"{STEPPING}/{stage}", times.total_s)
            context.add_time(f"{WAITING}/{stage}", times.input_s)
            context.print(
                f"{stage}: {1e3 * times.total_s / times.steps:.3g} ms a step, {times.input_share:.2%} of it {WAITING}"
            )
    return state
