"""Known failures of the method that an arm's run shows, where a sign of the paper does not come out.

F1 the middle level is overpaid for being near everything; F2 slots echo each other for the consistency reward, which
also drives the middle level out, since sensors disagree most about middle objects; F3 grounding grows without bound;
F4 noise is detected instead of touch; F5, F6 credit for touch that cancels or is not earned; F7 groups of equal rewards
teach nothing; F8 heavy tails of the KL; F9 entropy collapses or grows; F10 a stream is left out; F11 the prediction of
latents collapses; F12 time ids do not advance; F13 answers are paid that cannot be read; F14 the prior of the labels
does as well.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from touchr1_jax.rl.alarms import RULES, START, WINDOW

_ALARM = "alarm_"
_MEANINGS = {rule.code: rule.meaning for rule in RULES}

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

    `consistency` tells whether the arm is rewarded for consistency.
    """

    history: TrainingHistory | None
    after: Mapping[str, float]
    before: Mapping[str, float]
    consistency: bool = False


def training_history(lines: Iterable[Mapping[str, Any]], arm: str) -> TrainingHistory | None:
    """The training of an arm from the logged lines of a run; `None` where GRPO did not train it.

    Args:
      lines: those of `metrics.jsonl`.
      arm: whose stages are `grpo/ARM/SEED`.
    """
    stages: dict[str, list[Mapping[str, Any]]] = {}
    for line in lines:
        if line["stage"].startswith(f"grpo/{arm}/"):
            stages.setdefault(line["stage"], []).append(line)
    if not stages:
        return None
    seeds = [sorted(rows, key=lambda line: line["step"]) for rows in stages.values()]
    fired = [{name.removeprefix(_ALARM) for line in rows for name in line if name.startswith(_ALARM)} for rows in seeds]
    codes = sorted(set().union(*fired))
    return TrainingHistory(
        start=_means([rows[:START] for rows in seeds]),
        end=_means([rows[-WINDOW:] for rows in seeds]),
        alarms={code: sum(code in one for one in fired) / len(fired) for code in codes},
    )


def diagnose(arm: ArmMeasurements) -> tuple[str, ...]:
    """The failures that show, each with its code and the figures; empty where none does."""
    return tuple(text for check in CHECKS for text in check(arm))


def _means(seeds: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, float]:
    names = set.intersection(*({n for line in rows for n in line if not n.startswith(_ALARM)} for rows in seeds))
    return {
        name: float(np.mean([np.mean([line[name] for line in rows if name in line]) for rows in seeds]))
        for name in sorted(names - {"stage", "step"})
    }


def _alarms(arm: ArmMeasurements) -> Iterable[str]:
    for code, share in arm.history.alarms.items() if arm.history else ():
        if share >= MOST:
            yield f"{code}: {_MEANINGS[code]} (alarm in {100 * share:.0f} % of the seeds)"


def _middle_level(arm: ArmMeasurements) -> Iterable[str]:
    if "middle_rate" not in arm.after or "middle_rate" not in arm.before:
        return
    before, after = arm.before["middle_rate"], arm.after["middle_rate"]
    if after - before > POINTS:
        yield f"F1: middle answers {before:.0f} → {after:.0f} %"
    if before - after > POINTS:
        code, why = ("F2", "the consistency reward") if arm.consistency else ("F9", "sharpening")
        yield f"{code}: {why} drives the middle level out, {before:.0f} → {after:.0f} % of answers"


def _echoing_slots(arm: ArmMeasurements) -> Iterable[str]:
    if not {"csc_slot", "csc"} <= set(arm.after) & set(arm.before):
        return
    slots, right = (arm.after[m] - arm.before[m] for m in ("csc_slot", "csc"))
    if slots > POINTS and right < slots - POINTS:
        yield f"F2: agreement of slots {slots:+.0f} points, right conclusions by single sensors {right:+.0f}"


def _equal_rewards(arm: ArmMeasurements) -> Iterable[str]:
    if arm.history and arm.history.end.get("degenerate_share", 0.0) > MOST:
        yield f"F7: {100 * arm.history.end['degenerate_share']:.0f} % of the groups earn one reward and teach nothing"


def _entropy_collapse(arm: ArmMeasurements) -> Iterable[str]:
    if arm.history and {"entropy"} <= set(arm.history.start) & set(arm.history.end):
        before, after = arm.history.start["entropy"], arm.history.end["entropy"]
        if before > 0 and after < MOST * before:
            yield f"F9: entropy {before:.3f} → {after:.3f} nat a token"


def _unreadable(arm: ArmMeasurements) -> Iterable[str]:
    if "parse_rate" in arm.after and "parse_rate" in arm.before:
        before, after = arm.before["parse_rate"], arm.after["parse_rate"]
        if before - after > POINTS:
            yield f"F13: answers that can be read {before:.0f} → {after:.0f} %"


CHECKS: tuple[Callable[[ArmMeasurements], Iterable[str]], ...] = (
    _alarms,
    _middle_level,
    _echoing_slots,
    _equal_rewards,
    _entropy_collapse,
    _unreadable,
)
"""Each looks for one failure."""
