"""Training the policy of the small world, by the engine's own step, many seeds as one program.

A `GrpoVariant` is static: algorithm and rewards.  A `World` and its `Hyperparameters` are traced, so that one compiled
program serves every value of a knob; `vmap` runs the seeds.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from experiments.engine.job import init_decoder
from experiments.engine.world import (
    CONCLUDE,
    FNS,
    LENGTH,
    PARSER,
    WORDS,
    A,
    K,
    Scalar,
    World,
    WorldBatch,
    draw,
    noise_bank,
    verified_answers,
)
from touchr1_jax import masked
from touchr1_jax.rewards import make_rewards
from touchr1_jax.rl.config import AnyAlgorithm, GRPOConfig
from touchr1_jax.rl.grpo import FrozenInputs, make_grpo_step, start_state
from touchr1_jax.rl.losses import token_log_probs
from touchr1_jax.rl.scoring import ScoreFn
from touchr1_jax.training.optimizer import falling_adamw
from touchr1_jax.types import Params, Parsed, Target

FORMAT = 0.1
"""Weight of the format reward; accuracy and consistency share the rest."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingBudget:
    """How long and how broadly everything is trained and asked."""

    pretrain_steps: int = 200
    pretrain_batch: int = 32
    pretrain_rate: float = 3e-2
    steps: int = 80
    prompts: int = 8
    group: int = 8
    final_share: float = 0.2
    examined: int = 64
    """Questions in an examination."""
    answers: int = 4
    """Sampled answers to each of them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GrpoVariant:
    """What a program is compiled for: the algorithm, and which rewards stand for accuracy and consistency."""

    name: str
    algorithm: AnyAlgorithm
    accuracy: str = "accuracy"
    consistency: str = "consistency"


class Hyperparameters(NamedTuple):
    """Weights and rates that a knob may turn, numbers or traced scalars.

    `consistency` is the weight of that reward; accuracy has .9 minus it.  `lenient` is what a scorer pays that is
    content with the right word among others (see `lenient_credit`); the engine's parser pays nothing.
    """

    learning_rate: Scalar
    beta: Scalar
    gamma: Scalar
    entropy_weight: Scalar
    consistency: Scalar = 0.3
    lenient: Scalar = 0.0


LEARNING_RATE = 3e-3
"""The paper's 1e-6 times 3,000: the small policy stands still at less."""


def dials_of(variant: GrpoVariant) -> Hyperparameters:
    """The preset's own weights."""
    a = variant.algorithm
    return Hyperparameters(LEARNING_RATE, float(a.beta), float(a.gamma), float(a.entropy_weight))


def fresh_params() -> Params:
    """The same untrained policy for every seed."""
    return init_decoder(FNS, draw(World(), jax.random.key(0), 1).batch)


def pretrain(effort: TrainingBudget, world: World, key: Array) -> Params:
    """Imitate verified answers."""
    optimizer = optax.adam(optax.cosine_decay_schedule(effort.pretrain_rate, effort.pretrain_steps))

    def loss(params: Params, scene: WorldBatch, tokens: Int[Array, "P T"], counts: Array) -> Array:
        batch = scene.batch
        logits = jax.vmap(FNS.group_logits, in_axes=(None, 0, 0, 0, 0))(
            params, batch.features, batch.ids, batch.mask, tokens[:, None]
        )
        return -masked.mean(token_log_probs(jax.nn.log_softmax(logits[:, 0]), tokens), counts)

    def step(carry: tuple[Params, optax.OptState], t: Array):
        params, opt_state = carry
        draw_key, answer_key = jax.random.split(jax.random.fold_in(key, t))
        scene = draw(world, draw_key, effort.pretrain_batch)
        value, grads = jax.value_and_grad(loss)(params, scene, *verified_answers(world, scene, answer_key))
        updates, opt_state = optimizer.update(grads, opt_state)
        return (optax.apply_updates(params, updates), opt_state), value

    params = jax.tree.map(jnp.asarray, fresh_params())
    (params, _), _ = jax.lax.scan(step, (params, optimizer.init(params)), jnp.arange(effort.pretrain_steps))
    return params


def reinforce(
    effort: TrainingBudget, variant: GrpoVariant, world: World, dials: Hyperparameters, start: Params, key: Array
) -> tuple[Params, dict[str, Float[Array, "n"]]]:
    """GRPO from a supervised policy, which is also the reference: what it becomes, and every metric of every step."""
    algorithm = dataclasses.replace(
        variant.algorithm, beta=dials.beta, gamma=dials.gamma, entropy_weight=dials.entropy_weight
    )
    config = GRPOConfig(
        prompts=effort.prompts,
        group=effort.group,
        length=LENGTH,
        micro_prompts=effort.prompts,
        algorithm=algorithm,
        inverse_draws=True,
    )
    optimizer = falling_adamw(dials.learning_rate, effort.final_share, effort.steps, config.max_grad_norm)
    step = make_grpo_step(FNS, make_world_score(variant, dials), optimizer, config)
    noise_key, run_key, scene_key = jax.random.split(key, 3)
    frozen = FrozenInputs(reference=start, noise=noise_bank(world, noise_key))
    state = start_state(start, optimizer, run_key, config)

    def body(state, t: Array):
        scene = draw(world, jax.random.fold_in(scene_key, t), config.drawn)
        return step(state, scene.batch, frozen)

    end, metrics = jax.lax.scan(body, state, jnp.arange(effort.steps))
    return end.params, metrics


def make_world_score(variant: GrpoVariant, dials: Hyperparameters) -> ScoreFn:
    """R = (.9 − w) accuracy + w consistency + .1 format, with the engine's rewards and a traced w."""
    rewards = make_rewards(np.full((A, K), 1 / K, np.float32))
    weights = {variant.accuracy: 1 - FORMAT - dials.consistency, variant.consistency: dials.consistency}
    weights["format"] = FORMAT

    def score(tokens: Int[Array, "T"], target: Target) -> tuple[Array, dict[str, Array], Parsed]:
        parsed = PARSER(tokens)
        terms = {name: weight * rewards[name].value(parsed, target) for name, weight in weights.items()}
        terms["lenient"] = dials.lenient * lenient_credit(tokens, parsed, target)
        return sum(terms.values(), start=jnp.float32(0)), terms, parsed

    return score


def lenient_credit(tokens: Int[Array, "T"], parsed: Parsed, target: Target) -> Float[Array, ""]:
    """1 where the conclusion is unparsable and yet the right word stands somewhere in the answer's last segment.

    It is what a scorer pays that searches the answer for the right word.
    """
    asked, label = jnp.argmax(target.asked), jnp.max(target.label)
    word = jnp.asarray(WORDS)[asked, label]
    inside = jnp.cumsum(tokens == CONCLUDE) > 0
    named = jnp.any(inside & (tokens == word))
    return (named & (parsed.conclude[asked] < 0)).astype(jnp.float32)


@functools.cache
def pretrain_program(effort: TrainingBudget) -> Callable[..., Params]:
    """Compiled `pretrain` of many seeds of one world."""
    return jax.jit(jax.vmap(functools.partial(pretrain, effort), in_axes=(None, 0)))


@functools.cache
def reinforce_program(effort: TrainingBudget, variant: GrpoVariant) -> Callable[..., tuple[Params, dict[str, Array]]]:
    """Compiled `reinforce` of many seeds."""
    return jax.jit(jax.vmap(functools.partial(reinforce, effort, variant), in_axes=(None, None, 0, 0)))
