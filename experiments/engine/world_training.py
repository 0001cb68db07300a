"""Training and evaluation of the simulated world's policy by the library's GRPO step, many seeds as one program.

A `GrpoVariant` (algorithm and rewards) is static.  A `World` and its `Hyperparameters` are traced, so that one compiled
program serves every value of a parameter; `vmap` runs the seeds.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

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
    S,
    Scalar,
    World,
    WorldBatch,
    draw,
    noise_bank,
    verified_answers,
)
from touchr1_jax import masked
from touchr1_jax.models.policy import Features
from touchr1_jax.rewards import make_rewards
from touchr1_jax.rewards.base import reward_value
from touchr1_jax.rl.alarms import AlarmMonitor
from touchr1_jax.rl.config import AnyAlgorithm, GRPOConfig
from touchr1_jax.rl.counterfactual import noise_touch, shuffle_touch, swap_touch
from touchr1_jax.rl.grpo import FrozenInputs, make_grpo_step, start_state
from touchr1_jax.rl.losses import entropy, exact_kl, token_log_probs
from touchr1_jax.rl.metrics import answer_metrics
from touchr1_jax.rl.rollout import GRPOBatch, SampleConfig, encode_prompts, sample_prompts
from touchr1_jax.rl.scoring import ScoreFn, make_score, reward_weights
from touchr1_jax.rl.stream_check import StreamError, check_streams
from touchr1_jax.training.optimizer import falling_adamw
from touchr1_jax.types import Params, Parsed, Rollout, Target

FORMAT, CONSISTENCY = 0.1, 0.3  # weights of the rewards; accuracy has the rest

LEARNING_RATE, FINAL_SHARE = 3e-3, 0.2
"""3,000 times the paper's 1e-6: at less the small policy hardly changes; the share of it at the last step."""

PRETRAIN_RATE = 3e-2


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingBudget:
    """Steps and batch sizes of training, questions and answers of an evaluation."""

    pretrain_steps: int = 200
    pretrain_batch: int = 32
    steps: int = 80
    prompts: int = 8
    group: int = 8
    examined: int = 64
    """Questions of an evaluation."""
    answers: int = 4
    """Sampled answers to each of them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GrpoVariant:
    """The static part of a program: the algorithm, the reward that stands for accuracy, and what else differs.

    Attributes:
      sampling: fields of `GRPOConfig` with their values.
      more_rewards: further rewards and their weights, where a setting has no hyperparameters of its own.
    """

    name: str
    algorithm: AnyAlgorithm
    accuracy: str = "accuracy"
    sampling: tuple[tuple[str, float], ...] = ()
    more_rewards: tuple[tuple[str, float], ...] = ()


class Hyperparameters(NamedTuple):
    """Weights and rates that a knob may change, numbers or traced scalars.

    `consistency` is the weight of that reward; accuracy has .9 minus it.  `lenient` is the reward of `lenient_credit`,
    which the library's parser never pays.
    """

    learning_rate: Scalar
    beta: Scalar
    gamma: Scalar
    entropy_weight: Scalar
    consistency: Scalar = CONSISTENCY
    lenient: Scalar = 0.0


Setting = tuple[World, Hyperparameters | None]
"""Values of all knobs; without hyperparameters the preset's own, static: a term of weight 0 is then not computed."""


def hyperparameters_of(variant: GrpoVariant) -> Hyperparameters:
    """The preset's own weights."""
    a = variant.algorithm
    return Hyperparameters(LEARNING_RATE, float(a.beta), float(a.gamma), float(a.entropy_weight))


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariantRun:
    """All seeds of one variant in one setting; every array has the seeds as its first axis.

    `before` and `after` are evaluations, `metrics` those of every step; `refused`: the check before training raised.
    """

    before: Mapping[str, np.ndarray]
    after: Mapping[str, np.ndarray]
    metrics: Mapping[str, np.ndarray]
    refused: bool = False

    def late(self, name: str, steps: int = 40) -> np.ndarray:
        """Mean of a metric over the last steps."""
        return self.metrics[name][:, -steps:].mean(1)

    def gain(self, name: str) -> np.ndarray:
        """Change of a figure by training."""
        return self.after[name] - self.before[name]

    def streams_pass(self) -> bool:
        """True if every seed passes the stream check that each study makes before it trains."""
        try:
            for influence in np.stack([self.before[f"grounding_{s}"] for s in range(S)], 1):
                check_streams(influence, np.ones(S, bool))
        except StreamError:
            return False
        return True

    def alarms(self, seed: int) -> "dict[str, FirstAlarm]":
        """Code of each alarm that a seed's training raised → when it first did."""
        monitor, fired = AlarmMonitor(), dict[str, FirstAlarm]()
        for t in range(len(self.metrics["reward"][seed])):
            for alarm in monitor.update({name: float(value[seed, t]) for name, value in self.metrics.items()}):
                fired.setdefault(alarm.code, FirstAlarm(t, alarm.value))
        return fired


