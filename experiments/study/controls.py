"""Controls of reinforcement: SFT continued for as many seconds, and decision rules that cost no training."""

from collections.abc import Iterable, Mapping, Sequence
from typing import get_args

import numpy as np

from experiments.core.context import Context
from experiments.core.loops import STEPPING
from experiments.core.results import Cell, Comparison, Estimate, Table, named_table
from experiments.study.answers import asked_label, concluded
from experiments.study.estimates import change, compare_over_seeds, object_interval
from experiments.study.study import CONTINUED, Study
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import BOTTOM, ORDINAL
from touchr1_jax.bench.sampled import DecisionRule, decide
from touchr1_jax.bench.scoring import REPORTED
from touchr1_jax.training.evaluation import Evaluation

MIDDLE = 1  # middle one of three ordinal levels


def against_control(rows: Mapping[str, Mapping[str, Estimate]], arms: Iterable[str]) -> list[Comparison]:
    """Every arm against the control that continues SFT, in every main metric, paired by seed.

    Needs two seeds at least; without them there is no comparison.
    """
    control = rows[CONTINUED]
    if any(len(estimate.per_seed) < 2 for estimate in control.values()):
        return []
    return [
        compare_over_seeds(metric, arm, CONTINUED, rows[arm][metric].per_seed, control[metric].per_seed)
        for arm in arms
        for metric in control
        if metric in rows[arm] and REPORTED[metric].better != "none" and not REPORTED[metric].secondary
    ]


def control_sentences(comparisons: Sequence[Comparison], arms: Iterable[str]) -> tuple[str, ...]:
    """The metrics in which an arm is significantly better or worse than SFT continued, and the arms without any."""
    sentences, equal = [], []
    for arm in arms:
        of_arm = [c for c in comparisons if c.arm == arm and c.against == CONTINUED and c.over == "seeds"]
        if not of_arm:
            continue
        sure = [c for c in of_arm if c.low > 0 or c.high < 0]
        gains = [c for c in sure if (c.difference > 0) == (REPORTED[c.metric].better == "higher")]
        losses = [c for c in sure if c not in gains]
        if not sure:
            equal.append(arm)
            continue
        better, worse = (", ".join(map(change, found)) or "no metric" for found in (gains, losses))
        sentences.append(
            f"Compared with SFT continued for the same time, {arm} is better in {better} and worse in {worse} "
            f"({len(of_arm)} metrics; intervals over seeds that exclude 0)."
        )
    if equal:
        sentences.append(
            f"Compared with SFT continued for the same time, no metric of {', '.join(equal)} differs: every interval "
            "over seeds contains 0."
        )
    return tuple(sentences)


def seconds_table(study: Study, context: Context) -> tuple[Table, ...]:
    """Seconds of training of every policy, mean over the seeds that this run trained; none where the cache had all."""
    timing = context.timing()
    phases = {name: f"grpo/{name}" for name in study.arms} | {CONTINUED: f"decoder/{CONTINUED}"}
    of_sft = {"SFT, encoders": "encoders", "SFT, end to end": "sft", "SFT, decoder": "decoder/sft"}
    phases = {**of_sft, **phases, "SFT without touch": "blind"}
    rows: list[dict[str, Cell]] = []
    for name, phase in phases.items():
        seconds = [timing.get(f"{STEPPING}/{phase}/{seed}") for seed in range(study.config.seeds)]
        trained = [s for s in seconds if s is not None]
        if trained:
            rows.append({"policy": name, "seconds": float(np.mean(trained)), "seeds": len(trained)})
    if not rows:
        return ()
    note = f"{CONTINUED} has as many steps as fit into the time of an arm, by a ratio of step times measured before."
    formats = {"seconds": ".1f", "seeds": "d"}
    return (named_table("Seconds of training", rows, formats=formats, units={"seconds": "s"}, note=note),)


def decision_table(study: Study) -> tuple[Table, ...]:
    """Every policy's accuracy, error and middle answers, greedily and by each rule on its distribution over levels."""
    objects = study.data.object_ids[study.data.parts["test"]]
    rows: list[dict[str, Cell]] = []
    for name in study.policies:
        seeds = study.answers[name]
        if all(one.marginal is not None for one in seeds):
            rows += [{"policy and rule": f"{name}, {rule}", **_decided(seeds, objects, rule)} for rule in RULES]
    if not rows:
        return ()
    columns = ("accuracy", "material", "middle", "middle, true")
    return (
        named_table(
            "Decision rules",
            rows,
            formats=dict.fromkeys(columns[2:], ".1f"),
            units={**dict.fromkeys(columns, "%"), "OMAE": "levels"},
            meanings={
                "accuracy": "hardness, roughness and protrusion; 95 % over objects, seeds pooled",
                "OMAE": "mean distance in levels; 95 % over objects",
                "middle": "ordinal answers that name the middle level",
                "middle, true": "questions whose label it is",
            },
            note="Greedy decoding answers the likeliest token after the likeliest trace. The other rules decide from "
            "p(level | prompt), the mean over sampled traces of p(level | trace), and cost no training.",
        ),
    )


GREEDY = "greedy"
RULES = (GREEDY, *get_args(DecisionRule))


def decided_levels(answers: Evaluation, rule: str) -> np.ndarray:
    """Level of the asked attribute, int [N], by `GREEDY` decoding or by a rule on the sampled traces."""
    if rule == GREEDY:
        return concluded(answers)
    if answers.marginal is None:
        raise ValueError("answers.marginal is None: a decision rule needs sampled traces; sample some")
    ordinal = np.isin(answers.attribute, [ATTRIBUTES.index(name) for name in ORDINAL])
    chosen = next(r for r in get_args(DecisionRule) if r == rule)
    return np.where(ordinal, decide(answers.marginal, chosen), decide(answers.marginal, "argmax"))


def _decided(seeds: Sequence[Evaluation], objects: np.ndarray, rule: str) -> dict[str, Cell]:
    """Cells of one policy's row; levels without an order are answered by the likeliest."""
    level = np.concatenate([decided_levels(one, rule) for one in seeds])
    label = np.concatenate([asked_label(one) for one in seeds])
    attribute = np.concatenate([one.attribute for one in seeds])
    of = np.concatenate([objects[one.contact] for one in seeds])
    ordinal = np.isin(attribute, [ATTRIBUTES.index(name) for name in ORDINAL])
    right, distance = 100.0 * (level == label), np.where(level == BOTTOM, 2 * MIDDLE, np.abs(level - label))
    return {
        "accuracy": object_interval(right[ordinal], of[ordinal]),
        "OMAE": object_interval(distance[ordinal], of[ordinal], ".3f"),
        "material": object_interval(right[~ordinal], of[~ordinal]),
        "middle": 100 * float(np.mean(level[ordinal] == MIDDLE)),
        "middle, true": 100 * float(np.mean(label[ordinal] == MIDDLE)),
    }
