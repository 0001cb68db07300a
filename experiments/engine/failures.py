"""The known failures of reinforcement from touch, each as a scenario: a knob, when a seed has failed, and the cure.

F1 … F13 are the codes of `touchr1_jax.rl.alarms`.  Every failure is a number of that failure alone and was written down
before the runs that are reported.
"""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from experiments.engine.training import GrpoVariant, Hyperparameters, dials_of
from experiments.engine.world import K, S, World
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

LATE = 40
"""Last steps of a run that a failure of the training signal is read from."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariantRun:
    """Ten seeds of one variant at one value of a knob; every array has the seeds as its first axis.

    `before` and `after` are examinations, `metrics` what every step logged, `refused` says that the engine raised.
    """

    before: Mapping[str, np.ndarray]
    after: Mapping[str, np.ndarray]
    metrics: Mapping[str, np.ndarray]
    refused: bool = False

    def late(self, name: str) -> np.ndarray:
        """Mean of a metric over the last steps."""
        return self.metrics[name][:, -LATE:].mean(1)

    def gain(self, name: str) -> np.ndarray:
        """What training has added to a figure."""
        return self.after[name] - self.before[name]

    def lead(self, control: str) -> np.ndarray:
        """Accuracy with true touch minus that under a control."""
        return self.after["accuracy"] - self.after[f"accuracy_{control}"]


Place = tuple[World, Hyperparameters]
PLAIN = World()


@dataclasses.dataclass(frozen=True, kw_only=True)
class FailureScenario:
    """A failure, the knob that drives it, and the two that are driven.

    `place` says where a variant stands at a value of the knob.
    """

    code: str
    title: str
    knob: str
    values: tuple[float, ...]
    criterion: str
    failing: GrpoVariant
    place: Callable[[GrpoVariant, float], Place]
    failed: Callable[[VariantRun], np.ndarray]
    others: tuple[str, ...] = ()
    """Codes of other alarms that say the same."""

    @property
    def slug(self) -> str:
        """The scenario's name as the name of a stage."""
        return "-".join([self.code, *self.title.replace(",", "").split()[:2]])

    @property
    def alarms(self) -> tuple[str, ...]:
        """Codes of the alarms that ought to fire."""
        return (self.code, *self.others)


def _turn(dial: str, world: World = PLAIN) -> Callable[[GrpoVariant, float], Place]:
    """Turn one dial in a fixed world."""
    return lambda variant, value: (world, Hyperparameters(**(dials_of(variant)._asdict() | {dial: value})))


def _change(field: str, world: World = PLAIN) -> Callable[[GrpoVariant, float], Place]:
    """Change one thing in the world."""
    return lambda variant, value: (World(**(world._asdict() | {field: value})), dials_of(variant))


def _drifts_to_middle(c: VariantRun) -> np.ndarray:
    return c.after["middle"] - 1 / K > 0.25


def _echoes(c: VariantRun) -> np.ndarray:
    return (c.after["echo_share"] > 0.9) & (c.gain("slots_right") < -0.1)


def _unlearns(c: VariantRun) -> np.ndarray:
    return c.gain("accuracy") < -0.1


def _detects_noise(c: VariantRun) -> np.ndarray:
    return (c.after["grounding"] > 0.3) & (c.lead("swap") < 0.05)


def _bonus_cancels(c: VariantRun) -> np.ndarray:
    telling = c.late("bonus_telling_share")
    return (telling > 0.02) & (c.late("bonus_cancelled_share") > 0.5 * telling)


def _credit_by_chance(c: VariantRun) -> np.ndarray:
    """Beyond the rate that R_tu is designed for by two standard errors of all groups, those of 80 steps of 8."""
    return c.metrics["tactile_credit_share"].mean(1) > 0.146


def _idles(c: VariantRun) -> np.ndarray:
    return (c.late("degenerate_share") > 0.5) & (c.gain("accuracy") < -0.05)


def _penalty_does_not_hold(c: VariantRun) -> np.ndarray:
    return c.after["kl"] > 1.0


def _entropy_blows_up(c: VariantRun) -> np.ndarray:
    return (c.gain("entropy") > 0.2) & _unlearns(c)


def _stream_forgotten(c: VariantRun) -> np.ndarray:
    """Noise in the last stream moves no answer, and training went on."""
    return (c.after[f"grounding_{S - 1}"] <= ROUNDING_NAT) & (not c.refused)


def _shuffle_is_vacuous(c: VariantRun) -> np.ndarray:
    return c.after["shuffled"] < 0.5


def _gamed(c: VariantRun) -> np.ndarray:
    return c.after["gamed_share"] > 0.5


NO_TOUCH = World(noise=4.0, sight=0.9)
"""Touch that says next to nothing, a picture that is nearly always right."""
ANCHORED = World(anchored=0.8)
"""A supervised policy that concludes what it sees, with touch that knows better."""


