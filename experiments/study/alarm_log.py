"""The log of a GRPO stage: metrics of each step, the alarms they raise, and what was left out of the update."""

from collections.abc import Callable

from experiments.core.context import Context
from experiments.core.loops import ALARM
from experiments.core.metric_log import read_metrics
from touchr1_jax.rl.alarms import RULES, AlarmMonitor, AlarmRule
from touchr1_jax.rl.scoring import NONFINITE_IN
from touchr1_jax.training.loop import SKIPPED


def alarm_log(
    context: Context, stage: str, start: int, rules: tuple[AlarmRule, ...] = RULES
) -> Callable[[int, dict[str, float]], None]:
    """A function that logs the metrics of each step and the alarms they raise, `alarm_F7` with the number that fired.

    Each alarm of a stage is also printed once, and so is each reward that is not finite and the first update that is
    left out.  A stage that resumes at step `start` first looks at the steps that it logged before, so that its lines
    are those of an uninterrupted run.
    """
    monitor, printed = AlarmMonitor(rules), set[str]()

    def alarms_of(metrics: dict[str, float], t: int, *, aloud: bool) -> dict[str, float]:
        left_out = SKIPPED in metrics  # then the numbers that are not finite are missing
        alarms = monitor.update(metrics, left_out=left_out)
        notes = {f"{alarm.code} {alarm.meaning}": str(alarm) for alarm in alarms}
        if left_out:
            what = "the update is left out, for its gradient or the policy after it is not finite"
            notes[SKIPPED] = f"{what}; the report counts all of them"
        for name, share in metrics.items():
            if name.startswith(NONFINITE_IN) and share > 0:
                reward = name.removeprefix(NONFINITE_IN)
                what = f"reward {reward!r} is not finite in {100 * share:.3g} % of the groups, which are left out"
                notes[name] = f"{what}; the report counts all of them"
        for name, note in notes.items():
            if aloud and name not in printed:
                context.print(f"{stage}, step {t}: {note}")
            printed.add(name)
        return {f"{ALARM}{alarm.code}": alarm.value for alarm in alarms}

    for line in read_metrics(context.directory):
        if line["stage"] == stage and line["step"] < start:
            metrics = {n: x for n, x in line.items() if n not in ("stage", "step") and not n.startswith(ALARM)}
            alarms_of(metrics, line["step"], aloud=False)

    def log(t: int, metrics: dict[str, float]) -> None:
        context.log(stage, t, **metrics, **alarms_of(metrics, t, aloud=True))

    return log
