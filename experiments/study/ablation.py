"""What the ablations share: arms of GRPO from one SFT checkpoint, scored beside the baselines, compared in pairs."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

from experiments.core.context import Context
from experiments.core.results import Comparison, Estimate, Results
from experiments.core.runner import Experiment
from experiments.study.assembly import Weights
from experiments.study.estimates import compare_over_seeds
from experiments.study.examples import rollout_examples
from experiments.study.levels import level_report
from experiments.study.scores import score_study, study_settings
from experiments.study.study import SFT, SMOKE, StudyConfig, run_study
from touchr1_jax.rl.config import AnyAlgorithm, preset_name

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

    @property
    def drawn(self) -> dict[str, tuple[str, ...]]:
        """Of each phase the scalars that are drawn."""
        return {"sft": ("loss", "token_accuracy"), "blind": ("loss",), "grpo": self.curves}


def ablation_experiment(name: str, ablation: Ablation) -> Experiment[StudyConfig]:
    """The experiment that trains and compares the arms, at the default scale and at `smoke`."""
    return Experiment(
        name=name,
        config=StudyConfig(),
        scales={"smoke": SMOKE},
        run=functools.partial(run_ablation, ablation),
        curves=ablation.drawn,
        quick=("smoke",),
        spreads=True,
    )


def run_ablation(ablation: Ablation, config: StudyConfig, context: Context) -> Results:
    """Train the arms, score them beside the baselines, compare them in pairs over seeds."""
    study = run_study(config, ablation.arms, context, ablation.algorithms)
    scored = score_study(study)
    comparisons = compared(ablation, scored.estimates, config.seeds)
    shown = ablation.example or list(ablation.arms)[-1]
    pictures, tables = level_report(study)
    return Results(
        arms=scored.arms,
        baselines=scored.baselines,
        settings=settings(ablation, config),
        comparisons=tuple(comparisons),
        verdict=verdict(ablation, comparisons, scored.estimates),
        tables=tables,
        pictures=pictures,
        data=study.data.summary(),
        curves=ablation.drawn,
        examples=rollout_examples(study, shown, ablation.arms[shown]),
    )


def settings(ablation: Ablation, config: StudyConfig) -> dict[str, str | float]:
    """Those of the study, and the preset of every arm that has its own."""
    of_arm = lambda arm: dataclasses.replace(config.grpo, algorithm=ablation.algorithms.get(arm, config.grpo.algorithm))
    presets = {f"preset of {arm}": preset_name(of_arm(arm)) for arm in ablation.algorithms}
    return {**study_settings(config), **presets}


def compared(ablation: Ablation, rows: Mapping[str, Mapping[str, Estimate]], seeds: int) -> list[Comparison]:
    """The pairs, and every arm against SFT, paired by seed; needs two seeds at least."""
    return compared_pairs([*ablation.pairs, *((arm, SFT) for arm in ablation.arms)], rows, seeds)


def compared_pairs(
    pairs: Sequence[tuple[str, str]], rows: Mapping[str, Mapping[str, Estimate]], seeds: int
) -> list[Comparison]:
    """Each pair in every metric of `COMPARED` that its first arm has, paired by seed; needs two seeds at least."""
    if seeds < 2:
        return []
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
