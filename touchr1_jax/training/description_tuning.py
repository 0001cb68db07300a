"""Supervised fine-tuning, then GRPO, of an ensemble of policies that read descriptions of touch."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import grain
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.description_policy import COMBINATIONS, LANGUAGE, LENGTH, LEVELS, DescriptionPolicy
from touchr1_jax.rewards import make_rewards
from touchr1_jax.rl.config import AnyAlgorithm, GRPOConfig
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.scoring import ScoreFn, make_score, reward_weights
from touchr1_jax.training.loop import Hooks, LoopConfig, fit
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.training.questions import ONE_AT_A_TIME
from touchr1_jax.training.sft import SFTState
from touchr1_jax.training.train_grpo import train_grpo
from touchr1_jax.types import Params
from touchr1_jax.validation import at_least, within

REWARD = {"accuracy": 0.5, "exact": 0.5}  # reward of GRPO → weight


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """Supervised fine-tuning; the learning rate is the paper's 1e-5 times `lr_scale`."""

    steps: int = 40
    batch_size: int = 32
    drop: float = 0.3
    """Probability with which an input of the encoder is left out, the others growing to the same sum."""
    noise: float = 0.5
    """Standard deviation of the noise added to each input; the inputs have 1."""
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=30.0, weight_decay=0.05)

    def __post_init__(self) -> None:
        at_least(self, 0, "steps", "noise")
        at_least(self, 1, "batch_size")
        within(self, 0, 0.99, "drop")


