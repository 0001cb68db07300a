"""Evaluations of a study's policies besides the standard one: with touch removed or replaced, before any training,
after GRPO without SFT, and by a linear probe on the encoder."""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from experiments.paper.feature_baselines import (
    ContactFeatures,
    LabelledFeatures,
    linear_probe,
    other_objects,
    together_and_alone,
)
from experiments.study import stages
from experiments.study.baselines import level_answers
from experiments.study.stages import EncodedContacts, Weights, encode_rows, make_arm, noise_bank, run_grpo
from experiments.study.study import EvalVariant, TrainedPolicy, ask_policy
from touchr1_jax.bench.grounding import CONTROLS
from touchr1_jax.models.policy import Features
from touchr1_jax.rl.config import AnyAlgorithm
from touchr1_jax.rl.counterfactual import drop_touch, noise_touch, shuffle_touch
from touchr1_jax.training.evaluation import Evaluation


def control_variants(policy: str) -> dict[str, EvalVariant]:
    """For each of `CONTROLS` the policy evaluated without its touch, or with something else in its place."""
    return {
        control_name(policy, control): EvalVariant(of=policy, evaluate=functools.partial(_under_control, control))
        for control in CONTROLS
    }


def control_name(policy: str, control: str) -> str:
    """Name of the answers of a policy under a control."""
    return f"{policy}-under-{control}"


def untrained(trained: TrainedPolicy) -> Evaluation:
    """The policy as it is before SFT."""
    params = stages.untrained(trained.policy, trained.data, trained.seed)
    test = encode_rows(trained.policy, params, trained.data, trained.data.parts["test"], trained.context)
    return ask_policy(trained.policy, params, test, trained.label, trained.context)


def without_sft(weights: Weights, algorithm: AnyAlgorithm, trained: TrainedPolicy) -> Evaluation:
    """GRPO from fresh parameters, with the questions and steps of the arms that start from SFT."""
    policy, data, config = trained.policy, trained.data, trained.config
    params = stages.untrained(policy, data, trained.seed)
    encode = functools.partial(encode_rows, policy, params, data, context=trained.context)
    grpo = dataclasses.replace(config.grpo, algorithm=algorithm)
    arm = make_arm(policy, weights, data.prior(), grpo, config.grpo_loop, config.grpo_lora)
    noise = noise_bank(policy, params, data, seed=trained.seed)
    contacts = EncodedContacts(
        features=encode(rows=data.parts["grpo"]),
        label=trained.grpo_label,
        truth=data.label[data.parts["grpo"]],
        noise=noise,
    )
    stage = f"grpo/no_sft/{trained.seed}"
    tuned = run_grpo(policy, arm, contacts, params, trained.context, seed=trained.seed, stage=stage)
    return ask_policy(policy, tuned, encode(rows=data.parts["test"]), trained.label, trained.context)


def encoder_probe(swapped: bool, trained: TrainedPolicy) -> Evaluation:
    """Levels by a linear probe on the encoded touch, its mean over the tokens of each stream.

    Args:
      swapped: give every contact, training ones too, the touch of another object.
      trained: whose encoder it is.
    """
    data = trained.data
    rows = np.concatenate([data.parts["sft"], data.parts["grpo"]])
    known = mean_tokens(encode_rows(trained.policy, trained.params, data, rows, trained.context))
    asked = mean_tokens(trained.test)
    if swapped:
        known = known.rows(other_objects(data.object_ids[rows], trained.seed))
        asked = asked.rows(other_objects(data.object_ids[data.parts["test"]], trained.seed))
    probe = functools.partial(linear_probe, levels=trained.policy.levels, config=trained.config.probe)
    levels = together_and_alone(probe, LabelledFeatures(features=known, label=data.label[rows]), asked)
    return level_answers(trained.policy, trained.evaluation, levels.together, levels.alone)


def mean_tokens(features: Features) -> ContactFeatures:
    """Mean over the tokens of each stream."""
    there = (np.asarray(features.touch_time) >= 0) & np.asarray(features.stream_mask)[..., None]
    total = (np.asarray(features.touch) * there[..., None]).sum(-2)
    x = total / np.maximum(there.sum(-1), 1)[..., None]
    return ContactFeatures(x=x.astype(np.float32), present=there.any(-1))


def swap_objects(features: Features, objects: np.ndarray, seed: int) -> Features:
    """Every contact with the touch of a contact of another object; streams that only one of the two has are dropped.

    Args:
      features: those of n contacts.
      objects: [n], the object of each.
      seed: of the draw.
    """
    other = other_objects(objects, seed)
    return dataclasses.replace(
        features,
        touch=features.touch[other],
        touch_time=features.touch_time[other],
        stream_mask=features.stream_mask & features.stream_mask[other],
    )


def _under_control(control: str, trained: TrainedPolicy) -> Evaluation:
    test, key = jax.tree.map(jnp.asarray, trained.test), jax.random.key(trained.seed)
    objects = trained.data.object_ids[trained.data.parts["test"]]
    change: Mapping[str, Callable[[], Features]] = {
        "drop": lambda: drop_touch(test).features,
        "shuffle": lambda: shuffle_touch(test, key).features,
        "noise": lambda: noise_touch(test, trained.noise, key).features,
        "swapped": lambda: swap_objects(trained.test, objects, trained.seed),
    }
    changed = jax.device_get(change[control]())
    return ask_policy(trained.policy, trained.params, changed, trained.label, trained.context, alone=False)