class FirstAlarm(NamedTuple):
    """The first time that an alarm fired: step, counted from 0, and the number that passed its bound."""

    step: int
    value: float


class VariantRuns:
    """Train and evaluate variants, each in each setting once."""

    def __init__(self, budget: TrainingBudget, seeds: Sequence[int]) -> None:
        self._budget = budget
        self._keys = jax.vmap(jax.random.key)(np.asarray(seeds))
        self._pretrained: dict[World, Params] = {}
        self._before: dict[World, dict[str, Array]] = {}
        self._runs: dict[tuple[GrpoVariant, Setting], VariantRun] = {}

    def run(self, variant: GrpoVariant, setting: Setting, *, checked: bool) -> VariantRun:
        """All seeds of one variant in one setting; if checked, with the check of the streams before training."""
        if (variant, setting) not in self._runs:
            self._runs[variant, setting] = self._train(variant, setting)
        run = self._runs[variant, setting]
        return dataclasses.replace(run, refused=checked and not run.streams_pass())

    def _train(self, variant: GrpoVariant, setting: Setting) -> VariantRun:
        world, _ = setting
        start = self._supervised(world)
        evaluator = seeds_program(evaluate, (self._budget,), 1, 3)
        if world not in self._before:
            self._before[world] = evaluator(world, start, start, self._keys)
        end, metrics = self.training(variant, setting)()
        after = evaluator(world, end, start, self._keys)
        return VariantRun(**jax.device_get({"before": self._before[world], "after": after, "metrics": metrics}))

    def training(self, variant: GrpoVariant, setting: Setting) -> Callable[[], tuple[Params, dict[str, Array]]]:
        """Reinforcement of all seeds as a call: their parameters and the metrics of every step."""
        world, values = setting
        program, start = seeds_program(reinforce, (self._budget, variant), 2, 2), self._supervised(world)
        return lambda: program(world, values, start, self._keys)

    def _supervised(self, world: World) -> Params:
        """The policies that supervised training makes of a world, with their logits scaled."""
        plain = world._replace(sharp=1.0)
        if plain not in self._pretrained:
            self._pretrained[plain] = seeds_program(pretrain, (self._budget,), 1, 1)(plain, self._keys)
        decoder = self._pretrained[plain]["decoder"]
        norm = {"scale": decoder["norm"]["scale"] * world.sharp}
        return {"decoder": {**decoder, "norm": norm}}


def pretrain(budget: TrainingBudget, world: World, key: Array) -> Params:
    """Imitate verified answers, from the same untrained policy for every seed."""
    optimizer = optax.adam(optax.cosine_decay_schedule(PRETRAIN_RATE, budget.pretrain_steps))

    def loss(params: Params, scene: WorldBatch, tokens: Int[Array, "P T"], counts: Array) -> Array:
        return -masked.mean(token_log_probs(log_probs(params, scene.batch, tokens[:, None])[:, 0], tokens), counts)

    def step(carry: tuple[Params, optax.OptState], t: Array):
        params, opt_state = carry
        draw_key, answer_key = jax.random.split(jax.random.fold_in(key, t))
        scene = draw(world, draw_key, budget.pretrain_batch)
        value, grads = jax.value_and_grad(loss)(params, scene, *verified_answers(world, scene, answer_key))
        updates, opt_state = optimizer.update(grads, opt_state)
        return (optax.apply_updates(params, updates), opt_state), value

    untrained = init_decoder(FNS, draw(World(), jax.random.key(0), 1).batch)
    params = jax.tree.map(jnp.asarray, untrained)
    (params, _), _ = jax.lax.scan(step, (params, optimizer.init(params)), jnp.arange(budget.pretrain_steps))
    return params