READING = TuneConfig(
    steps=600,
    batch_size=64,
    drop=0.0,
    noise=0.0,
    optimizer=OptimizerConfig(learning_rate=1e-5, lr_scale=400.0, weight_decay=0.01),
)
"""Training on made-up evidence, by which a policy learns to read it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReinforceConfig:
    """GRPO after it; 0 steps leave it out."""

    steps: int = 0
    grpo: GRPOConfig = dataclasses.field(
        default_factory=lambda: GRPOConfig(prompts=32, micro_prompts=32, length=LENGTH, lr_scale=300.0)
    )


@struct.dataclass
class Lesson:
    """Training data of a policy: n prompts of up to C touches of one object; those of weight 0 are never drawn.

    `percept` is the level by out-of-fold evidence about the touches, `target` the probability of each level of the
    object; every step draws the conclusion that the policy learns from `target`.
    """

    x: Float[Array, "n C D"]
    percept: Int[Array, "n A"]
    target: Float[Array, "n A K"]
    weight: Float[Array, "n"]


def reading_lesson(contacts: int, rows: int, seed: int) -> Lesson:
    """Synthetic evidence and answers that repeat it: perceived are the most likely levels, the conclusion is drawn.

    With p ~ Dirichlet(1, 1, 1) of each touch and attribute, p̄ their mean, and the input log p less its mean,
    percept = argmax p̄ and conclusion ~ p̄³ / Σ p̄³: ridge regression shrinks probabilities, and a policy that repeats
    them would invert near ties by small errors.  This lesson needs no label.

    Args:
      contacts: C, the most touches; prompts hold 1 to C of them.
      rows, seed: examples and seed of the draws.
    """
    rng, attributes = np.random.default_rng(seed), len(LANGUAGE.attributes)
    p = rng.dirichlet(np.ones(LEVELS), (rows, contacts, attributes))
    p[np.arange(contacts) >= rng.integers(1, contacts + 1, (rows, 1))] = np.nan
    mean = np.nanmean(p, 1)
    sure = mean**3 / (mean**3).sum(-1, keepdims=True)
    return Lesson(
        x=jnp.asarray(evidence_inputs(p), jnp.float32),
        percept=jnp.asarray(mean.argmax(-1), jnp.int32),
        target=jnp.asarray(sure, jnp.float32),
        weight=jnp.ones(rows, jnp.float32),
    )


def evidence_inputs(p: Float[np.ndarray, "*n A K"]) -> Float[np.ndarray, "*n E"]:
    """Probabilities as inputs: their logarithms less the mean over the levels."""
    log = np.log(np.maximum(p, 1e-3))
    return (log - log.mean(-1, keepdims=True)).reshape(*p.shape[:-2], -1)


def tune(
    policy: DescriptionPolicy,
    config: TuneConfig,
    members: Sequence[Params],
    lessons: Sequence[Lesson],
    seeds: Sequence[int],
    hooks: Hooks,
) -> list[Params]:
    """Train the members of an ensemble on verified answers, each on its lesson; the loss is the mean over them."""
    optimizer, advance = _tune_program(policy, config)
    first = tuple(SFTState(params=p, opt_state=optimizer.init(p), step=jnp.zeros((), jnp.int32)) for p in members)
    keys = [jax.random.split(jax.random.key(seed), config.steps) for seed in seeds]

    def step(states: tuple[SFTState, ...], t: int) -> tuple[tuple[SFTState, ...], dict[str, Array]]:
        moved = [advance(state, key[t], lesson) for state, key, lesson in zip(states, keys, lessons, strict=True)]
        return tuple(state for state, _ in moved), {"loss": jnp.mean(jnp.stack([loss for _, loss in moved]))}

    numbers = iter(grain.MapDataset.range(config.steps).to_iter_dataset(ONE_AT_A_TIME))
    trained = fit(step, first, numbers, LoopConfig(steps=config.steps), hooks)
    return [state.params for state in trained]


@functools.cache
def _tune_program(policy: DescriptionPolicy, config: TuneConfig) -> tuple[optax.GradientTransformation, Any]:
    """Optimizer, and the compiled (state, key, lesson) → (state, loss), made once for all members and folds."""
    optimizer = make_optimizer(config.optimizer, config.steps)
    answers = jnp.asarray(policy.answers)
    counted = jnp.asarray(policy.answer(COMBINATIONS[0], COMBINATIONS[0])[1])[None]

    def loss(params: Params, x: Array, tokens: Array) -> Array:
        each = jax.vmap(lambda row, answer: policy.log_probs(params, row, answer[None])[0])
        return -masked.mean(each(x, tokens), counted)

    def advance(state: SFTState, key: Array, lesson: Lesson) -> tuple[SFTState, Array]:
        draw, change, conclude = jax.random.split(key, 3)
        share = lesson.weight / jnp.sum(lesson.weight)
        rows = jax.random.choice(draw, len(share), (config.batch_size,), p=share)
        concluded = jax.random.categorical(conclude, jnp.log(lesson.target[rows]))
        tokens = answers[number(lesson.percept[rows]), number(concluded)]
        value, grads = jax.value_and_grad(loss)(state.params, disturb(change, lesson.x[rows], config), tokens)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        return SFTState(params=params, opt_state=opt_state, step=state.step + 1), value

    return optimizer, jax.jit(advance)


def disturb(key: Array, x: Float[Array, "n C D"], config: TuneConfig) -> Float[Array, "n C D"]:
    """Inputs with some set to 0 and noise on the rest; inputs of missing touches do not change."""
    drop_key, noise_key = jax.random.split(key)
    kept = jax.random.bernoulli(drop_key, 1 - config.drop, x.shape)
    moved = jnp.where(kept, x + config.noise * jax.random.normal(noise_key, x.shape), 0.0) / (1 - config.drop)
    return jnp.where(jnp.isnan(x), x, moved)


def number(levels: Int[Array, "*n A"]) -> Int[Array, "*n"]:
    """Index of a combination of levels in `COMBINATIONS`."""
    return jnp.sum(levels * LEVELS ** jnp.arange(levels.shape[-1])[::-1], -1)


def reinforce(
    policy: DescriptionPolicy,
    config: ReinforceConfig,
    params: Params,
    lesson: Lesson,
    seed: int,
    hooks: Hooks,
) -> Params:
    """GRPO of one member's decoder; the encoder stays as it is."""
    rng = np.random.default_rng(seed)
    noise = jnp.asarray(rng.standard_normal((64, *lesson.x.shape[1:])), jnp.float32)
    weight = np.asarray(lesson.weight, np.float64)
    drawn = [rng.choice(len(weight), config.grpo.drawn, p=weight / weight.sum()) for _ in range(config.steps)]
    batches = grain.MapDataset.source(drawn).map(functools.partial(_questions, policy, params, lesson))
    return train_grpo(
        policy,
        params,
        iter(batches.to_iter_dataset(ONE_AT_A_TIME)),
        _score(policy, config.grpo.algorithm),
        config.grpo,
        LoopConfig(steps=config.steps),
        hooks,
        noise=policy.features(params, noise).touch,
        seed=seed,
    )


@functools.cache
def _score(policy: DescriptionPolicy, algorithm: AnyAlgorithm) -> ScoreFn:
    equal = np.full((len(LANGUAGE.attributes), LEVELS), 1 / LEVELS, np.float32)
    return make_score(policy.parser, make_rewards(equal), reward_weights(algorithm, REWARD))


def _questions(policy: DescriptionPolicy, params: Params, lesson: Lesson, rows: np.ndarray) -> GRPOBatch:
    """The one question about each of some videos."""
    first = np.zeros(len(rows), int)
    return GRPOBatch(
        features=policy.features(params, lesson.x[rows]),
        ids=jnp.asarray(policy.layout.ids[first]),
        mask=jnp.asarray(policy.layout.mask[first]),
        target=policy.target(first, np.asarray(lesson.target)[rows].argmax(-1), np.ones((len(rows), 1), bool)),
    )
