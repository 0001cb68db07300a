"""Accuracy that a policy gains from touch: its answers under each control of touch, and their loss of accuracy.

The controls (`touchr1_jax.bench.grounding`) are no touch, the frames in another order, noise of the sensors'
statistics, and another object's touch.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from experiments.core.results import Cell, Table, named_table
from experiments.core.text import interval
from experiments.paper.feature_baselines import other_objects
from experiments.study.answers import asked_label, concluded
from experiments.study.estimates import RESAMPLES, pooled
from experiments.study.seed import TrainedPolicy
from experiments.study.study import EvalVariant, Study
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.grounding import CONTROLS, SHUFFLE, LeastGain, least_tactile_use, tactile_use_gain
from touchr1_jax.bench.metrics import BOTTOM, ORDINAL, Scores, keep_scored
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.models.policy import Features
from touchr1_jax.rl.counterfactual import drop_touch, noise_touch, shuffle_touch
from touchr1_jax.training.evaluation import Evaluation

CONTROL_MEANINGS = {
    "drop": "no stream at all",
    "shuffle": "the time steps of every stream in another order",
    "noise": "encoded noise of each sensor's statistics in place of its touch",
    "swapped": "another object's touch",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchQuestions:
    """N questions about single touches: attribute, label, object, whether the object looks like another one."""

    attribute: Int[np.ndarray, "N"]
    label: Int[np.ndarray, "N"]
    objects: np.ndarray
    looks_like_another: Bool[np.ndarray, "N"]

    @property
    def ordinal(self) -> Bool[np.ndarray, "N"]:
        """Questions for hardness, roughness or protrusion."""
        return np.isin(np.array(ATTRIBUTES)[self.attribute], ORDINAL)

    def of(self, attribute: str) -> Bool[np.ndarray, "N"]:
        """Questions for one attribute."""
        return self.attribute == ATTRIBUTES.index(attribute)


def touch_questions(study: Study, answers: Evaluation) -> TouchQuestions:
    """The questions that a study's policy answered about the test contacts."""
    contact = study.data.parts["test"][answers.contact]
    return TouchQuestions(
        attribute=answers.attribute,
        label=asked_label(answers),
        objects=study.data.object_ids[contact],
        looks_like_another=study.data.visual_lies[contact],
    )


def control_variants(policy: str) -> dict[str, EvalVariant]:
    """For each of `CONTROLS` the policy evaluated without its touch, or with something else in its place."""

    def answer(control: str, trained: TrainedPolicy) -> Evaluation:
        test, key = jax.tree.map(jnp.asarray, trained.test), jax.random.key(trained.seed)
        objects = trained.data.object_ids[trained.data.parts["test"]]
        change: Mapping[str, Callable[[], Features]] = {
            "drop": lambda: drop_touch(test).features,
            "shuffle": lambda: shuffle_touch(test, key).features,
            "noise": lambda: noise_touch(test, trained.noise, key).features,
            "swapped": lambda: swap_objects(trained.test, objects, trained.seed),
        }
        return trained.ask(trained.params, jax.device_get(change[control]()), alone=False)

    return {control_name(policy, c): EvalVariant(of=policy, evaluate=functools.partial(answer, c)) for c in CONTROLS}


def control_name(policy: str, control: str) -> str:
    """Name of the answers of a policy under a control."""
    return f"{policy}-under-{control}"


def control_answers(study: Study, policy: str) -> dict[str, Sequence[Evaluation]]:
    """Control → the answers of every seed of a policy that was evaluated by `control_variants`."""
    return {control: study.variants[control_name(policy, control)] for control in CONTROLS}


def swap_objects(features: Features, objects: np.ndarray, seed: int) -> Features:
    """Give each of n contacts the touch of another object's; streams that only one of the two has are dropped."""
    other = other_objects(objects, seed)
    return dataclasses.replace(
        features,
        touch=features.touch[other],
        touch_time=features.touch_time[other],
        stream_mask=features.stream_mask & features.stream_mask[other],
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchGain:
    """Accuracy gained from touch over each control, with intervals, and the least of these gains."""

    over: Mapping[str, Interval]
    least: LeastGain


def touch_gain(
    questions: TouchQuestions,
    real: Sequence[Evaluation],
    controls: Mapping[str, Sequence[Evaluation]],
    ordered: np.ndarray,
    mask: np.ndarray,
) -> TouchGain | None:
    """TUG of the accuracy over hardness, roughness and protrusion, each weighing the same; seeds pooled by question.

    `controls` maps each of `CONTROLS` to the answers of every seed, `ordered` [N] is true where the answer lies in the
    order of the frames.  There are no gains where fewer than two objects have a question of the mask [N].
    """
    mask = mask & questions.ordinal
    if len(np.unique(questions.objects[mask])) < 2:
        return None

    def score(seeds: Sequence[Evaluation]) -> Scores:
        right = ((concluded(answers) == questions.label) for answers in seeds)
        scored = mask & (questions.label != BOTTOM)
        return pooled([keep_scored(100.0 * hit, scored, questions.attribute) for hit in right])

    own, others = score(real), {control: score(controls[control]) for control in CONTROLS}
    over = {}
    for control, other in others.items():
        gain, objects = tactile_use_gain(own, other), questions.objects
        over[control] = clustered_bootstrap(gain.values, objects[gain.items], strata=gain.strata, resamples=RESAMPLES)
    return TouchGain(over=over, least=least_tactile_use(own, others, ordered, questions.objects, resamples=RESAMPLES))


def study_touch_gain(study: Study, policy: str, mask: np.ndarray | None = None) -> TouchGain | None:
    """`touch_gain` of a policy that was also evaluated by `control_variants`; by default on all labelled questions."""
    questions = touch_questions(study, study.answers[policy][0])
    ordered, mask = study.policy.ordered[questions.attribute], questions.label >= 0 if mask is None else mask
    return touch_gain(questions, study.answers[policy], control_answers(study, policy), ordered, mask)


def touch_gain_table(gains: Mapping[str, TouchGain | None]) -> Table:
    """The gain over every control and the least of them, of "policy, questions"; rows without gains are left out."""
    rows: list[dict[str, Cell]] = []
    for name, found in gains.items():
        if found is not None:
            spans = {**{c: found.over[c] for c in CONTROLS}, "least": found.least.gain}
            cells = {control: interval(gain, "+.1f") for control, gain in spans.items()}
            rows.append({"policy and questions": name, **cells, "over": found.least.control})
    return named_table(
        "Accuracy gained from touch",
        rows,
        units=dict.fromkeys((*CONTROLS, "least"), "points"),
        meanings={**CONTROL_MEANINGS, "least": f"without {SHUFFLE}, since no answer here lies in the order of frames"},
        note="Accuracy over hardness, roughness and protrusion with the touch, minus that under each control. Policies "
        "never met a prompt without any stream, and often cannot answer one readably: for the gain over having no "
        "touch at all, see the policy trained without it.",
    )