def log_probs(params: Params, batch: GRPOBatch, tokens: Int[Array, "P G T"]) -> Float[Array, "P G T V"]:
    """Log-probabilities at every token of G answers to each question."""
    logits = jax.vmap(FNS.group_logits, in_axes=(None, 0, 0, 0, 0))
    return jax.nn.log_softmax(logits(params, batch.features, batch.ids, batch.mask, tokens))


def reinforce(
    budget: TrainingBudget,
    variant: GrpoVariant,
    world: World,
    values: Hyperparameters | None,
    start: Params,
    key: Array,
) -> tuple[Params, dict[str, Float[Array, "n"]]]:
    """GRPO from a supervised policy, which is also the reference: its parameters, and all metrics of every step."""
    algorithm, rate = variant.algorithm, LEARNING_RATE
    if values is not None:
        weights = {name: getattr(values, name) for name in ("beta", "gamma", "entropy_weight")}
        algorithm, rate = dataclasses.replace(algorithm, **weights), values.learning_rate
    sizes: dict[str, Any] = {
        "prompts": budget.prompts,
        "group": budget.group,
        "micro_prompts": budget.prompts // algorithm.minibatches,
        **dict(variant.sampling),
    }
    config = GRPOConfig(**sizes, length=LENGTH, algorithm=algorithm, inverse_draws=True)
    optimizer = falling_adamw(rate, FINAL_SHARE, budget.steps, config.max_grad_norm)
    step = make_grpo_step(FNS, make_world_score(variant, values), optimizer, config)
    noise_key, run_key, scene_key = jax.random.split(key, 3)
    frozen = FrozenInputs(reference=start, noise=noise_bank(world, noise_key))
    state = start_state(start, optimizer, run_key, config)

    def body(state, t: Array):
        scene = draw(world, jax.random.fold_in(scene_key, t), config.drawn)
        return step(state, scene.batch, frozen)

    end, metrics = jax.lax.scan(body, state, jnp.arange(budget.steps))
    return end.params, metrics


def make_world_score(variant: GrpoVariant, values: Hyperparameters | None) -> ScoreFn:
    """R = (.9 − w) accuracy + w consistency + .1 format, with the library's rewards and a w that may be traced."""
    rewards = make_rewards(np.full((A, K), 1 / K, np.float32))
    consistency = CONSISTENCY if values is None else values.consistency
    shares = {variant.accuracy: 1 - FORMAT - consistency, "consistency": consistency, "format": FORMAT}
    weights = reward_weights(variant.algorithm, shares)
    if values is None:
        return make_score(PARSER, rewards, {**weights, **dict(variant.more_rewards)})

    def score(tokens: Int[Array, "T"], target: Target) -> tuple[Array, dict[str, Array], Parsed]:
        parsed = PARSER(tokens)
        terms = {name: weight * reward_value(name, rewards[name], parsed, target) for name, weight in weights.items()}
        terms["lenient"] = values.lenient * lenient_credit(tokens, parsed, target)
        return sum(terms.values(), start=jnp.float32(0)), terms, parsed

    return score


def lenient_credit(tokens: Int[Array, "T"], parsed: Parsed, target: Target) -> Float[Array, ""]:
    """1 where the conclusion cannot be parsed but contains the right word, as a scorer that searches would pay."""
    asked, label = jnp.argmax(target.asked), jnp.max(target.label)
    word = jnp.asarray(WORDS)[asked, label]
    inside = jnp.cumsum(tokens == CONCLUDE) > 0
    named = jnp.any(inside & (tokens == word))
    return (named & (parsed.conclude[asked] < 0)).astype(jnp.float32)


