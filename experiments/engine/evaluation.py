"""What a policy of the small world has become: its answers under true and changed touch, and its divergences."""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from experiments.engine.training import TrainingBudget
from experiments.engine.world import FNS, LENGTH, PARSER, K, S, World, WorldBatch, draw, noise_bank
from touchr1_jax import masked
from touchr1_jax.models.policy import Features
from touchr1_jax.rl.counterfactual import drop_touch, noise_touch, shuffle_touch, swap_touch
from touchr1_jax.rl.losses import entropy, exact_kl
from touchr1_jax.rl.metrics import answer_metrics
from touchr1_jax.rl.rollout import SampleConfig, encode_prompts, sample_prompts
from touchr1_jax.types import Params, Parsed, Rollout

Figures = Mapping[str, Float[Array, ""]]


def examine(effort: TrainingBudget, world: World, params: Params, reference: Params, key: Array) -> dict[str, Array]:
    """Scores of sampled answers to fresh questions, and the same questions with touch changed in every way.

    `accuracy_C` is the accuracy under change C, `shuffled` the share of prompts that the shuffle could change.  `kl` to
    the reference, `grounding` under noise in one stream and `entropy` are exact means over
    the tokens of the answers, nat.
    """
    keys = jax.random.split(key, 5)
    scene = draw(world, keys[0], effort.examined)
    noise = noise_bank(world, keys[1])
    features = scene.batch.features
    shuffled = shuffle_touch(features, keys[2])
    ways = {
        "true": features,
        "drop": drop_touch(features).features,
        "noise": noise_touch(features, noise, keys[2]).features,
        "swap": swap_touch(features, keys[2]).features,
        "shuffle": shuffled.features,
    }
    every = jax.tree.map(lambda *x: jnp.stack(x), *ways.values())
    rollouts, said = jax.vmap(lambda f: answers(effort, params, scene, f, keys[3]))(every)
    by_way = jax.vmap(lambda one: scores(scene, one))(said)
    figures = {name: value[0] for name, value in by_way.items()}
    figures |= {f"accuracy_{way}": by_way["accuracy"][i] for i, way in enumerate(ways) if i}
    figures["shuffled"] = jnp.mean(shuffled.applies)
    own = jax.tree.map(lambda x: x[0], rollouts)
    return figures | divergences(params, reference, scene, own, noise, keys[4])


def answers(
    effort: TrainingBudget, params: Params, scene: WorldBatch, features: Features, key: Array
) -> tuple[Rollout, Parsed]:
    """Sampled answers, and what they say; leading axes P and G."""
    batch = dataclasses.replace(scene.batch, features=features)
    config = SampleConfig(group=effort.answers, length=LENGTH, end_ids=FNS.end_ids, pad_id=FNS.pad_id, inverse=True)
    rollout = sample_prompts(FNS, params, encode_prompts(FNS, params, batch), key, config)
    return rollout, jax.vmap(jax.vmap(PARSER))(rollout.tokens)


def scores(scene: WorldBatch, said: Parsed) -> dict[str, Array]:
    """Accuracy, ordinal error (⊥ counts K − 1), shares of middle and commonest answers, what the slots are worth."""
    target = scene.batch.target
    asked = jnp.broadcast_to(target.asked[:, None], said.conclude.shape)
    answer = jnp.sum(jnp.where(asked, said.conclude, 0), -1)
    error = jnp.where(answer < 0, K - 1, jnp.abs(answer - scene.level[:, None]))
    slots = jnp.sum(jnp.where(asked[..., None, :], said.perceive, 0), -1)
    return {
        "accuracy": jnp.mean(answer == scene.level[:, None]),
        "omae": jnp.mean(error.astype(jnp.float32)),
        "middle": jnp.mean(answer == (K - 1) // 2),
        "parsed": jnp.mean(said.formatted & (answer >= 0)),
        "slots_right": jnp.mean(slots == scene.level[:, None, None]),
        **{name: value for name, value in answer_metrics(said, target).items() if name in KEPT},
    }


KEPT = ("mode_share", "echo_share", "gamed_share")


def divergences(
    params: Params, reference: Params, scene: WorldBatch, rollout: Rollout, noise: Float[Array, "K S N D"], key: Array
) -> dict[str, Array]:
    """Exact KL to the reference, grounding of every stream, entropy: means over tokens, nat."""
    features, drawn = scene.batch.features, noise_touch(scene.batch.features, noise, key).features.touch

    def log_p(which: Params, touch: Float[Array, "P S N D"]) -> Array:
        batch = dataclasses.replace(scene.batch, features=dataclasses.replace(features, touch=touch))
        logits = jax.vmap(FNS.group_logits, in_axes=(None, 0, 0, 0, 0))(
            which, batch.features, batch.ids, batch.mask, rollout.tokens
        )
        return jax.nn.log_softmax(logits)

    own = log_p(params, features.touch)
    mean = lambda x: jnp.mean(masked.mean(x, rollout.mask, axis=-1))
    figures = {"kl": mean(exact_kl(own, log_p(reference, features.touch))), "entropy": mean(entropy(own))}
    for s in range(S):
        one = features.touch.at[:, s].set(drawn[:, s])
        figures[f"grounding_{s}"] = mean(exact_kl(own, log_p(params, one)))
    figures["grounding"] = sum((figures[f"grounding_{s}"] for s in range(S)), start=jnp.float32(0)) / S
    return figures


@functools.cache
def examine_program(effort: TrainingBudget) -> Callable[..., dict[str, Array]]:
    """Compiled `examine` of many seeds of one world."""
    return jax.jit(jax.vmap(functools.partial(examine, effort), in_axes=(None, 0, 0, 0)))
