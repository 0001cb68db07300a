"""The rungs of the paper's ladder, each an arm of a study, and what is left when one component is taken out.

Every rung of GRPO starts from the same SFT checkpoint of its seed and sees the same questions in the same order.
"""

import dataclasses
from collections.abc import Mapping

from experiments.study.assembly import Weights
from experiments.study.scores import PUBLISHED
from experiments.study.study import SFT
from touchr1_jax.rl.config import AnyAlgorithm, Paper, TactileUse

BASE, FULL, NO_SFT = "constant", "full", "no_sft"
"""The base is the commonest level of each attribute: the paper's, a pretrained model asked without training, answers
near chance too, while a policy that is untrained here says nothing that can be read."""

PLAIN = Paper(gamma=0.0)
"""GRPO without the grounding term."""

WHOLE = Paper(tactile_use=TactileUse.RECOMMENDED)
"""The published objective with credit for the use of touch, which the paper's abstract names and no equation holds."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rung:
    """One rung.

    Attributes:
      name: of the arm.
      published: row of the paper's ladder, `None` where it has none.
      adds: the component that it adds to the rung below.
      weights: of the rewards; `None` where nothing is reinforced.
      algorithm: of GRPO.
    """

    name: str
    published: str | None
    adds: str
    weights: Weights | None = None
    algorithm: AnyAlgorithm = PLAIN


LADDER: tuple[Rung, ...] = (
    Rung(name=BASE, published="Qwen2.5-VL-7B", adds=""),
    Rung(name=SFT, published="+ Cold-start SFT", adds="SFT"),
    Rung(name="zero_one", published="+ GRPO (0/1)", adds="0/1 accuracy", weights={"exact": 0.6}),
    Rung(name="ordinal", published="+ Ordinal Reward", adds="ordinal credit", weights={"accuracy": 0.6}),
    Rung(
        name="consistency",
        published="+ Consistency Reward",
        adds="consistency",
        weights={"accuracy": 0.6, "consistency": 0.3},
    ),
    Rung(name="format", published="+ Format Reward", adds="format", weights=PUBLISHED),
    Rung(name="grounding", published="Touch-R1", adds="grounding G_tg", weights=PUBLISHED, algorithm=Paper()),
    Rung(name="tactile_use", published=None, adds="tactile use R_tu", weights=PUBLISHED, algorithm=WHOLE),
)
"""The rungs in the paper's order, and one more for the reward that only its abstract has."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Omission:
    """The full objective without one component: the arm, the component, its step in the paper's ladder."""

    name: str
    component: str
    step: tuple[str, str] | None
    weights: Weights
    algorithm: AnyAlgorithm = WHOLE


OMISSIONS: tuple[Omission, ...] = (
    Omission(name=NO_SFT, component="SFT", step=("+ Cold-start SFT", "Qwen2.5-VL-7B"), weights=PUBLISHED),
    Omission(
        name="no_accuracy",
        component="accuracy reward",
        step=("+ GRPO (0/1)", "+ Cold-start SFT"),
        weights={"consistency": 0.3, "format": 0.1},
    ),
    Omission(
        name="no_ordinal",
        component="ordinal credit",
        step=("+ Ordinal Reward", "+ GRPO (0/1)"),
        weights={"exact": 0.6, "consistency": 0.3, "format": 0.1},
    ),
    Omission(
        name="no_consistency",
        component="consistency",
        step=("+ Consistency Reward", "+ Ordinal Reward"),
        weights={"accuracy": 0.6, "format": 0.1},
    ),
    Omission(
        name="no_format",
        component="format",
        step=("+ Format Reward", "+ Consistency Reward"),
        weights={"accuracy": 0.6, "consistency": 0.3},
    ),
    Omission(
        name="no_grounding",
        component="grounding G_tg",
        step=("Touch-R1", "+ Format Reward"),
        weights=PUBLISHED,
        algorithm=dataclasses.replace(WHOLE, gamma=0.0),
    ),
    Omission(name="no_tactile_use", component="tactile use R_tu", step=None, weights=PUBLISHED, algorithm=Paper()),
)
"""Every component left out in turn; its step in the paper is one of the ladder, not a leave-one-out."""


def arms(rungs: tuple[Rung, ...] = LADDER) -> tuple[dict[str, Weights], dict[str, AnyAlgorithm]]:
    """Reward weights and algorithms of the rungs that reinforce, as `run_study` takes them."""
    trained = [(rung, rung.weights) for rung in rungs if rung.weights is not None]
    return {rung.name: weights for rung, weights in trained}, {rung.name: rung.algorithm for rung, _ in trained}


def omitted() -> tuple[dict[str, Weights], Mapping[str, AnyAlgorithm]]:
    """The same of the full objective and of every omission that starts from SFT."""
    kept = [o for o in OMISSIONS if o.name != NO_SFT]
    weights = {FULL: PUBLISHED, **{o.name: o.weights for o in kept}}
    return weights, {FULL: WHOLE, **{o.name: o.algorithm for o in kept}}
