"""The log of a GRPO stage: its metrics, and the alarms that they raise."""

from collections.abc import Callable
from typing import Any

from experiments.core.context import Context, read_metrics
from touchr1_jax.rl.alarms import AlarmMonitor
from touchr1_jax.training.loop import SKIPPED

_FIELDS = ("stage", "step")
_ALARM = "alarm_"


def watched_log(context: Context, stage: str, start: int) -> Callable[[int, dict[str, float]], None]:
    """A function that logs the metrics of each step and the alarms they raise, `alarm_F7` with the number that fired.

    Each alarm of a stage is also printed once.  A resumed stage first looks at the steps that it logged before, so that
    its lines are those of an uninterrupted run.

    Args:
      context: the run.
      stage: name of the stage.
      start: first step that is computed.
    """
    monitor, told = AlarmMonitor(), set[str]()

    def see(metrics: dict[str, float], t: int, *, aloud: bool) -> dict[str, float]:
        if SKIPPED in metrics:  # its update was left out, and what was not finite is missing
            return {}
        alarms = monitor.update(metrics)
        for alarm in alarms:
            if aloud and alarm.code not in told:
                context.print(f"{stage}, step {t}: {alarm}")
            told.add(alarm.code)
        return {f"{_ALARM}{alarm.code}": alarm.value for alarm in alarms}

    for line in read_metrics(context.directory):
        if line["stage"] == stage and line["step"] < start:
            see(_metrics(line), line["step"], aloud=False)

    def log(t: int, metrics: dict[str, float]) -> None:
        context.log(stage, t, **metrics, **see(metrics, t, aloud=True))

    return log


def _metrics(line: dict[str, Any]) -> dict[str, float]:
    return {name: value for name, value in line.items() if name not in _FIELDS and not name.startswith(_ALARM)}