def _time_ids(variant: GrpoVariant, fps: float) -> Place:
    """Two frames a step: the paper's base model counts int(seconds a step) · 2 ids, the engine counts frames."""
    tick = 2 if variant is STABLE else 2 * int(2 / fps)
    return World(asked=1, noise=0.3, tick=tick), dials_of(variant)


def _standing_still(variant: GrpoVariant, sight: float) -> Place:
    """Touch that says nothing, and the paper's own learning rate, at which the small policy stays what it is."""
    return World(noise=8.0, sight=sight), dials_of(variant)._replace(learning_rate=GRPOConfig().learning_rate)


def _lenience(variant: GrpoVariant, value: float) -> Place:
    """The engine's parser reads nothing into an answer that names several levels."""
    return World(), dials_of(variant)._replace(lenient=0.0 if variant is STABLE else value)


GAMMAS = (0.01, 0.16, 0.64, 2.56)

SCENARIOS = (
    FailureScenario(
        code="F1",
        title="answers drift to the middle level",
        knob="noise of touch σ, levels",
        values=(0.4, 1.0, 1.5, 2.5),
        criterion="middle answers exceed middle labels by more than .25",
        failing=PAPER,
        place=_change("noise"),
        failed=_drifts_to_middle,
    ),
    FailureScenario(
        code="F2",
        title="slots echo each other",
        knob="weight of consistency",
        values=(0.3, 0.7, 0.85, 0.9),
        criterion="all slots agree in more than 90 % and are right 10 points less often than before",
        failing=PAPER,
        place=_turn("consistency"),
        failed=_echoes,
    ),
    FailureScenario(
        code="F3",
        title="grounding without bound",
        knob="weight of grounding γ",
        values=GAMMAS,
        criterion="accuracy more than 10 points below the start",
        failing=PAPER,
        place=_turn("gamma"),
        failed=_unlearns,
    ),
    FailureScenario(
        code="F4",
        title="noise is detected, touch is not read",
        knob="weight of grounding γ, useless touch",
        values=GAMMAS,
        criterion="grounding above .3 nat a token, another object's touch costs less than 5 points",
        failing=WATCHED,
        place=_turn("gamma", NO_TOUCH),
        failed=_detects_noise,
        others=("F3",),
    ),
    FailureScenario(
        code="F5",
        title="the tactile bonus cancels",
        knob="weight of consistency, 0/1 accuracy",
        values=(0.8, 0.3, 0.0),
        criterion="of the groups that the bonus tells apart, more than half have the advantages of before",
        failing=LITERAL,
        place=_turn("consistency"),
        failed=_bonus_cancels,
    ),
    FailureScenario(
        code="F6",
        title="tactile credit by chance",
        knob="share of right pictures, useless touch",
        values=(1.0, 0.6, 0.0),
        criterion="more than 14.6 % of the groups of a policy that stands still earn credit: 12 %, and two standard "
        "errors of 640 groups",
        failing=LITERAL,
        place=_standing_still,
        failed=_credit_by_chance,
    ),
    FailureScenario(
        code="F7",
        title="groups that teach nothing",
        knob="sharpness of the start (factor on logits)",
        values=(1.0, 2.0, 4.0, 16.0),
        criterion="more than half of the groups are constant and accuracy is more than 5 points below the start",
        failing=PAPER,
        place=_change("sharp", ANCHORED),
        failed=_idles,
    ),
    FailureScenario(
        code="F8",
        title="the KL estimate does not hold",
        knob="weight of the reference KL β",
        values=(1e-3, 1.0, 10.0, 100.0),
        criterion="exact KL to the reference above 1 nat a token",
        failing=SCORE_FUNCTION,
        place=_turn("beta"),
        failed=_penalty_does_not_hold,
    ),
    FailureScenario(
        code="F9",
        title="entropy blows up",
        knob="weight of the entropy bonus",
        values=(0.03, 0.1, 0.3, 1.0),
        criterion="entropy more than .2 nat a token above the start, accuracy more than 10 points below",
        failing=PAPER,
        place=_turn("entropy_weight"),
        failed=_entropy_blows_up,
    ),
    FailureScenario(
        code="F9",
        title="long steps end in one answer",
        knob="learning rate",
        values=(0.003, 0.01, 0.03, 0.1),
        criterion="accuracy more than 10 points below the start",
        failing=PAPER,
        place=_turn("learning_rate"),
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
        place=_change("kept"),
        failed=_stream_forgotten,
    ),
    FailureScenario(
        code="F12",
        title="time ids stand still",
        knob="frames a second",
        values=(1.0, 2.0, 4.0, 8.0),
        criterion="the shuffle of steps can change less than half of the prompts",
        failing=LITERAL,
        place=_time_ids,
        failed=_shuffle_is_vacuous,
    ),
    FailureScenario(
        code="F13",
        title="the parser is gamed",
        knob="credit for naming the answer among others",
        values=(0.0, 0.5, 0.75, 1.0),
        criterion="more than half of the answers name levels where they cannot be read",
        failing=PAPER,
        place=_lenience,
        failed=_gamed,
    ),
)
