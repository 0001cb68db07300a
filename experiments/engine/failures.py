"""Known failures of reinforcement learning from touch: the parameter that provokes each, and when a seed has failed.

F1 … F13 are the codes of `touchr1_jax.rl.alarms`.  Each criterion measures one failure only and was fixed before the
reported runs.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from experiments.engine.world import K, S, World
from experiments.engine.world_training import GrpoVariant, Setting, VariantRun, hyperparameters_of
from touchr1_jax.rl.config import GRPOConfig, Paper, Stable, TactileUse
from touchr1_jax.rl.stream_check import ROUNDING_NAT

WATCHING = Paper(tactile_use=TactileUse.RECOMMENDED, tactile_weight=0.0)
PAPER = GrpoVariant(name="paper", algorithm=Paper())
STABLE = GrpoVariant(name="stable", algorithm=Stable())
WATCHED = GrpoVariant(name="paper, controls watched", algorithm=WATCHING)
LITERAL = GrpoVariant(name="paper, literal bonus", algorithm=Paper(tactile_use=TactileUse.LITERAL), accuracy="exact")
SCORE_FUNCTION = GrpoVariant(name="paper, KL by k1", algorithm=Paper(kl="k1"))

PLAIN = World()
NO_TOUCH = World(noise=4.0, sight=0.9)  # touch with next to no information, and a picture that is nearly always right
ANCHORED = World(anchored=0.8)  # a supervised policy that concludes what it sees although touch is more often right
Knob = Callable[[GrpoVariant, float], Setting]  # (variant, value) → setting of the world and the hyperparameters


@dataclasses.dataclass(frozen=True)
class FailureScenario:
    """A failure with the code of its alarm, the knob that drives it, and the criterion of a failed seed.

    The knob has values from the mildest on, which `setting` applies; the criterion says `failed` in words.  The variant
    `failing` is compared with the `stable` preset; `others` are codes of other alarms that notice the same failure.
    """

    code: str
    title: str
    knob: str
    values: tuple[float, ...]
    criterion: str
    failing: GrpoVariant
    setting: Knob
    failed: Callable[[VariantRun], np.ndarray]
    others: tuple[str, ...] = ()

    @property
    def slug(self) -> str:
        """Its part of the stages' names."""
        return "-".join([self.code, *self.title.replace(",", "").split()[:2]])

    @property
    def alarms(self) -> tuple[str, ...]:
        """Codes of the alarms of which one should fire."""
        return (self.code, *self.others)


def _hyperparameter(name: str, world: World = PLAIN) -> Knob:
    return lambda variant, value: (world, hyperparameters_of(variant)._replace(**{name: value}))


def _world(field: str, world: World = PLAIN) -> Knob:
    return lambda variant, value: (world._replace(**{field: value}), hyperparameters_of(variant))


def _time_ids(variant: GrpoVariant, fps: float) -> Setting:
    """Two frames a step: the paper's base model advances time ids by int(seconds a step) · 2, this engine by frames."""
    tick = 2 if variant is STABLE else 2 * int(2 / fps)
    return World(asked=1, noise=0.3, tick=tick), hyperparameters_of(variant)


def _standing_still(variant: GrpoVariant, sight: float) -> Setting:
    """Touch without information, and the paper's learning rate, at which the small policy does not change."""
    return World(noise=8.0, sight=sight), hyperparameters_of(variant)._replace(learning_rate=GRPOConfig().learning_rate)


def _lenience(variant: GrpoVariant, value: float) -> Setting:
    """The library's parser, which `stable` keeps, reads no level from an answer that names several."""
    return PLAIN, hyperparameters_of(variant)._replace(lenient=0.0 if variant is STABLE else value)


def _unlearns(run: VariantRun) -> np.ndarray:
    return run.gain("accuracy") < -0.1


def _bonus_cancels(run: VariantRun) -> np.ndarray:
    telling = run.late("bonus_telling_share")
    return (telling > 0.02) & (run.late("bonus_cancelled_share") > 0.5 * telling)


def _noise_is_detected(run: VariantRun) -> np.ndarray:
    return (run.after["grounding"] > 0.3) & (run.after["accuracy"] - run.after["accuracy_swap"] < 0.05)


GAMMAS = (0.01, 0.16, 0.64, 2.56)

