"""Alarms of a stage that goes on are those of an uninterrupted one, by whatever rules."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from experiments.core.context import Context
from experiments.core.metric_log import read_metrics
from experiments.study.alarm_log import ALARM, alarm_log
from tests.touchr1_jax.rl.test_active_alarms import HEALTHY
from touchr1_jax.rl.active_alarms import ACTIVE_RULES
from touchr1_jax.rl.alarms import WINDOW
from touchr1_jax.rl.scoring import NONFINITE_IN
from touchr1_jax.training.loop import SKIPPED

STAGE, STEPS = "grpo/chosen/0", WINDOW + 6


def printed_after(directory: Path, metrics: dict[str, float]) -> str:
    """What a stage prints after one step."""
    console = Console(file=io.StringIO(), width=300)
    context = Context(directory, directory / "cache", console)
    alarm_log(context, STAGE, 0)(0, metrics)
    context.close()
    return console.file.getvalue()


def test_a_step_that_lost_its_update_raises_the_alarms_of_its_other_numbers(tmp_path):
    said = printed_after(tmp_path, {SKIPPED: 1.0, "touch_share": 0.0})
    assert "F10" in said
    assert "update is left out" in said


def test_a_reward_that_is_rarely_not_finite_is_not_said_to_be_always_finite(tmp_path):
    for share, shown in ((1 / 512, "0.195 %"), (1.0, "100 %")):
        assert f"{shown} of the groups" in printed_after(tmp_path, {f"{NONFINITE_IN}spread": share})


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
    assert sum(said) == 1  # printed once, also over an interruption
