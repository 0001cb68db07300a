"""Supervised fine-tuning of a touch policy and GRPO after it, each one compiled program for every fold and member."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from experiments.recordings.policy import COMBINATIONS, LANGUAGE, LENGTH, LEVELS, TouchPolicy
from touchr1_jax import masked
from touchr1_jax.rewards import make_rewards
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import FrozenInputs, make_grpo_step, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.scoring import make_score
from touchr1_jax.training.optimizer import OptimizerConfig, falling_adamw, make_optimizer
from touchr1_jax.types import Params, Target


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """Supervised fine-tuning; the learning rate is the paper's 1e-5 times `lr_scale`."""

    steps: int = 40
    batch_size: int = 32
    drop: float = 0.3
    """Probability with which an input of the encoder is left out, the others growing to the same sum."""
    noise: float = 0.5
    """Standard deviation of what is added to each input; the inputs have 1."""
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=30.0, weight_decay=0.05)


READING = TuneConfig(
    steps=600,
    batch_size=64,
    drop=0.0,
    noise=0.0,
    optimizer=OptimizerConfig(learning_rate=1e-5, lr_scale=400.0, weight_decay=0.01),
)
"""How a policy learns to read evidence."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReinforceConfig:
    """GRPO after it; 0 steps leave it out."""

    steps: int = 0
    weights: tuple[tuple[str, float], ...] = (("accuracy", 0.5), ("exact", 0.5))
    grpo: GRPOConfig = dataclasses.field(
        default_factory=lambda: dataclasses.replace(
            GRPOConfig.paper(), prompts=32, micro_prompts=32, length=LENGTH, lr_scale=300.0
        )
    )


@struct.dataclass
class Lesson:
    """Training data of a policy: n videos; those of weight 0 are never drawn.

    `percept` is what out-of-fold evidence says of a video, `label` what the annotators said of its object.
    """

    x: Float[Array, "n D"]
    percept: Int[Array, "n A"]
    label: Int[Array, "n A"]
    weight: Float[Array, "n"]


def tune(
    policy: TouchPolicy, config: TuneConfig, params: Params, lesson: Lesson, seed: int
) -> tuple[Params, Float[np.ndarray, "T"]]:
    """A policy trained on verified answers, and its loss at every step; 0 steps leave it as it is."""
    if not config.steps:
        return params, np.zeros(0, np.float32)
    params, losses = _tune_program(policy, config)(jax.random.key(seed), params, lesson)
    return params, np.asarray(losses)


def reading_lesson(families: int, others: int, rows: int, seed: int) -> Lesson:
    """Made-up evidence, and the answers that say it: the most likely levels perceived, the conclusion drawn from it.

    With p ~ Dirichlet(1, 1, 1) of each family and attribute, p̄ their mean, and the input log p less its mean,
    percept = argmax p̄ and conclusion ~ p̄³ / Σ p̄³: ridge regression shrinks its probabilities, and a policy that
    repeats them would, by its own small errors, turn what is nearly a tie.  What this teaches costs no label.

    Args:
      families: M, probes whose evidence is read.
      others: inputs beside it, which say nothing here.
      rows: examples.
      seed: of the draws.
    """
    rng, attributes = np.random.default_rng(seed), len(LANGUAGE.attributes)
    p = rng.dirichlet(np.ones(LEVELS), (rows, families, attributes))
    mean = p.mean(1)
    sure = mean**3 / (mean**3).sum(-1, keepdims=True)
    drawn = (rng.random((rows, attributes, 1)) > sure.cumsum(-1)).sum(-1)
    x = np.concatenate([evidence_inputs(p), rng.standard_normal((rows, others))], 1)
    return Lesson(
        x=jnp.asarray(x, jnp.float32),
        percept=jnp.asarray(mean.argmax(-1), jnp.int32),
        label=jnp.asarray(np.minimum(drawn, LEVELS - 1), jnp.int32),
        weight=jnp.ones(rows, jnp.float32),
    )


def evidence_inputs(p: Float[np.ndarray, "n M A K"]) -> Float[np.ndarray, "n E"]:
    """Probabilities as inputs: their logarithms less the mean over the levels."""
    log = np.log(np.maximum(p, 1e-3))
    return (log - log.mean(-1, keepdims=True)).reshape(len(p), -1)


@functools.cache
def _tune_program(policy: TouchPolicy, config: TuneConfig) -> Any:
    """Compiled (key, params, lesson) → (params, losses)."""
    optimizer = make_optimizer(config.optimizer, config.steps)
    answers = jnp.asarray(policy.answers)
    counted = jnp.asarray(policy.answer(COMBINATIONS[0], COMBINATIONS[0])[1])

    def loss(params: Params, x: Array, tokens: Array) -> Array:
        each = jax.vmap(lambda row, said: policy.log_probs(params, row, said[None])[0])(x, tokens)
        return -masked.mean(each, counted[None])

    def run(key: Array, params: Params, lesson: Lesson) -> tuple[Params, Array]:
        share = lesson.weight / jnp.sum(lesson.weight)
        said = answers[number(lesson.percept), number(lesson.label)]

        def step(carry: tuple[Params, Any], key: Array) -> tuple[tuple[Params, Any], Array]:
            params, opt_state = carry
            draw, change = jax.random.split(key)
            rows = jax.random.choice(draw, len(share), (config.batch_size,), p=share)
            x = disturb(change, lesson.x[rows], config)
            value, grads = jax.value_and_grad(loss)(params, x, said[rows])
            updates, opt_state = optimizer.update(grads, opt_state, params)
            return (optax.apply_updates(params, updates), opt_state), value

        (params, _), losses = jax.lax.scan(step, (params, optimizer.init(params)), jax.random.split(key, config.steps))
        return params, losses

    return jax.jit(run)


def disturb(key: Array, x: Float[Array, "n D"], config: TuneConfig) -> Float[Array, "n D"]:
    """Inputs with some left out and noise on the rest."""
    drop_key, noise_key = jax.random.split(key)
    kept = jax.random.bernoulli(drop_key, 1 - config.drop, x.shape)
    return jnp.where(kept, x + config.noise * jax.random.normal(noise_key, x.shape), 0.0) / (1 - config.drop)


def number(levels: Int[Array, "*n A"]) -> Int[Array, "*n"]:
    """Index of a combination of levels in `COMBINATIONS`."""
    return jnp.sum(levels * LEVELS ** jnp.arange(levels.shape[-1])[::-1], -1)


def reinforce(
    policy: TouchPolicy, config: ReinforceConfig, params: Params, lesson: Lesson, seed: int
) -> tuple[Params, list[dict[str, float]]]:
    """GRPO of the decoder, the encoder held fixed; the metrics of every step with it."""
    if not config.steps:
        return params, []
    step, optimizer = _reinforce_program(policy, config)
    decoder = {"decoder": params["decoder"]}
    rng = np.random.default_rng(seed)
    noise = jnp.asarray(rng.standard_normal((64, lesson.x.shape[-1])), jnp.float32)
    frozen = FrozenInputs(reference=decoder, noise=policy.features(params, noise).touch)
    state = start_state(decoder, optimizer, jax.random.key(seed), config.grpo)
    weight = np.asarray(lesson.weight, np.float64)
    share = weight / weight.sum()
    log = []
    for _ in range(config.steps):
        rows = rng.choice(len(share), config.grpo.drawn, p=share)
        state, metrics = step(state, _questions(policy, params, lesson, rows), frozen)
        log.append(jax.device_get(metrics))
    return {**params, **state.params}, [{name: float(value) for name, value in row.items()} for row in log]


@functools.cache
def _reinforce_program(policy: TouchPolicy, config: ReinforceConfig) -> tuple[Any, optax.GradientTransformation]:
    """Compiled step and optimizer."""
    equal = np.full((len(LANGUAGE.attributes), LEVELS), 1 / LEVELS, np.float32)
    score = make_score(policy.parser, make_rewards(equal), dict(config.weights))
    grpo = config.grpo
    optimizer = falling_adamw(grpo.learning_rate * grpo.lr_scale, grpo.final_share, config.steps, grpo.max_grad_norm)
    return make_grpo_step(policy.fns, score, optimizer, grpo), optimizer


def _questions(policy: TouchPolicy, params: Params, lesson: Lesson, rows: np.ndarray) -> GRPOBatch:
    """The one question about each of some videos."""
    n, attributes = len(rows), len(LANGUAGE.attributes)
    everything: Bool[np.ndarray, "n A"] = np.ones((n, attributes), bool)
    return GRPOBatch(
        features=policy.features(params, lesson.x[rows]),
        ids=jnp.broadcast_to(jnp.asarray(policy.layout.ids[0]), (n, policy.layout.ids.shape[1])),
        mask=jnp.broadcast_to(jnp.asarray(policy.layout.mask[0]), (n, policy.layout.mask.shape[1])),
        target=Target(
            asked=jnp.asarray(everything),
            label=lesson.label[rows],
            levels=jnp.full((n, attributes), LEVELS, jnp.int32),
            ordinal=jnp.asarray(everything),
            streams=jnp.ones((n, 1), bool),
        ),
    )
