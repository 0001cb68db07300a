"""Alarms of policies that choose touches: known failures, each with a remedy.

The rules and bounds work as those of `alarms`, on the metrics of `active.exploration_metrics`.
"""

from touchr1_jax.rl.alarms import RULES, AlarmRule, Metrics, of_candidates, untouched_share

SHARED = ("F3", "F7", "F8", "F9", "F10", "F15", "F16")
"""Codes of the rules of `alarms` that hold for trajectories too."""


def single_share(now: Metrics, start: Metrics) -> float | None:
    """Share of trajectories with one action although several are allowed, while answers do not improve."""
    several = now["budget"] > 1 and of_candidates(now, "accuracy") <= of_candidates(start, "accuracy")
    return now["one_action_share"] if several else None


def full_share(now: Metrics, start: Metrics) -> float | None:
    """Share of trajectories with as many actions as allowed, if several are allowed and have a price."""
    del start
    return now["all_actions_share"] if now["budget"] > 1 and now.get("reward_seconds", 0.0) < 0 else None


def question_of_first_kind(now: Metrics, start: Metrics) -> float | None:
    """Mutual information of question and first kind of action, nat, if one of several kinds is half of all."""
    del start
    differ = now["questions"] > 1 and now["kinds"] > 1 and now["no_action_share"] < 0.5
    return now["first_kind_information"] if differ and now["first_kind_peak"] >= 0.5 else None


ACTIVE_RULES: tuple[AlarmRule, ...] = (
    *(rule for rule in RULES if rule.code in SHARED and rule.check is not untouched_share),  # A1 counts these
    AlarmRule(
        code="A1",
        meaning="the policy never touches: lower the prices, or start from a policy that touches at random",
        bound=0.95,
        reason="one group of eight trajectories in three then has no touch at all to compare with",
        check=lambda now, start: now["no_action_share"],
    ),
    AlarmRule(
        code="A2",
        meaning="the policy always touches once and gets no better: add an entropy bonus, or warm up on longer "
        "trajectories",
        bound=0.98,
        reason="a group of eight then compares numbers of touches in one case of seven",
        check=single_share,
    ),
    AlarmRule(
        code="A3",
        meaning="the policy makes every touch that is allowed: raise the price of a second",
        bound=0.98,
        reason="a group of eight then compares numbers of touches in one case of seven",
        check=full_share,
    ),
    AlarmRule(
        code="A4",
        meaning="the policy starts with one kind of touch for all questions: enumerate the answers' rewards, or add an "
        "entropy bonus",
        bound=0.1,
        reason="one question in ten with its own kind of touch gives more; 640 random first touches give .02",
        check=question_of_first_kind,
        below=True,
    ),
    AlarmRule(
        code="A5",
        meaning="most touches observe nothing: leave the choices out that are not available",
        bound=0.5,
        reason="half of the price is then paid for nothing",
        check=lambda now, start: now["silent_share"],
    ),
)
