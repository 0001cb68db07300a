"""What the ablations share: arms of GRPO from one SFT checkpoint, scored beside the baselines, compared in pairs."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

from experiments.policies.assembly import Weights
from experiments.policies.baselines import baselines
from experiments.policies.estimates import compare_over_seeds, estimate
from experiments.policies.examples import rollout_examples
from experiments.policies.stages import Evaluated, reward_of
from experiments.policies.study import SFT, SMOKE, Study, StudyConfig, run_study
from experiments.reporting.results import Comparison, Estimate, Results
from experiments.running.context import Context
from experiments.running.runner import Experiment
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import Scores, evaluate
from touchr1_jax.rl.config import AnyAlgorithm, preset_name

PUBLISHED: Weights = {"accuracy": 0.6, "consistency": 0.3, "format": 0.1}
"""The reward of the paper, by which `reward` is reported for every row."""

COMPARED = ("acc", "omae", "middle_rate", "csc", "parse_rate", "reward")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ablation:
    """Arms and what is asked of them; the second of each pair is the one compared against.

    `algorithms` names the arms that train by another algorithm than the configured one.
    """

    arms: Mapping[str, Weights]
    pairs: tuple[tuple[str, str], ...]
    algorithms: Mapping[str, AnyAlgorithm] = dataclasses.field(default_factory=dict)
    curves: tuple[str, ...] = ("reward", "accuracy", "entropy", "kl", "grounding", "parse_rate", "length")
    example: str = ""
    """The arm whose rollouts are shown; empty for the last."""


def ablation_experiment(name: str, ablation: Ablation) -> Experiment[StudyConfig]:
    """The experiment that trains and compares the arms, at the default scale and at `smoke`."""
    return Experiment(
        name=name, config=StudyConfig(), scales={"smoke": SMOKE}, run=functools.partial(run_ablation, ablation)
    )


def run_ablation(ablation: Ablation, config: StudyConfig, context: Context) -> Results:
    """Train the arms, score them beside the baselines, compare them in pairs over seeds."""
    study = run_study(config, ablation.arms, context, ablation.algorithms)
    rows = {name: [score(study, said) for said in seeds] for name, seeds in study.answers.items()}
    rows |= {name: [score(study, said)] for name, said in baselines(study).items()}
    objects = study.data.object_ids[study.data.parts["test"]][study.answers[SFT][0].contact]
    estimates = {
        name: {metric: estimate([s[metric] for s in seeds], objects) for metric in seeds[0]}
        for name, seeds in rows.items()
    }
    arms = (SFT, *ablation.arms)
    comparisons = compared(ablation, estimates, config.seeds)
    shown = ablation.example or list(ablation.arms)[-1]
    return Results(
        arms={name: estimates[name] for name in arms},
        baselines={name: row for name, row in estimates.items() if name not in arms},
        settings=settings(ablation, config),
        comparisons=tuple(comparisons),
        verdict=verdict(ablation, comparisons, estimates),
        data=study.data.summary(),
        curves={"sft": ("loss", "token_accuracy"), "blind": ("loss",), "grpo": ablation.curves},
        examples=rollout_examples(study, shown, ablation.arms[shown]),
    )


def score(study: Study, said: Evaluated) -> dict[str, Scores]:
    """Every metric of one policy's answers."""
    reward = reward_of(study.assembly, said, PUBLISHED, study.prior)
    return evaluate(said.answers(reward), ATTRIBUTES, study.assembly.levels)


def settings(ablation: Ablation, config: StudyConfig) -> dict[str, str | float]:
    """The preset of every arm, and the factors on the paper's learning rates."""
    of_arm = lambda arm: dataclasses.replace(config.grpo, algorithm=ablation.algorithms.get(arm, config.grpo.algorithm))
    return {
        "preset": preset_name(config.grpo),
        **{f"preset of {arm}": preset_name(of_arm(arm)) for arm in ablation.algorithms},
        "lr_scale": config.grpo.lr_scale,
        "sft_lr_scale": config.sft.optimizer.lr_scale,
    }


def compared(ablation: Ablation, rows: Mapping[str, Mapping[str, Estimate]], seeds: int) -> list[Comparison]:
    """The pairs, and every arm against SFT, paired by seed; needs two seeds at least."""
    if seeds < 2:
        return []
    pairs = [*ablation.pairs, *((arm, SFT) for arm in ablation.arms)]
    return [
        compare_over_seeds(metric, a, b, rows[a][metric], rows[b][metric])
        for a, b in pairs
        for metric in COMPARED
        if metric in rows[a]
    ]


def verdict(
    ablation: Ablation, comparisons: Sequence[Comparison], rows: Mapping[str, Mapping[str, Estimate]]
) -> tuple[str, ...]:
    """One sentence for SFT and one for each pair, whichever way the figures fall."""
    by = {(c.metric, c.arm, c.against): c for c in comparisons}
    said = [f"SFT answers {rows[SFT]['acc'].mean:.1f} % of ordinal questions about unseen objects right."]
    for a, b in ablation.pairs:
        found = [by[m, a, b] for m in COMPARED if (m, a, b) in by]
        if found:
            said.append(f"{a} against {b}: " + ", ".join(map(_phrase, found)) + ".")
    return tuple(said)


def _phrase(c: Comparison) -> str:
    low, high = c.ci95
    beyond = "" if low > 0 or high < 0 else ", which may be chance"
    return f"{c.metric} {c.difference:+.3g} [{low:.3g}, {high:.3g}]{beyond}"
