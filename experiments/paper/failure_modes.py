"""Known failures of the method that an arm's run shows, where a sign of the paper does not come out.

F1 the middle level is overpaid for being near everything; F2 slots echo each other for the consistency reward, which
also drives the middle level out, since sensors disagree most about middle objects; F7 groups of equal rewards teach
nothing; F9 entropy collapses; F13 answers are paid that cannot be read; all others by the alarms of `rl.alarms`.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.study.alarm_log import ALARM
from touchr1_jax.rl.alarms import RULES, START, WINDOW

MOST = 0.5
"""Share of seeds in which an alarm fires, of groups that teach nothing, or of entropy that is left: a failure shows."""

POINTS = 2.0
"""Change of a share, in points, that counts: about the spread between seeds."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingHistory:
    """Metrics of an arm's training, means over seeds of the first and of the last steps, and its alarms.

    `alarms` maps a code to the share of seeds in which it fired.
    """

    start: Mapping[str, float]
    end: Mapping[str, float]
    alarms: Mapping[str, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmMeasurements:
    """An arm and the one it is compared with: its training, and the means of both on the test questions.

    `consistency` is true if the arm is rewarded for consistency.
    """

    history: TrainingHistory | None
    after: Mapping[str, float]
    before: Mapping[str, float]
    consistency: bool = False


def training_history(lines: Iterable[Mapping[str, Any]], arm: str) -> TrainingHistory | None:
    """The training of an arm from the lines of `metrics.jsonl`; `None` where GRPO did not train it."""
    stages: dict[str, list[Mapping[str, Any]]] = {}
    for line in lines:
        if line["stage"].startswith(f"grpo/{arm}/"):
            stages.setdefault(line["stage"], []).append(line)
    if not stages:
        return None
    seeds = [sorted(rows, key=lambda line: line["step"]) for rows in stages.values()]
    fired = [{name.removeprefix(ALARM) for line in rows for name in line if name.startswith(ALARM)} for rows in seeds]
    return TrainingHistory(
        start=_means([rows[:START] for rows in seeds]),
        end=_means([rows[-WINDOW:] for rows in seeds]),
        alarms={code: sum(code in one for one in fired) / len(fired) for code in sorted(set().union(*fired))},
    )


def _means(seeds: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, float]:
    names = set.intersection(*({n for line in rows for n in line if not n.startswith(ALARM)} for rows in seeds))
    return {
        name: float(np.mean([np.mean([line[name] for line in rows if name in line]) for rows in seeds]))
        for name in sorted(names - {"stage", "step"})
    }


def diagnose(arm: ArmMeasurements) -> tuple[str, ...]:
    """The failures that show, each with its code and the figures; empty where none does."""
    return tuple(_failures(arm))


def _failures(arm: ArmMeasurements) -> Iterator[str]:
    history, both = arm.history or TrainingHistory(start={}, end={}, alarms={}), arm.before.keys() & arm.after.keys()
    meanings = {rule.code: rule.meaning for rule in sorted(RULES, key=lambda rule: not rule.at_once)}
    for code, share in history.alarms.items():
        if share >= MOST:
            yield f"{code}: {meanings[code]} (alarm in {100 * share:.0f} % of the seeds)"
    if "middle_rate" in both:
        before, after = arm.before["middle_rate"], arm.after["middle_rate"]
        if after - before > POINTS:
            yield f"F1: middle answers {before:.0f} → {after:.0f} %"
        if before - after > POINTS:
            code, why = ("F2", "the consistency reward") if arm.consistency else ("F9", "sharpening")
            yield f"{code}: {why} drives the middle level out, {before:.0f} → {after:.0f} % of answers"
    if {"csc_slot", "csc"} <= both:
        slots, right = (arm.after[m] - arm.before[m] for m in ("csc_slot", "csc"))
        if slots > POINTS and right < slots - POINTS:
            yield f"F2: agreement of slots {slots:+.0f} points, right conclusions by single sensors {right:+.0f}"
    if (degenerate := history.end.get("drawn_degenerate_share", history.end.get("degenerate_share", 0.0))) > MOST:
        yield f"F7: {100 * degenerate:.0f} % of the groups earn one reward and teach nothing"
    before, after = (steps.get("entropy", 0.0) for steps in (history.start, history.end))
    if "entropy" in history.end and before > 0 and after < MOST * before:
        yield f"F9: entropy {before:.3f} → {after:.3f} nat a token"
    if "parse_rate" in both and arm.before["parse_rate"] - arm.after["parse_rate"] > POINTS:
        yield f"F13: answers that can be read {arm.before['parse_rate']:.0f} → {arm.after['parse_rate']:.0f} %"