def evaluate(budget: TrainingBudget, world: World, params: Params, reference: Params, key: Array) -> dict[str, Array]:
    """Scores of sampled answers to fresh questions.

    `accuracy_swap` is the accuracy with another object's touch, `shuffled` the share of prompts that a shuffle of time
    could change.  `kl` to the reference, `grounding` under noise in one stream, and `entropy` are exact means over the
    tokens of the answers, in nat.
    """
    keys = jax.random.split(key, 5)
    scene = draw(world, keys[0], budget.examined)
    noise = noise_bank(world, keys[1])
    features = scene.batch.features
    swapped = swap_touch(features, keys[2]).features
    both = jax.tree.map(lambda *x: jnp.stack(x), features, swapped)
    rollouts, parsed = jax.vmap(lambda f: sample_answers(budget, params, scene, f, keys[3]))(both)
    by_touch = jax.vmap(lambda one: scores(scene, one))(parsed)
    figures = {name: value[0] for name, value in by_touch.items()}
    figures["accuracy_swap"] = by_touch["accuracy"][1]
    figures["shuffled"] = jnp.mean(shuffle_touch(features, keys[2]).applies)
    own = jax.tree.map(lambda x: x[0], rollouts)
    return figures | divergences(params, reference, scene, own, noise, keys[4])


def sample_answers(
    budget: TrainingBudget, params: Params, scene: WorldBatch, features: Features, key: Array
) -> tuple[Rollout, Parsed]:
    """Sampled answers and their parsed form; leading axes P and G."""
    batch = dataclasses.replace(scene.batch, features=features)
    config = SampleConfig(group=budget.answers, length=LENGTH, end_ids=FNS.end_ids, pad_id=FNS.pad_id, inverse=True)
    rollout = sample_prompts(FNS, params, encode_prompts(FNS, params, batch), key, config)
    return rollout, jax.vmap(jax.vmap(PARSER))(rollout.tokens)


def scores(scene: WorldBatch, parsed: Parsed) -> dict[str, Array]:
    """Accuracy, share of middle answers, accuracy of the perceived slots, shares of echoed and of gamed answers."""
    target = scene.batch.target
    asked = jnp.broadcast_to(target.asked[:, None], parsed.conclude.shape)
    answer = jnp.sum(jnp.where(asked, parsed.conclude, 0), -1)
    slots = jnp.sum(jnp.where(asked[..., None, :], parsed.perceive, 0), -1)
    metrics = answer_metrics(parsed, target, levels=0)
    return {
        "accuracy": jnp.mean(answer == scene.level[:, None]),
        "middle": jnp.mean(answer == (K - 1) // 2),
        "slots_right": jnp.mean(slots == scene.level[:, None, None]),
        "echo_share": metrics["echo_share"],
        "gamed_share": metrics["gamed_share"],
    }


def divergences(
    params: Params, reference: Params, scene: WorldBatch, rollout: Rollout, noise: Float[Array, "K S N D"], key: Array
) -> dict[str, Array]:
    """Exact KL to the reference, grounding of every stream, and entropy: means over tokens, nat."""
    features, noisy = scene.batch.features, noise_touch(scene.batch.features, noise, key).features.touch

    def log_p(which: Params, touch: Float[Array, "P S N D"]) -> Array:
        batch = dataclasses.replace(scene.batch, features=dataclasses.replace(features, touch=touch))
        return log_probs(which, batch, rollout.tokens)

    own = log_p(params, features.touch)
    mean = lambda x: jnp.mean(masked.mean(x, rollout.mask, axis=-1))
    figures = {"kl": mean(exact_kl(own, log_p(reference, features.touch))), "entropy": mean(entropy(own))}
    for s in range(S):
        one = features.touch.at[:, s].set(noisy[:, s])
        figures[f"grounding_{s}"] = mean(exact_kl(own, log_p(params, one)))
    figures["grounding"] = sum((figures[f"grounding_{s}"] for s in range(S)), start=jnp.float32(0)) / S
    return figures


@functools.cache
def seeds_program(
    function: Callable[..., Any], static: tuple[Any, ...], shared: int, mapped: int
) -> Callable[..., Any]:
    """Jitted function of many seeds: after its static arguments `shared` ones are equal for all, `mapped` are not."""
    return jax.jit(jax.vmap(functools.partial(function, *static), in_axes=(None,) * shared + (0,) * mapped))
