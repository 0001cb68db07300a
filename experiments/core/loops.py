"""Training stages of a run: checkpoints, log, progress bar, wall time, a stop when a signal asks for it."""

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal

from experiments.core.context import Context
from experiments.core.metric_log import by_stage
from experiments.core.progress import TrainingSample
from experiments.core.results import Table, named_table
from experiments.core.runs import labelled
from touchr1_jax.rl.scoring import NONFINITE_IN
from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.loop import SKIPPED, Batches, Hooks, Log, LoopConfig, LoopTime, Step, fit

STEPPING, WAITING = "in steps", "waiting for data"
"""Names in `timing` of the steps after the first and of their waiting for a batch, each followed by `/STAGE`."""

ALARM = "alarm_"  # prefix of the logged metrics that hold alarms, followed by their code

KEPT = 2  # newest checkpoints of a stage

COMPILING = "compiling the first step"  # note next to the bar of a stage until its first step is done

MakeLog = Callable[[Context, str, int], Log]
"""From the run, a stage and its first step to what receives (step, metrics)."""


def unchanged(context: Context, stage: str, start: int) -> Log:
    """A log that writes the metrics as they are."""
    del start
    return lambda t, metrics: context.log(stage, t, **metrics)


@contextlib.contextmanager
def stage_hooks(
    context: Context,
    stage: str,
    steps: int,
    *,
    make_log: MakeLog = unchanged,
    scored: bool = False,
    describe: Callable[[Any], TrainingSample] | None = None,
) -> Iterator[Hooks]:
    """Hooks that make a training stage part of a run; inside the block the stage is timed.

    Args:
      context: the run.
      stage: its name, `PHASE/SEED` or `PHASE/ARM/SEED`.
      steps: of the whole stage, for the progress bar.
      make_log: by default the metrics are logged unchanged.
      scored: keep the checkpoint of the highest held-out score too.
      describe: of the sample that a step returns, what people see; without it no step returns one.
    """
    times, logs, left_out = LoopTime(), list[Log](), [0.0]
    folder, of = context.checkpoint_dir(stage), labelled(context.directory, stage)
    better: Literal["higher"] | None = "higher" if scored else None
    seal_log = functools.partial(context.seal_log, stage)
    with (
        Checkpoints(folder, KEPT, better=better, print_=context.print, of=of, before_save=seal_log) as checkpoints,
        context.timed(stage),
        context.stopping.patient(context.processes.any) as stopping,
        context.compiling(stage.rpartition("/")[0]) as compiled,  # all seeds run one program
        contextlib.ExitStack() as bar,
    ):

        def resumed(start: int) -> None:
            context.require_logged(stage, start)
            context.rewind(stage, start)
            seal_log()
            log_step = make_log(context, stage, start)
            advance = bar.enter_context(context.progress(stage, steps, min(start, steps), note=COMPILING))

            def log(t: int, metrics: dict[str, float]) -> None:
                compiled()
                left_out.append(metrics.get(SKIPPED, 0.0))
                log_step(t, metrics)
                advance()

            logs.append(log)

        yield Hooks(
            log=lambda t, metrics: logs[-1](t, metrics),
            checkpoints=checkpoints,
            resumed=resumed,
            stopping=stopping,
            times=times,
            devices=context.devices,
            sampled=None if describe is None else lambda t, sample: context.sampled(stage, t, describe(sample)),
        )
        bar.close()
        _tell(context, stage, times, max(left_out))


def _tell(context: Context, stage: str, times: LoopTime, left_out: float) -> None:
    """Keep and print how long the steps of a stage took, and say how many updates were left out."""
    if left_out:
        context.print(f"{stage}: {left_out:.0f} updates were left out, for they were not finite")
    if times.steps:
        context.add_time(f"{STEPPING}/{stage}", times.total_s)
        context.add_time(f"{WAITING}/{stage}", times.input_s)
        ms = 1e3 * times.total_s / times.steps
        context.print(f"{stage}: {ms:.3g} ms a step, {times.input_share:.2%} of it {WAITING}")


def fired_alarms(lines: Iterable[Mapping[str, Any]]) -> dict[str, list[int]]:
    """Code of each alarm that fired → the steps of these lines at which it did."""
    steps: dict[str, list[int]] = {}
    for line in lines:
        for name in (name for name in line if name.startswith(ALARM)):
            steps.setdefault(name.removeprefix(ALARM), []).append(line["step"])
    return steps


def left_out_tables(lines: Iterable[Mapping[str, Any]]) -> tuple[Table, ...]:
    """A table of the updates and groups that training left out for a number that was not finite, if there were any."""
    rows = []
    for stage, of_stage in by_stage(lines).items():
        terms = sorted({name for line in of_stage for name in line if name.startswith(NONFINITE_IN)})
        share = {name: sum(line.get(name, 0.0) for line in of_stage) / len(of_stage) for name in terms}
        updates = max(line.get(SKIPPED, 0.0) for line in of_stage)
        if updates or any(share.values()):
            named = ", ".join(f"{name.removeprefix(NONFINITE_IN)} {100 * x:.3g} %" for name, x in share.items() if x)
            rows.append({"stage": stage, "steps": len(of_stage), "updates left out": updates, "groups left out": named})
    note = "A gradient, the policy after it, or a reward in the named share of the groups, was NaN or infinite."
    return (named_table("Left out of training", rows, note=note),) if rows else ()


def alarm_tables(lines: Iterable[Mapping[str, Any]]) -> tuple[Table, ...]:
    """A table of the alarms of training, if any fired."""
    rows = [
        {"stage": stage, "alarm": code, "first at step": min(at), "steps": len(at)}
        for stage, of_stage in sorted(by_stage(lines).items())
        for code, at in sorted(fired_alarms(of_stage).items())
    ]
    note = "docs/GLOSSARY.md says what a code means; the console named the number and its bound."
    return (named_table("Alarms of training", rows, note=note),) if rows else ()


def run_loop(
    step: Step,
    state: Any,
    batches: Batches,
    loop: LoopConfig,
    context: Context,
    stage: str,
    *,
    make_log: MakeLog = unchanged,
    held_out: Callable[[Any], float] | None = None,
) -> Any:
    """Call `fit` with `stage_hooks`: a stopped stage resumes from its newest checkpoint with bit-identical results."""
    with stage_hooks(context, stage, loop.steps, make_log=make_log, scored=held_out is not None) as hooks:
        return fit(step, state, batches, loop, hooks, held_out=held_out)
