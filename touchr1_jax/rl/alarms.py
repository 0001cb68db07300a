"""Alarms: known failures of reinforcement from touch, each detected in the metrics of a run by one small `check`.

It gets the mean metrics of the last `WINDOW` steps and of the first `START` steps (the initial policy), and
returns the number that is compared with a bound, or `None`.
The codes F1 … F16 number the failures; F11, the collapse of latent prediction, and F14, the prior of the labels, belong
to other stages.
"""

import collections
import dataclasses
from collections.abc import Callable, Collection, Mapping

WINDOW = 20
"""Steps of a mean: with 8 prompts of 8 rollouts the standard error of a share is then below .02."""

START = 5
"""Steps of the initial mean: few enough that the policy is still the one that training starts from, and enough that its
accuracy has a standard error of .05, where that of one step of 8 prompts is .1."""

RARE = 0.02
"""Smaller shares of groups are ignored: they are at most three groups in a window of 160."""

WORSE = 0.1
"""A change of accuracy beyond chance: two standard errors of the initial mean."""

NO_LEAD = 0.04
"""Leads of touch below this are chance: two standard errors of the difference of two means in a window, from 1,280
answers and from 640 under a control."""

LEFT_OUT = "left_out_share"
"""Share of the last `WINDOW` steps of which an update was left out, for it was not finite."""

