"""Alarms of a stage that goes on are those of an uninterrupted one, by whatever rules."""

import io

import pytest
from rich.console import Console

from experiments.core.context import Context
from experiments.core.metric_log import read_metrics
from experiments.study.alarm_log import ALARM, alarm_log
from tests.touchr1_jax.rl.test_active_alarms import HEALTHY
from touchr1_jax.rl.active_alarms import ACTIVE_RULES
from touchr1_jax.rl.alarms import WINDOW

STAGE, STEPS = "grpo/chosen/0", WINDOW + 6


@pytest.mark.parametrize("stopped_at", [0, 3, WINDOW + 2, STEPS])
def test_a_resumed_stage_logs_the_alarms_of_an_uninterrupted_one(tmp_path, stopped_at):
    never = {**HEALTHY, "no_action_share": 1.0}
    said = []
    for first, last in ((0, stopped_at), (stopped_at, STEPS)):
        console = Console(file=io.StringIO(), width=200)
        context = Context(tmp_path, tmp_path / "cache", console)
        log = alarm_log(context, STAGE, first, ACTIVE_RULES)
        for t in range(first, last):
            log(t, never)
        context.close()
        said.append(console.file.getvalue().count("A1"))
    raised = [line["step"] for line in read_metrics(tmp_path) if f"{ALARM}A1" in line]
    assert raised == list(range(WINDOW - 1, STEPS))
    assert sum(said) == 1  # told once, also over an interruption
