"""Answers that earn reward without touch, under the rewards of every preset: a table, a chart and a requirement."""

import functools
import re
from collections.abc import Mapping, Sequence
from typing import get_args

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.look import PALETTE
from experiments.core.results import Cell, Picture, Requirement, Table, at_most, named_table
from experiments.study.scores import PUBLISHED
from touchr1_jax.rewards import make_rewards
from touchr1_jax.rewards.adversary import ACCURACY, Earnings, earnings, programs, with_prior
from touchr1_jax.rl.config import AnyAlgorithm
from touchr1_jax.rl.scoring import reward_weights

PRIORS: Mapping[str, Sequence[float]] = {
    "uniform": (1 / 3, 1 / 3, 1 / 3),
    ".5 / .3 / .2": (0.5, 0.3, 0.2),
    ".2 / .6 / .2": (0.2, 0.6, 0.2),
    ".1 / .1 / .8": (0.1, 0.1, 0.8),
}
"""Shares of the three levels among the labels."""

ACCURACIES = tuple(np.linspace(1 / 3, 1, 13).tolist())


def spelt(name: str) -> str:
    """A class of presets as the command line spells it, such as `dr-grpo`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower()


@functools.cache
def preset_earnings() -> dict[str, dict[str, Earnings]]:
    """Presets that share their rewards, by name → labels → what every program earns."""
    presets = [kind() for kind in get_args(AnyAlgorithm)]
    groups = [[preset for preset in presets if preset.stable_rewards == stable] for stable in (False, True)]
    return {
        ", ".join(spelt(type(preset).__name__) for preset in group): {
            labels: earnings(make_rewards(with_prior(prior)), reward_weights(group[0], PUBLISHED), prior)
            for labels, prior in PRIORS.items()
        }
        for group in groups
    }


def adversary_table() -> Table:
    """For each preset and distribution of labels the best answer that is not the honest one."""
    rows: list[dict[str, Cell]] = []
    for preset, by_labels in preset_earnings().items():
        for labels, found in by_labels.items():
            *others, honest = found.expected().tolist()
            best = int(np.argmax(others))
            row: dict[str, Cell] = {"presets": preset, "labels": labels, "honest": honest, "best other": others[best]}
            rows.append({**row, "answer": str(programs()[best]), "better": len(found.better())})
    return named_table(
        "Answers that earn more than an honest one",
        rows,
        formats={"honest": ".3f", "best other": ".4f"},
        meanings={
            "labels": "shares of the three levels",
            "honest": f"expected reward of reports and a conclusion that are each right in {ACCURACY:.0%}",
            "best other": f"largest expected reward of the {len(programs())} other programs",
            "answer": "layout: perceive → compare → conclude of that program",
            "better": "programs that earn more than the honest answer",
        },
    )


def adversary_requirement() -> Requirement:
    """No program beats the honest one under the rewards of `stable`, whatever the labels."""
    better = sum(len(found.better()) for found in preset_earnings()["stable"].values())
    return at_most("answers that outwit the rewards of stable", better, 0, note=f"of {len(programs())} × {len(PRIORS)}")


def adversary_picture() -> Picture:
    """Reward of the honest answer against the accuracy of its touch, with the best of all other answers."""
    panels = []
    for preset, by_labels in preset_earnings().items():
        series = []
        for i, labels in enumerate(("uniform", ".5 / .3 / .2")):
            each = np.array([by_labels[labels].expected(accuracy) for accuracy in ACCURACIES])
            series.append(Series(f"honest, labels {labels}", x=ACCURACIES, y=each[:, -1], colour=PALETTE[i]))
            best = Series(
                f"best other, labels {labels}", x=ACCURACIES, y=each[:, :-1].max(1), colour=PALETTE[i], line=":"
            )
            series.append(best)
        title = "stable" if preset == "stable" else "paper and all others"
        panels.append(Panel(series, title=title, x_label="accuracy of touch", y_label="expected reward"))
    return Picture(
        name="answers_without_touch",
        title="Reward with touch, and the most that any other short answer earns",
        caption="Every reading of the honest answer is right with the probability on the axis.  Dotted: the best of "
        "all other programs of slots and layouts at the same accuracy.",
        content=draw(panels, columns=2),
    )
