"""Known failures of reinforcement learning from touch: for each the knob that drives it and when a seed has failed.

F1 … F13 are the codes of `touchr1_jax.rl.alarms`.  Each criterion measures one failure alone and was fixed before the
runs that are reported.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from experiments.engine.world import K, S, World
from experiments.engine.world_training import GrpoVariant, Setting, VariantRun, hyperparameters_of
from touchr1_jax.rl.config import GRPOConfig, Paper, Stable, TactileUse
from touchr1_jax.rl.stream_check import ROUNDING_NAT

PAPER = GrpoVariant(name="paper", algorithm=Paper())
STABLE = GrpoVariant(name="stable", algorithm=Stable(), accuracy="accuracy_debiased", consistency="consistency_gated")
WATCHED = GrpoVariant(
    name="paper, controls watched",
    algorithm=Paper(tactile_use=TactileUse.RECOMMENDED, tactile_weight=0.0),
)
LITERAL = GrpoVariant(name="paper, literal bonus", algorithm=Paper(tactile_use=TactileUse.LITERAL), accuracy="exact")
SCORE_FUNCTION = GrpoVariant(name="paper, k1", algorithm=Paper(kl="k1"))

PLAIN = World()


@dataclasses.dataclass(frozen=True, kw_only=True)
class FailureScenario:
    """A failure, the knob that drives it, and the criterion of a failed seed.

    Attributes:
      code: that of its alarm.
      title: what fails.
      knob: what `values` mean.
      values: of the knob, from the mildest on.
      criterion: `failed` in words.
      failing: variant that is compared with the `stable` preset.
      setting: (variant, value) → setting of the world and the hyperparameters.
      failed: run → whether each seed has failed.
      others: codes of other alarms that notice the same failure.
    """

    code: str
    title: str
    knob: str
    values: tuple[float, ...]
    criterion: str
    failing: GrpoVariant
    setting: Callable[[GrpoVariant, float], Setting]
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


def _hyperparameter(name: str, world: World = PLAIN) -> Callable[[GrpoVariant, float], Setting]:
    """The knob is a hyperparameter, in a fixed world."""
    return lambda variant, value: (world, hyperparameters_of(variant)._replace(**{name: value}))


def _world(field: str, world: World = PLAIN) -> Callable[[GrpoVariant, float], Setting]:
    """The knob is a property of the world."""
    return lambda variant, value: (world._replace(**{field: value}), hyperparameters_of(variant))


def _unlearns(run: VariantRun) -> np.ndarray:
    return run.gain("accuracy") < -0.1


def _bonus_cancels(run: VariantRun) -> np.ndarray:
    telling = run.late("bonus_telling_share")
    return (telling > 0.02) & (run.late("bonus_cancelled_share") > 0.5 * telling)


NO_TOUCH = World(noise=4.0, sight=0.9)
"""Touch with next to no information, and a picture that is nearly always right."""
ANCHORED = World(anchored=0.8)
"""A supervised policy that concludes what it sees although touch is more often right."""


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


GAMMAS = (0.01, 0.16, 0.64, 2.56)

SCENARIOS = (
    FailureScenario(
        code="F1",
        title="answers drift to the middle level",
        knob="noise of touch σ, levels",
        values=(0.4, 1.0, 1.5, 2.5),
        criterion="middle answers exceed middle labels by more than .25",
        failing=PAPER,
        setting=_world("noise"),
        failed=lambda run: run.after["middle"] - 1 / K > 0.25,
    ),
    FailureScenario(
        code="F2",
        title="slots echo each other",
        knob="weight of consistency",
        values=(0.3, 0.7, 0.85, 0.9),
        criterion="all slots agree in more than 90 % and are right 10 points less often than before",
        failing=PAPER,
        setting=_hyperparameter("consistency"),
        failed=lambda run: (run.after["echo_share"] > 0.9) & (run.gain("slots_right") < -0.1),
    ),
    FailureScenario(
        code="F3",
        title="grounding without bound",
        knob="weight of grounding γ",
        values=GAMMAS,
        criterion="accuracy more than 10 points below the start",
        failing=PAPER,
        setting=_hyperparameter("gamma"),
        failed=_unlearns,
    ),
    FailureScenario(
        code="F4",
        title="noise is detected, touch is not read",
        knob="weight of grounding γ, useless touch",
        values=GAMMAS,
        criterion="grounding above .3 nat a token, another object's touch costs less than 5 points",
        failing=WATCHED,
        setting=_hyperparameter("gamma", NO_TOUCH),
        failed=lambda run: (run.after["grounding"] > 0.3) & (run.after["accuracy"] - run.after["accuracy_swap"] < 0.05),
        others=("F3",),
    ),
    FailureScenario(
        code="F5",
        title="the tactile bonus cancels",
        knob="weight of consistency, 0/1 accuracy",
        values=(0.8, 0.3, 0.0),
        criterion="of the groups that the bonus tells apart, more than half have the advantages of before",
        failing=LITERAL,
        setting=_hyperparameter("consistency"),
        failed=_bonus_cancels,
    ),
    FailureScenario(
        code="F6",
        title="tactile credit by chance",
        knob="share of right pictures, useless touch",
        values=(1.0, 0.6, 0.0),
        # the rate that R_tu is designed for, and two standard errors of all groups, those of 80 steps of 8
        criterion="more than 14.6 % of the groups of a policy that stands still earn credit: 12 %, and two standard "
        "errors of 640 groups",
        failing=LITERAL,
        setting=_standing_still,
        failed=lambda run: run.metrics["tactile_credit_share"].mean(1) > 0.146,
    ),
    FailureScenario(
        code="F7",
        title="groups that teach nothing",
        knob="sharpness of the start (factor on logits)",
        values=(1.0, 2.0, 4.0, 16.0),
        criterion="more than half of the groups are constant and accuracy is more than 5 points below the start",
        failing=PAPER,
        setting=_world("sharp", ANCHORED),
        failed=lambda run: (run.late("degenerate_share") > 0.5) & (run.gain("accuracy") < -0.05),
    ),
    FailureScenario(
        code="F8",
        title="the KL estimate does not hold",
        knob="weight of the reference KL β",
        values=(1e-3, 1.0, 10.0, 100.0),
        criterion="exact KL to the reference above 1 nat a token",
        failing=SCORE_FUNCTION,
        setting=_hyperparameter("beta"),
        failed=lambda run: run.after["kl"] > 1.0,
    ),
    FailureScenario(
        code="F9",
        title="entropy blows up",
        knob="weight of the entropy bonus",
        values=(0.03, 0.1, 0.3, 1.0),
        criterion="entropy more than .2 nat a token above the start, accuracy more than 10 points below",
        failing=PAPER,
        setting=_hyperparameter("entropy_weight"),
        failed=lambda run: (run.gain("entropy") > 0.2) & _unlearns(run),
    ),
    FailureScenario(
        code="F9",
        title="long steps end in one answer",
        knob="learning rate",
        values=(0.003, 0.01, 0.03, 0.1),
        criterion="accuracy more than 10 points below the start",
        failing=PAPER,
        setting=_hyperparameter("learning_rate"),
        failed=_unlearns,
        others=("F7",),
    ),
    FailureScenario(
        code="F10",
        title="a stream that never arrives",
        knob="share of the second sensor's touch that arrives",
        values=(1.0, 0.3, 0.1, 0.0),
        criterion="noise in it moves no answer, and training goes on",
        failing=PAPER,
        setting=_world("kept"),
        failed=lambda run: (run.after[f"grounding_{S - 1}"] <= ROUNDING_NAT) & (not run.refused),
    ),
    FailureScenario(
        code="F12",
        title="time ids stand still",
        knob="frames a second",
        values=(1.0, 2.0, 4.0, 8.0),
        criterion="the shuffle of steps can change less than half of the prompts",
        failing=LITERAL,
        setting=_time_ids,
        failed=lambda run: run.after["shuffled"] < 0.5,
    ),
    FailureScenario(
        code="F13",
        title="the parser is gamed",
        knob="credit for naming the answer among others",
        values=(0.0, 0.5, 0.75, 1.0),
        criterion="more than half of the answers name levels where they cannot be read",
        failing=PAPER,
        setting=_lenience,
        failed=lambda run: run.after["gamed_share"] > 0.5,
    ),
)
