"""The components of Touch-R1's objective: for each, the arm that adds it to the ladder and the arm that omits it.

Every arm of GRPO starts from the SFT checkpoint of its seed and sees the same questions in the same order.
"""

import dataclasses
from collections.abc import Iterable, Mapping

from experiments.core.context import Context
from experiments.study import paper_numbers as paper
from experiments.study.scores import PUBLISHED
from experiments.study.stages import Weights
from experiments.study.study import SFT, EvalVariant, Study, StudyConfig, run_study
from touchr1_jax.rl.config import AnyAlgorithm, Paper, TactileUse

BASE, FULL, NO_SFT = "constant", "full", "no_sft"
"""The base is the commonest level of each attribute: the paper's, a pretrained model asked without training, answers
near chance too, while nothing can be read in the answers of a policy that is untrained here."""

BASE_ROW = "Qwen2.5-VL-7B"  # of the paper's ladder


def published_without(*terms: str) -> Weights:
    """The published reward weights without some terms."""
    return {name: weight for name, weight in PUBLISHED.items() if name not in terms}


ZERO_ONE: Weights = {"exact": PUBLISHED["accuracy"], **published_without("accuracy")}
"""The published reward with 0/1 credit in place of ordinal credit."""

UNGROUNDED = Paper(gamma=0.0)  # GRPO without the grounding term

WITH_TACTILE_USE = Paper(tactile_use=TactileUse.RECOMMENDED)
"""The published objective with credit for the use of touch, which no equation of the paper contains."""


@dataclasses.dataclass(frozen=True)
class ComponentArm:
    """An arm of GRPO: its name, its reward weights and its algorithm; `weights` is `None` where GRPO does not run."""

    name: str
    weights: Weights | None = None
    algorithm: AnyAlgorithm = UNGROUNDED


@dataclasses.dataclass(frozen=True)
class Component:
    """One component: the paper's first row that has it, the ladder up to it, and the full objective without it."""

    name: str
    row: str | None
    added: ComponentArm
    omitted: ComponentArm


def omitted(name: str, weights: Weights = PUBLISHED, algorithm: AnyAlgorithm = WITH_TACTILE_USE) -> ComponentArm:
    """The full objective with other weights or another algorithm."""
    return ComponentArm(name, weights, algorithm)


COMPONENTS: tuple[Component, ...] = (
    Component("SFT", "+ Cold-start SFT", added=ComponentArm(SFT), omitted=omitted(NO_SFT)),
    Component(
        "accuracy reward",
        "+ GRPO (0/1)",
        added=ComponentArm("zero_one", {"exact": ZERO_ONE["exact"]}),
        omitted=omitted("no_accuracy", published_without("accuracy")),
    ),
    Component(
        "ordinal credit",
        "+ Ordinal Reward",
        added=ComponentArm("ordinal", published_without("consistency", "format")),
        omitted=omitted("no_ordinal", ZERO_ONE),
    ),
    Component(
        "consistency",
        "+ Consistency Reward",
        added=ComponentArm("consistency", published_without("format")),
        omitted=omitted("no_consistency", published_without("consistency")),
    ),
    Component(
        "format",
        "+ Format Reward",
        added=ComponentArm("format", PUBLISHED),
        omitted=omitted("no_format", published_without("format")),
    ),
    Component(
        "grounding G_tg",
        "Touch-R1",
        added=ComponentArm("grounding", PUBLISHED, Paper()),
        omitted=omitted("no_grounding", algorithm=dataclasses.replace(WITH_TACTILE_USE, gamma=0.0)),
    ),
    Component(
        "tactile use R_tu",
        None,
        added=ComponentArm("tactile_use", PUBLISHED, WITH_TACTILE_USE),
        omitted=omitted("no_tactile_use", algorithm=Paper()),
    ),
)
"""In the order of the paper's ladder; no equation contains the last."""


def published_steps() -> dict[str, tuple[float, ...] | None]:
    """Component → change of OMAE, CSC and Avg from the row below it in the paper's ladder; `None` without a row."""
    steps: dict[str, tuple[float, ...] | None] = {}
    below = paper.LADDER[BASE_ROW]
    for component in COMPONENTS:
        row = None if component.row is None else paper.LADDER[component.row]
        steps[component.name] = None if row is None else tuple(a - b for a, b in zip(row, below, strict=True))
        below = below if row is None else row
    return steps


def reinforced(arms: Iterable[ComponentArm]) -> tuple[dict[str, Weights], Mapping[str, AnyAlgorithm]]:
    """Reward weights and algorithms of the arms that GRPO trains, by name."""
    trained = [(arm, arm.weights) for arm in arms if arm.weights is not None]
    return {arm.name: weights for arm, weights in trained}, {arm.name: arm.algorithm for arm, _ in trained}


def run_full_model(config: StudyConfig, context: Context, variants: Mapping[str, EvalVariant] = {}) -> Study:
    """A study of one arm, the full model of the paper's equations: published rewards and grounding."""
    return run_study(config, {FULL: PUBLISHED}, context, {FULL: Paper()}, variants)
