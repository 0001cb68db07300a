"""Does ordinal credit (1 / 0.4 / 0) beat 0/1 credit on ordinal error and accuracy?

    make experiment EXP=ablation_ordinal
    make experiment EXP=ablation_ordinal ARGS="--data physiclear --data-dir DIR"

Three arms of GRPO start from the same SFT checkpoint of each seed and see the same questions in the same order; they
differ in the reward alone.  `zero_one` pays 1 for the right level, `ordinal` also 0.4 for a neighbour, both beside the
published consistency term.  `debiased` takes from the ordinal credit what a constant answer would earn, so that no
level is favoured, and pays for consistency only where the answer is right.  All pay −0.1 for an answer that cannot be
parsed.

Cost: 17 to 25 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: ordinal credit pays the middle level for being near everything (answering the middle beats answering low as
soon as p(low) < p(middle) + 2/3 p(high)), so `ordinal` should give more middle answers than `zero_one`; a lower ordinal
error that comes of that alone is no better touch.  `debiased` should keep the error without the middle answers.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Comparison, Estimate, Results
from experiments.core.runner import Experiment
from experiments.study.answers import Evaluated, reward_of
from experiments.study.estimates import compare_over_objects, compare_over_seeds
from experiments.study.examples import rollout_examples
from experiments.study.levels import level_report
from experiments.study.scores import PUBLISHED, Table, score_study, study_settings
from experiments.study.study import BLIND, SFT, SMOKE, Study, StudyConfig, run_study
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import Scores

ARMS: Mapping[str, Mapping[str, float]] = {
    "zero_one": {"exact": 0.6, "consistency": 0.3, "format": 0.1},
    "ordinal": PUBLISHED,
    "debiased": {"accuracy_debiased": 0.6, "consistency_gated": 0.3, "format": 0.1},
}
COMPARED = ("acc", "omae", "middle_rate", "csc", "reward")
CURVES = {
    "sft": ("loss", "token_accuracy"),
    "blind": ("loss",),
    "grpo": ("reward", "accuracy", "middle_rate", "entropy", "kl", "grounding", "degenerate_share", "length"),
}


def run(config: StudyConfig, context: Context) -> Results:
    """Train the arms, score them beside the baselines, compare them in pairs."""
    study = run_study(config, ARMS, context)
    scored = score_study(study)
    estimates, trained = scored.estimates, own_reward(study)
    comparisons = [
        *over_seeds(estimates, trained, config.seeds),
        *over_objects(scored.rows, scored.objects, config.seeds),
    ]
    pictures, tables = level_report(study)
    return Results(
        arms=scored.arms,
        baselines=scored.baselines,
        settings=study_settings(config),
        comparisons=tuple(comparisons),
        verdict=verdict(comparisons, estimates),
        tables=tables,
        pictures=pictures,
        data=study.data.summary(),
        curves=CURVES,
        examples=rollout_examples(study, "ordinal", ARMS["ordinal"]),
    )


def own_reward(study: Study) -> dict[str, tuple[list[float], list[float]]]:
    """Greedy held-out reward under each arm's own weights on what GRPO asks, per seed: of the arm, and of its SFT."""
    asked = [i for i, name in enumerate(ATTRIBUTES) if name in study.config.grpo_attributes]

    def mean(said: Evaluated, weights: Mapping[str, float]) -> float:
        reward = reward_of(study.assembly, said, weights, study.prior)
        return float(reward[np.isin(said.attribute, asked)].mean())

    return {
        arm: ([mean(a, weights) for a in study.answers[arm]], [mean(a, weights) for a in study.answers[SFT]])
        for arm, weights in ARMS.items()
    }


def over_seeds(
    rows: Mapping[str, Mapping[str, Estimate]], trained: Mapping[str, tuple[list[float], list[float]]], seeds: int
) -> list[Comparison]:
    """Arms against each other and against SFT, paired by seed; needs two seeds at least."""
    if seeds < 2:
        return []
    pairs = [("ordinal", "zero_one"), ("debiased", "zero_one"), ("debiased", "ordinal"), *((arm, SFT) for arm in ARMS)]
    found = [
        compare_over_seeds(metric, a, b, rows[a][metric], rows[b][metric])
        for a, b in pairs
        for metric in COMPARED
        if metric in rows[a]
    ]
    for arm, (after, before) in trained.items():
        found.append(compare_over_seeds("reward_trained", arm, SFT, _plain(after), _plain(before)))
    return found


def over_objects(rows: Table, objects: np.ndarray, seeds: int) -> list[Comparison]:
    """SFT against the baselines, by object: what touch is worth before any reinforcement."""
    against = [name for name in rows if name not in (SFT, *ARMS)]
    repeat: dict[str, Sequence[dict[str, Scores]]] = {n: rows[n] if len(rows[n]) > 1 else rows[n] * seeds for n in rows}
    return [
        compare_over_objects(
            metric, SFT, name, [s[metric] for s in rows[SFT]], [s[metric] for s in repeat[name]], objects
        )
        for name in against
        for metric in ("acc", "omae")
    ]


def verdict(comparisons: Sequence[Comparison], rows: Mapping[str, Mapping[str, Estimate]]) -> tuple[str, ...]:
    """What the figures say, in sentences, whichever way they fall."""
    by = {(c.metric, c.arm, c.against): c for c in comparisons}
    touch = [by[("acc", SFT, name)] for name in ("constant", BLIND)]
    said = [
        f"SFT answers {rows[SFT]['acc'].mean:.1f} % of ordinal questions about unseen objects right: "
        + ", ".join(f"{c.difference:+.1f} points {_outside(c)} against {c.against}" for c in touch)
        + "."
    ]
    if ("acc", "ordinal", "zero_one") in by:
        omae, acc, middle = (by[(m, "ordinal", "zero_one")] for m in ("omae", "acc", "middle_rate"))
        said.append(
            f"Ordinal against 0/1 credit: OMAE {omae.difference:+.3f} {_outside(omae)}, accuracy {acc.difference:+.1f} "
            f"points {_outside(acc)}, middle answers {middle.difference:+.1f} points {_outside(middle)}."
        )
        for arm in ARMS:
            reward, accuracy = by[("reward_trained", arm, SFT)], by[("acc", arm, SFT)]
            said.append(
                f"GRPO with {arm} credit moves its own held-out greedy reward by {reward.difference:+.4f} "
                f"{_outside(reward)} and accuracy by {accuracy.difference:+.1f} points {_outside(accuracy)}."
            )
    return tuple(said)


def _outside(c: Comparison) -> str:
    low, high = c.ci95
    beyond = "0 lies outside" if low > 0 or high < 0 else "which may be chance"
    return f"[{low:.3g}, {high:.3g}] ({beyond})"


def _plain(values: Sequence[float]) -> Estimate:
    mean = float(np.mean(values))
    return Estimate(mean=mean, ci95=(mean, mean), per_seed=tuple(values))


DEFAULT = StudyConfig()

EXPERIMENT = Experiment(
    name="ablation_ordinal",
    config=DEFAULT,
    scales={"smoke": SMOKE},
    run=run,
    curves=CURVES,
    quick=("smoke",),
    spreads=True,
)
