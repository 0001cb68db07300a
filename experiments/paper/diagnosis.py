"""Why a sign of the paper does not come out: the known failures of the method that an arm's run shows.

The codes number known failures: F1 the middle level is paid for being near everything; F2 slots echo each other for the
consistency reward, which also drives the middle level out, since sensors disagree most about middle objects; F3
grounding grows without bound; F4 noise is detected instead of touch; F5, F6 credit for touch that cancels or is not
earned; F7 groups of equal rewards teach nothing; F8 heavy tails of the KL; F9 entropy collapses or grows; F10 a stream
that is left out; F11 the prediction of latents collapses; F12 time ids that do not move; F13 answers that are paid and
cannot be read; F14 the prior of the labels does as well.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from touchr1_jax.rl.alarms import RULES, START, WINDOW

_ALARM = "alarm_"
_MEANINGS = {rule.code: rule.meaning for rule in RULES}

MOST = 0.5
"""Of seeds that an alarm struck in, of groups that teach nothing, or of entropy that is left."""

POINTS = 2.0
"""Change of a share, in points, below which nothing is made of it: about what seeds differ by."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Course:
    """How an arm trained: its metrics, means over seeds of the first and of the last steps, and the alarms.

    `alarms` maps a code to the share of seeds in which it struck.
    """

    start: Mapping[str, float]
    end: Mapping[str, float]
    alarms: Mapping[str, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """An arm and the one it is held against: how it trained, and the means of both on the test questions."""

    course: Course | None
    after: Mapping[str, float]
    before: Mapping[str, float]
    consistency: bool = False
    """Whether the arm is paid for consistency."""


def course_of(lines: Iterable[Mapping[str, Any]], arm: str) -> Course | None:
    """The course of an arm from the logged lines of a run; `None` where it was not reinforced.

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
    struck = [
        {name.removeprefix(_ALARM) for line in rows for name in line if name.startswith(_ALARM)} for rows in seeds
    ]
    codes = sorted(set().union(*struck))
    return Course(
        start=_means([rows[:START] for rows in seeds]),
        end=_means([rows[-WINDOW:] for rows in seeds]),
        alarms={code: sum(code in one for one in struck) / len(struck) for code in codes},
    )


def diagnose(case: Case) -> tuple[str, ...]:
    """The failures that show, each with its code and the figures; empty where none does."""
    return tuple(said for symptom in SYMPTOMS for said in symptom(case))


def _means(seeds: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, float]:
    names = set.intersection(*({n for line in rows for n in line if not n.startswith(_ALARM)} for rows in seeds))
    return {
        name: float(np.mean([np.mean([line[name] for line in rows if name in line]) for rows in seeds]))
        for name in sorted(names - {"stage", "step"})
    }


def _struck(case: Case) -> Iterable[str]:
    """Alarms that struck in half of the seeds or more."""
    for code, share in case.course.alarms.items() if case.course else ():
        if share >= MOST:
            yield f"{code}: {_MEANINGS[code]} (alarm in {100 * share:.0f} % of the seeds)"


def _middle(case: Case) -> Iterable[str]:
    """The middle level gains or goes, by more than seeds differ."""
    if not {"middle_rate"} <= set(case.after) & set(case.before):
        return
    was, now = case.before["middle_rate"], case.after["middle_rate"]
    if now - was > POINTS:
        yield f"F1: middle answers {was:.0f} → {now:.0f} %"
    if was - now > POINTS:
        code, why = ("F2", "the consistency reward") if case.consistency else ("F9", "sharpening")
        yield f"{code}: {why} drives the middle level out, {was:.0f} → {now:.0f} % of answers"


def _echo(case: Case) -> Iterable[str]:
    """Slots agree more often while conclusions by single sensors do not."""
    if not {"csc_slot", "csc"} <= set(case.after) & set(case.before):
        return
    slots, right = (case.after[m] - case.before[m] for m in ("csc_slot", "csc"))
    if slots > POINTS and right < slots - POINTS:
        yield f"F2: slots agree {slots:+.0f} points, conclusions by single sensors are right {right:+.0f}"


def _idle(case: Case) -> Iterable[str]:
    if case.course and case.course.end.get("degenerate_share", 0.0) > MOST:
        yield f"F7: {100 * case.course.end['degenerate_share']:.0f} % of the groups earn one reward and teach nothing"


def _sharp(case: Case) -> Iterable[str]:
    if case.course and {"entropy"} <= set(case.course.start) & set(case.course.end):
        was, now = case.course.start["entropy"], case.course.end["entropy"]
        if was > 0 and now < MOST * was:
            yield f"F9: entropy {was:.3f} → {now:.3f} nat a token"


def _unread(case: Case) -> Iterable[str]:
    if "parse_rate" in case.after and "parse_rate" in case.before:
        was, now = case.before["parse_rate"], case.after["parse_rate"]
        if was - now > POINTS:
            yield f"F13: answers that can be read {was:.0f} → {now:.0f} %"


SYMPTOMS: tuple[Callable[[Case], Iterable[str]], ...] = (_struck, _middle, _echo, _idle, _sharp, _unread)
"""Each looks for one failure."""