Metrics = Mapping[str, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Alarm:
    """A detected failure: its code and meaning, the number that fired and the bound that it passed."""

    code: str
    meaning: str
    value: float
    bound: float

    def __str__(self) -> str:
        return f"alarm {self.code}: {self.meaning} ({self.value:.3g}, bound {self.bound:g})"


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlarmRule:
    """A rule that raises an alarm where `check` passes `bound`; `reason` justifies the bound."""

    code: str
    meaning: str
    bound: float
    reason: str
    check: Callable[[Metrics, Metrics], float | None]
    below: bool = False
    """Fire below the bound instead of above."""
    at_once: bool = False
    """Judge every step alone, from the first one on, instead of windows."""

    def alarm(self, now: Metrics, start: Metrics) -> Alarm | None:
        """The alarm, if it fires; metrics that a run does not log raise none."""
        value = self.check(now, start)
        if value is None or (value >= self.bound if self.below else value <= self.bound):
            return None
        return Alarm(code=self.code, meaning=self.meaning, value=value, bound=self.bound)


def of_candidates(metrics: Metrics, name: str) -> float:
    """A metric of all candidates, also under dynamic sampling, which selects groups that are half right at any time."""
    return metrics.get(f"drawn_{name}", metrics[name])


def middle_excess(now: Metrics, start: Metrics) -> float:
    """F1: share of middle answers above the share of middle labels, whatever the number of levels."""
    del start
    return of_candidates(now, "middle_rate") - of_candidates(now, "middle_labels")


def echo_excess(now: Metrics, start: Metrics) -> float | None:
    """F2: share of formatted answers whose slots all agree, less the share of right ones among them.

    For honest slots it is at most 0: two independent slots, each right with probability a and otherwise wrong in
    either direction, agree with probability a² + (1 − a)²/2, which is at most a for every a from ⅓ to 1.
    """
    del start
    if "echo_right" not in now:  # no line of older logs has it
        return None
    return of_candidates(now, "echo_share") - of_candidates(now, "echo_right")


def swap_blindness(now: Metrics, start: Metrics) -> float | None:
    """F4: accuracy lost under noise, less that lost under another object's touch; needs the controls of R_tu."""
    del start
    leads = _leads(now)
    return leads["noise"] - leads["order"] if {"order", "noise"} <= set(leads) else None


def cancelled_bonus(now: Metrics, start: Metrics) -> float | None:
    """F5: share of the groups with different bonuses in which the bonuses do not change the advantages."""
    del start
    telling = now["bonus_telling_share"]
    return now["bonus_cancelled_share"] / telling if telling > RARE else None


def unearned_credit(now: Metrics, start: Metrics) -> float | None:
    """F6: share of groups with tactile credit, while touch is hardly better than the best control on average."""
    del start
    leads = _leads(now)
    if not leads:
        return None
    chance = min(leads.values()) <= NO_LEAD
    return max(now["credit_unearned_share"], now["tactile_credit_share"] if chance else 0.0)


def _leads(now: Metrics) -> dict[str, float]:
    """Leads of touch over the controls that apply to most prompts; none where a run has no controls, or an old log."""
    names = (name for name in ("drop", "noise", "order") if f"lead_{name}" in now)
    return {name: now[f"lead_{name}"] for name in names if now[f"control_{name}_share"] > 0.5}


def idle_groups(now: Metrics, start: Metrics) -> float | None:
    """F7: share of groups of equal rewards among those that are not solved yet, while answers do not improve.

    A group that is all right has nothing to learn, and alarm F15 counts those that are left out.  Shares are of all
    candidates (`drawn_…` in the log), because selected groups hide the others.
    """
    if "idle_share" not in now:  # no line of older logs has it
        return None
    if of_candidates(now, "accuracy") > of_candidates(start, "accuracy"):
        return None
    unsolved = of_candidates(now, "unsolved_share")
    return of_candidates(now, "idle_share") / unsolved if unsolved > 0 else 0.0


def heavy_tail(now: Metrics, start: Metrics) -> float | None:
    """F8: the largest penalty of a token, β times its KL in units of the advantage, while answers get worse."""
    worse = of_candidates(now, "accuracy") < of_candidates(start, "accuracy") - WORSE
    return now.get("kl_cost_peak") if worse else None


def entropy_collapse(now: Metrics, start: Metrics) -> float | None:
    """F9: entropy relative to the initial one, while answers have not improved and are not all right."""
    stuck = of_candidates(now, "accuracy") < min(of_candidates(start, "accuracy") + WORSE, 0.95)
    known = now.get("learned_share", 1.0) > 0  # the mean over no rollout is 0
    return now["entropy"] / max(start["entropy"], 1e-6) if stuck and known else None


def forgotten_stream(now: Metrics, start: Metrics) -> float | None:
    """F10: the smallest grounding of a stream that was perturbed, nat."""
    del start
    streams = [n.removeprefix("perturbed_stream_") for n in now if n.startswith("perturbed_stream_") and now[n] > 0]
    return min((now[f"grounding_stream_{s}"] for s in streams), default=None)


def touched_share(now: Metrics, start: Metrics) -> float | None:
    """F10: share of the prompts that have any touch."""
    del start
    return of_candidates(now, "touch_share") if "touch_share" in now else None


def untouched_share(now: Metrics, start: Metrics) -> float | None:
    """F10: share of the prompts without touch, where others have some."""
    return 1 - share if (share := touched_share(now, start)) else None


def left_out_groups(now: Metrics, start: Metrics) -> float | None:
    """F15: share of the groups that are left out because a reward is not finite.

    Of all candidates, or of the selected groups if it is larger there: a KL in the reward is known for these alone.
    """
    del start
    return max((now[name] for name in ("drawn_nonfinite_share", "nonfinite_share") if name in now), default=None)


RULES: tuple[AlarmRule, ...] = (
    AlarmRule(
        code="F1",
        meaning="answers drift to the middle level",
        bound=0.25,
        reason="if 60 % are right and all errors are one level inwards, the middle level is .27 too frequent at most",
        check=middle_excess,
    ),
    AlarmRule(
        code="F2",
        meaning="slots copy each other instead of reporting their sensor",
        bound=0.1,
        reason="two standard errors of a window above what honest slots reach, 0; a constant echo reaches .67",
        check=echo_excess,
    ),
    AlarmRule(
        code="F3",
        meaning="grounding grows without bound",
        bound=1.0,
        reason="1 nat a token over a whole answer: every word is e times likelier with touch than with noise",
        check=lambda now, start: now.get("grounding"),  # mean of a token, nat
    ),
    AlarmRule(
        code="F4",
        meaning="answers get worse with noise, but not with the touch of another object",
        bound=0.25,
        reason="a policy that reads touch loses as much by another object's touch, up to chance agreement of ⅓",
        check=swap_blindness,
    ),
    AlarmRule(
        code="F5",
        meaning="the tactile bonus cancels within groups",
        bound=0.5,
        reason="a bonus that acts moves the advantages of most groups whose rollouts earn different ones",
        check=cancelled_bonus,
    ),
    AlarmRule(
        code="F6",
        meaning="R_tu pays, although answers are no better with touch than without",
        bound=0.17,
        reason="the false-credit rate that R_tu is designed for, .12, and two standard errors of a window's 160 groups",
        check=unearned_credit,
    ),
    AlarmRule(
        code="F7",
        meaning="most groups give no gradient, because their rewards are equal",
        bound=0.5,
        reason="half of the rollouts of questions that are not solved yet then give no gradient",
        check=idle_groups,
    ),
    AlarmRule(
        code="F8",
        meaning="the KL of a few tokens from the reference dominates the update",
        bound=1.0,
        reason="one token then costs more than a standard deviation of the reward is worth",
        check=heavy_tail,
    ),
    AlarmRule(
        code="F9",
        meaning="entropy collapses before the answers are right",
        bound=0.05,
        reason="a twentieth of the first entropy leaves a group of eight with one text",
        check=entropy_collapse,
        below=True,
    ),
    AlarmRule(
        code="F9",
        meaning="entropy grows without bound",
        bound=0.2,
        reason="on every token of an answer of 15: three nats, so twenty times as many answers in play as at first",
        check=lambda now, start: now["entropy"] - start["entropy"],  # nat
    ),
    AlarmRule(
        code="F10",
        meaning="a stream has no influence on the answer",
        bound=1e-7,
        reason="a stream that does not reach the policy moves nothing; one that is read moves more than float32 rounds",
        check=forgotten_stream,
        below=True,
    ),
    AlarmRule(
        code="F10",
        meaning="no prompt of a batch has any touch",
        bound=1e-7,
        reason="without touch there is nothing to ground and nothing to reason from",
        check=touched_share,
        below=True,
        at_once=True,
    ),
    AlarmRule(
        code="F10",
        meaning="prompts of a batch have no touch, others have",
        bound=1e-6,
        reason="above the rounding of the share; their answers are guesses, rewarded like the others",
        check=untouched_share,
        at_once=True,
    ),
    AlarmRule(
        code="F12",
        meaning="all frames have the same time index, so that shuffled frames test nothing",
        bound=0.01,
        reason="recorded frames have different indices; only a cast or a unit error makes them equal",
        check=lambda now, start: now["static_time_share"],  # of the streams
    ),
    AlarmRule(
        code="F13",
        meaning="answers name levels but cannot be parsed",
        bound=0.2,
        reason="a supervised policy writes one such answer in twenty; four times as many are a strategy",
        check=lambda now, start: of_candidates(now, "gamed_share"),
    ),
    AlarmRule(
        code="F15",
        meaning="groups are skipped, because a reward is not finite",
        bound=RARE,
        reason="one bad batch does not explain more than three groups in a window of 160",
        check=left_out_groups,
    ),
    AlarmRule(
        code="F15",
        meaning="updates are skipped, because their gradient or the policy after them is not finite",
        bound=0.1,
        reason="one step in ten loses an update; a single one may be a rare overflow",
        check=lambda now, start: now[LEFT_OUT],
        at_once=True,
    ),
    AlarmRule(
        code="F15",
        meaning="fewer than half of the rollouts are learned from: the others are cut off, or too far from the sampler",
        bound=0.5,
        reason="the policy gradient then shows a minority of the rollouts that the rewards compare",
        check=lambda now, start: now.get("learned_share"),
        below=True,
        at_once=True,
    ),
    AlarmRule(
        code="F16",
        meaning="the sampler is not the learner's policy: their log-probabilities differ",
        bound=0.1,
        reason="ten times what bfloat16 rounds a token off; beyond it weights, positions or a temperature differ",
        check=lambda now, start: now.get("sampler_gap"),  # mean of a token, nat; a lag of the sampler is part of it
        at_once=True,
    ),
)


class AlarmMonitor:
    """Checks the metrics of a run by some rules; it keeps the last `WINDOW` steps and the first `START`."""

    def __init__(self, rules: tuple[AlarmRule, ...] = RULES) -> None:
        self._rules = rules
        self._first: list[Metrics] = []
        self._last: collections.deque[Metrics] = collections.deque(maxlen=WINDOW)
        self._left_out: collections.deque[bool] = collections.deque(maxlen=WINDOW)

    def update(self, metrics: Metrics, *, left_out: bool = False) -> list[Alarm]:
        """The alarms after one more step; before the first window is full, only those that judge single steps.

        Where an update was `left_out`, or `lost_updates` counts one, only alarms of single steps judge the step, whose
        metrics may be missing or not finite.
        """
        left_out = left_out or metrics.get("lost_updates", 0.0) > 0
        self._left_out.append(left_out)
        at_once = {**metrics, LEFT_OUT: sum(self._left_out) / WINDOW}
        found = [rule.alarm(at_once, at_once) for rule in self._rules if rule.at_once]
        if not left_out:
            self._last.append(metrics)
            if len(self._first) < START:
                self._first.append(metrics)
            if len(self._last) == WINDOW:
                now, start = _mean(self._last), _mean(self._first)
                found += [rule.alarm(now, start) for rule in self._rules if not rule.at_once]
        return [alarm for alarm in found if alarm is not None]


def _mean(steps: Collection[Metrics]) -> Metrics:
    """Mean over steps of what all of them log: a score on held-out data stands on some lines only."""
    first, *others = steps
    return {name: sum(m[name] for m in steps) / len(steps) for name in first if all(name in m for m in others)}
