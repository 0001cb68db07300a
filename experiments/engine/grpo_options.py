"""Options of the GRPO step, each compared alone with the published objective, in the simulated world of touch.

Every option is a `GrpoVariant`: as in `stability_grpo`, the library's own step trains policies by SFT, then GRPO, many
seeds as one program.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw, estimates
from experiments.core.context import Context
from experiments.core.curves import running_mean
from experiments.core.look import PALETTE
from experiments.core.results import Picture, Table, named_table
from experiments.core.text import interval
from experiments.core.timing import interleaved
from experiments.engine.world import World
from experiments.engine.world_training import GrpoVariant, TrainingBudget, VariantRuns
from touchr1_jax.bench.statistics import Interval, student_interval
from touchr1_jax.rl.config import Advantage, Paper

PUBLISHED = GrpoVariant(name="published", algorithm=Paper())
PULL = 0.1  # β at which a reference holds the small policy back


def _loss(name: str, **changes) -> GrpoVariant:
    return GrpoVariant(name=name, algorithm=Paper(**changes))


def _drawn(name: str, **sampling: float) -> GrpoVariant:
    return GrpoVariant(name=name, algorithm=Paper(), sampling=tuple(sampling.items()))


def _paid(name: str, **rewards: float) -> GrpoVariant:
    return GrpoVariant(name=name, algorithm=Paper(), more_rewards=tuple(rewards.items()))


OPTIONS: Mapping[str, tuple[GrpoVariant, ...]] = {
    "sampling": (
        _drawn("temperature .7", temperature=0.7),
        _drawn("temperature 1.3", temperature=1.3),
        _drawn("top-p .9", top_p=0.9),
        _drawn("min-p .1", min_p=0.1),
    ),
    "advantage": (
        _loss("per reward", advantage=Advantage.PER_REWARD),
        _loss("max@2", best_of=2),
        _loss("segment credit", segment_credit=True),
        _loss("truncated masked", mask_truncated=True),
    ),
    "further rewards": (_paid("overlong .1", overlong=0.1), _paid("diversity .05", diversity=0.05)),
    "several updates, lag": (
        _loss("2 minibatches", minibatches=2),
        _loss("2 passes × 2 minibatches", updates=2, minibatches=2),
        _loss("2 stale", stale=2),
        _loss("2 stale, weights of tokens", stale=2, importance_cap=2.0),
        _loss("2 stale, weights of rollouts", stale=2, importance_cap=2.0, importance_sequence=True),
    ),
    "reference": (
        _loss("β .1", beta=PULL),
        _loss("β .1, in the reward", beta=PULL, kl_in_reward=True),
        _loss("β .1, moving reference", beta=PULL, reference_every=10, reference_share=0.3),
    ),
}
"""Family → options."""

NAMES = tuple(variant.name for family in OPTIONS.values() for variant in family)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OptionRun:
    """All seeds of one option: accuracy, entropy and KL to the policy before training, after it, nat a token, [seeds].

    Also accuracy of the rollouts of every step, of all candidates in dynamic sampling, [seeds, steps], and seconds of
    one step of all seeds.
    """

    accuracy: np.ndarray
    entropy: np.ndarray
    kl: np.ndarray
    right: np.ndarray
    step_s: float


Runs = Mapping[str, OptionRun]


def measure_options(
    names: Sequence[str], budget: TrainingBudget, seeds: int, timed: int, context: Context
) -> dict[str, OptionRun]:
    """Train the published objective and each option from the same policies, then time their programs in turn."""
    runs, setting = VariantRuns(budget, range(seeds)), (World(), None)
    chosen = [PUBLISHED, *(v for family in OPTIONS.values() for v in family if v.name in names)]
    found = {}
    for variant in context.each("options", chosen):
        found[variant.name] = one = runs.run(variant, setting, checked=False)
        before, after = (float(figures["accuracy"].mean()) for figures in (one.before, one.after))
        context.print(f"{variant.name}: accuracy {before:.3f} → {after:.3f}")
    calls = {variant.name: runs.training(variant, setting) for variant in chosen}
    seconds = interleaved(calls, context.rounds("timing options", timed))
    return {
        name: OptionRun(
            accuracy=one.after["accuracy"],
            entropy=one.after["entropy"],
            kl=one.after["kl"],
            right=one.metrics.get("drawn_accuracy", one.metrics["accuracy"]),
            step_s=float(seconds[name].min()) / budget.steps,
        )
        for name, one in found.items()
    }


def gain(runs: Runs, name: str) -> Interval:
    """Points of accuracy over the published objective, paired by seed, with a 95 % interval over seeds."""
    return student_interval(100 * (runs[name].accuracy - runs[PUBLISHED.name].accuracy))


def option_verdict(runs: Runs) -> tuple[str, ...]:
    """Name the options that change accuracy significantly: their interval over seeds excludes 0."""
    gains = {name: gain(runs, name) for name in runs if name != PUBLISHED.name}
    beyond = [f"{name} ({interval(one, '+.1f')} points)" for name, one in gains.items() if one.excludes_zero]
    listed = f"these do: {'; '.join(beyond)}" if beyond else "none does"
    return (f"Of {len(gains)} options that may change accuracy significantly (95 % over seeds), {listed}.",)


def option_table(runs: Runs) -> Table:
    """Accuracy, its gain, and time of a step."""
    published = runs[PUBLISHED.name]
    return named_table(
        "Options, each changed alone",
        [
            {
                "option": name,
                "a step": 1e3 * one.step_s,
                "over published": one.step_s / published.step_s,
                "accuracy": 100 * float(one.accuracy.mean()),
                "gain": None if one is published else interval(gain(runs, name), "+.1f"),
                "entropy": float(one.entropy.mean()),
                "KL": float(one.kl.mean()),
            }
            for name, one in runs.items()
        ],
        formats={"a step": ".1f", "over published": ".2f", "accuracy": ".1f"},
        units={"a step": "ms", "accuracy": "%", "gain": "points", "entropy": "nat", "KL": "nat"},
        meanings={
            "a step": "of all seeds together, fastest of the rounds",
            "accuracy": "of sampled answers to fresh questions after training, mean over seeds",
            "gain": "over the published objective, paired by seed, with a 95 % interval over seeds",
            "KL": "to the policy before training, a token",
        },
    )


def option_pictures(runs: Runs) -> tuple[Picture, ...]:
    """Gain and time of every option, and learning curves by family."""
    return (
        Picture(
            name="options",
            title="Options: accuracy and time of a step",
            caption="Each option alone, against the published objective on the same seeds.  Bars are 95 % intervals "
            "over seeds.",
            content=gain_and_cost(runs),
        ),
        Picture(
            name="option_courses",
            title="Options: accuracy of rollouts over time",
            caption="Mean over the seeds, running mean over steps; at another temperature or nucleus the rollouts "
            "differ from the answers that are scored at the end.",
            content=right_over_time(runs),
        ),
    )


def gain_and_cost(runs: Runs) -> bytes:
    """Draw the gain and the relative time of a step, one row an option."""
    names = [name for name in runs if name != PUBLISHED.name]
    cost = [runs[name].step_s / runs[PUBLISHED.name].step_s for name in names]
    accuracy = estimates("", [gain(runs, name) for name in names])
    panels = [
        Panel([accuracy], x_label="points of accuracy over published", rows=names, rules=[Rule(x=0)]),
        Panel([Series(x=cost)], x_label="time of a step over published", rows=names, rules=[Rule(x=1)]),
    ]
    return draw(panels, columns=2, size=(9.0, 0.9 + 0.27 * len(names)), legend=False)


def right_over_time(runs: Runs) -> bytes:
    """Draw accuracy of the rollouts over seconds, a panel for each family."""
    panels = []
    for family, variants in OPTIONS.items():
        lines = []
        for i, name in enumerate([PUBLISHED.name, *(v.name for v in variants if v.name in runs)]):
            x = runs[name].step_s * np.arange(1, runs[name].right.shape[1] + 1)
            y, colour = running_mean(runs[name].right.mean(0)), ("black", *PALETTE)[i]
            lines.append(Series(x=x, y=y, marker="", colour=colour))
            lines.append(Series(x=x[-1:], y=y[-1:], labels=[name], marker="", colour=colour))
        if len(lines) > 2:
            panels.append(Panel(lines, title=family, x_label="time of all seeds, s", y_label="accuracy of rollouts"))
    return draw(panels, columns=2, size=(9.6, 8.4), share_y=True, legend=False)