SCENARIOS = (
    FailureScenario(
        "F1", "answers drift to the middle level", "noise of touch σ, levels", (0.4, 1.0, 1.5, 2.5),
        "middle answers exceed middle labels by more than .25",
        PAPER, _world("noise"), lambda run: run.after["middle"] - 1 / K > 0.25,
    ),
    FailureScenario(
        "F2", "slots copy each other", "weight of consistency", (0.3, 0.7, 0.85, 0.9),
        "all slots agree in more than 90 % and are right 10 points less often than before",
        PAPER, _hyperparameter("consistency"),
        lambda run: (run.after["echo_share"] > 0.9) & (run.gain("slots_right") < -0.1),
    ),
    FailureScenario(
        "F3", "grounding without bound", "weight of grounding γ", GAMMAS,
        "accuracy more than 10 points below the start", PAPER, _hyperparameter("gamma"), _unlearns,
    ),
    FailureScenario(
        "F4", "noise is detected, touch is not read", "weight of grounding γ, useless touch", GAMMAS,
        "grounding above .3 nat a token, another object's touch costs less than 5 points",
        WATCHED, _hyperparameter("gamma", NO_TOUCH), _noise_is_detected, ("F3",),
    ),
    FailureScenario(
        "F5", "the tactile bonus cancels", "weight of consistency, 0/1 accuracy", (0.8, 0.3, 0.0),
        "of the groups with different bonuses, more than half have the same advantages as without the bonus",
        LITERAL, _hyperparameter("consistency"), _bonus_cancels,
    ),
    FailureScenario(
        "F6", "tactile credit by chance", "share of right pictures, useless touch", (1.0, 0.6, 0.0),
        "more than 14.6 % of the groups of an untrained policy earn credit: 12 %, and two standard errors of "
        "640 groups",
        LITERAL, _standing_still, lambda run: run.metrics["tactile_credit_share"].mean(1) > 0.146,
    ),
    FailureScenario(
        "F7", "groups of equal rewards", "sharpness of the start (factor on logits)", (1.0, 2.0, 4.0, 16.0),
        "more than half of the groups are constant and accuracy is more than 5 points below the start",
        PAPER, _world("sharp", ANCHORED),
        lambda run: (run.late("degenerate_share") > 0.5) & (run.gain("accuracy") < -0.05),
    ),
    FailureScenario(
        "F8", "the KL estimate does not hold", "weight of the reference KL β", (1e-3, 1.0, 10.0, 100.0),
        "exact KL to the reference above 1 nat a token",
        SCORE_FUNCTION, _hyperparameter("beta"), lambda run: run.after["kl"] > 1.0,
    ),
    FailureScenario(
        "F9", "entropy grows without bound", "weight of the entropy bonus", (0.03, 0.1, 0.3, 1.0),
        "entropy more than .2 nat a token above the start, accuracy more than 10 points below",
        PAPER, _hyperparameter("entropy_weight"), lambda run: (run.gain("entropy") > 0.2) & _unlearns(run),
    ),
    FailureScenario(
        "F9", "large steps collapse to one answer", "learning rate", (0.003, 0.01, 0.03, 0.1),
        "accuracy more than 10 points below the start", PAPER, _hyperparameter("learning_rate"), _unlearns, ("F7",),
    ),
    FailureScenario(
        "F10", "a stream without influence", "share of the second sensor's touch that arrives", (1.0, 0.3, 0.1, 0.0),
        "noise in it moves no answer, and training goes on",
        PAPER, _world("kept"),
        lambda run: (run.after[f"grounding_{S - 1}"] <= ROUNDING_NAT) & (not run.refused),
    ),
    FailureScenario(
        "F12", "equal time indices", "frames a second", (1.0, 2.0, 4.0, 8.0),
        "the shuffle of steps can change less than half of the prompts",
        LITERAL, _time_ids, lambda run: run.after["shuffled"] < 0.5,
    ),
    FailureScenario(
        "F13", "unparsable answers are rewarded", "credit for naming the answer among others", (0.0, 0.5, 0.75, 1.0),
        "more than half of the answers name levels but cannot be parsed",
        PAPER, _lenience, lambda run: run.after["gamed_share"] > 0.5,
    ),
)  # fmt: skip
