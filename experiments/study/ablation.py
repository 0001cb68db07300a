"""Ablations: arms of GRPO from one SFT checkpoint per seed, scored with the baselines, compared in pairs."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Comparison, Estimate, Results
from experiments.core.runner import Experiment
from experiments.study.controls import against_control, control_sentences, decision_table, seconds_table
from experiments.study.estimates import change, changes, compare_over_objects, compare_over_seeds
from experiments.study.examples import rollout_examples
from experiments.study.levels import level_report
from experiments.study.scores import Scored, score_study, study_results, study_settings, trained_preset
from experiments.study.stages import Weights
from experiments.study.study import BLIND, SFT, SMOKE, EvalVariant, Study, StudyConfig, run_study
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.rl.config import AnyAlgorithm
from touchr1_jax.training.evaluation import Evaluation, rewards_of
from touchr1_jax.training.loop import HELD_OUT

COMPARED = ("acc", "omae", "middle_rate", "csc", "parse_rate", "reward")

SFT_CURVES: Mapping[str, tuple[str, ...]] = {
    "encoders": ("loss", "accuracy"),
    "sft": ("loss", "token_accuracy"),
    "decoder": ("loss", HELD_OUT),
    "blind": ("loss",),
}
"""Of the phases of SFT the scalars that are drawn."""

OWN_REWARD = "reward_trained"  # an arm's reward under its own weights, on ordinal questions


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ablation:
    """Arms of GRPO and the comparisons between them.

    Attributes:
      arms: reward weights of each arm.
      pairs: arms to compare, each with the one it is compared against.
      algorithms: of the arms that train by another algorithm than the configured one.
      variants: further evaluations of SFT, the control or arms, by the names of their answers.
      curves: scalars of GRPO that are drawn.
      example: the arm whose rollouts are shown; empty for the last.
    """

    arms: Mapping[str, Weights]
    pairs: tuple[tuple[str, str], ...]
    algorithms: Mapping[str, AnyAlgorithm] = dataclasses.field(default_factory=dict)
    variants: Mapping[str, EvalVariant] = dataclasses.field(default_factory=dict)
    curves: tuple[str, ...] = ("reward", "accuracy", "entropy", "kl", "grounding", "parse_rate", "length")
    example: str = ""

    @property
    def drawn(self) -> dict[str, tuple[str, ...]]:
        """Of each phase the scalars that are drawn."""
        return {**SFT_CURVES, "grpo": self.curves}


def ablation_experiment(name: str, ablation: Ablation) -> Experiment[StudyConfig]:
    """The experiment that trains and compares the arms, at the default scale and at `smoke`."""
    return Experiment(
        name=name,
        config=StudyConfig(),
        scales={"smoke": SMOKE},
        run=lambda config, context: run_ablation(ablation, config, context)[-1],
        curves=ablation.drawn,
        quick=("smoke",),
        spreads=True,
    )


def run_ablation(ablation: Ablation, config: StudyConfig, context: Context) -> tuple[Study, Scored, Results]:
    """Train the arms, score them with the baselines, compare them over seeds and SFT with the baselines over objects.

    Returns:
      The study, its scores, and results that an experiment may extend by further tables.
    """
    study = run_study(config, ablation.arms, context, ablation.algorithms, ablation.variants)
    scored = score_study(study)
    controlled = against_control(scored.arms, study.arms)
    comparisons = (*over_seeds(ablation, study, scored), *controlled, *over_objects(study, scored))
    shown = ablation.example or list(ablation.arms)[-1]
    pictures, tables = level_report(study)
    presets = {
        f"preset of {arm}": trained_preset(config, algorithm)
        for arm, algorithm in ablation.algorithms.items()
        if algorithm != config.grpo.algorithm
    }
    trained_on = {
        f"rewards of {arm}": ", ".join(f"{name} {weight:g}" for name, weight in weights.items())
        for arm, weights in study.arms.items()
        if weights != ablation.arms[arm]
    }
    results = study_results(
        study,
        scored,
        settings={**study_settings(config), **presets, **trained_on},
        comparisons=comparisons,
        verdict=(*verdict(ablation, comparisons, scored.estimates), *control_sentences(controlled, study.arms)),
        tables=(*decision_table(study), *tables, *seconds_table(study, context)),
        pictures=pictures,
        curves=ablation.drawn,
        examples=rollout_examples(study, shown, study.arms[shown]),
    )
    return study, scored, results


def over_seeds(ablation: Ablation, study: Study, scored: Scored) -> list[Comparison]:
    """The pairs, and every arm against SFT, paired by seed; every arm's own reward against SFT's under its weights."""
    if study.config.seeds < 2:
        return []
    rows = scored.estimates
    found = [
        compare_over_seeds(metric, a, b, rows[a][metric].per_seed, rows[b][metric].per_seed)
        for a, b in dict.fromkeys([*ablation.pairs, *((arm, SFT) for arm in ablation.arms)])
        for metric in COMPARED
        if metric in rows[a]
    ]
    for arm, weights in study.arms.items():
        after, before = (own_reward(study, study.answers[name], weights) for name in (arm, SFT))
        found.append(compare_over_seeds(OWN_REWARD, arm, SFT, after, before))
    return found


def own_reward(study: Study, seeds: Sequence[Evaluation], weights: Weights) -> list[float]:
    """Mean reward under an arm's own weights of greedy answers to ordinal questions, of every seed."""
    asked = [ATTRIBUTES.index(name) for name in ORDINAL]
    return [
        float(rewards_of(study.policy, answers, weights, study.prior)[np.isin(answers.attribute, asked)].mean())
        for answers in seeds
    ]


def over_objects(study: Study, scored: Scored) -> list[Comparison]:
    """SFT against the baselines, paired by object: the gain from touch before any reinforcement."""
    found = []
    for name in scored.baselines:
        theirs = scored.rows[name] * (1 if len(scored.rows[name]) > 1 else study.config.seeds)
        for metric in ("acc", "omae"):
            a, b = ([seed[metric] for seed in seeds] for seeds in (scored.rows[SFT], theirs))
            found.append(compare_over_objects(metric, SFT, name, a, b, scored.objects))
    return found


def verdict(
    ablation: Ablation, comparisons: Sequence[Comparison], rows: Mapping[str, Mapping[str, Estimate]]
) -> tuple[str, ...]:
    """One sentence for SFT, one for each pair, and one for each arm against SFT, whichever way the figures fall."""
    by = {(c.metric, c.arm, c.against): c for c in comparisons}
    gains = ", ".join(f"{change(by['acc', SFT, name])} compared with {name}" for name in ("constant", BLIND))
    sentences = [f"SFT answers {rows[SFT]['acc'].mean:.1f} % of ordinal questions about unseen objects right: {gains}."]
    for a, b in ablation.pairs:
        found = [by[m, a, b] for m in COMPARED if (m, a, b) in by]
        if found:
            sentences.append(f"{a} compared with {b}: {changes(found)}.")
    for arm in ablation.arms:
        if (OWN_REWARD, arm, SFT) in by:
            found = [by[metric, arm, SFT] for metric in (OWN_REWARD, "acc")]
            sentences.append(f"GRPO of {arm} compared with SFT, on unseen objects: {changes(found)}.")
    return tuple(sentences)
