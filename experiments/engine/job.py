"""The job on which GRPO engines are timed: the same decoder, prompts, completions and updates for all engines.

8 prompts × 8 rollouts × 64 new tokens, no end token among them; a decoder of the Qwen2 shape with 1.05 million
parameters (4 layers, width 128, 4 heads over 2 key heads of 32, MLP 512, vocabulary 512, tied embedding) in float32;
one on-policy AdamW update with a KL of weight .04 to a reference.  The reward of a completion is its share of token ids
in the lower half of the vocabulary.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.extend.core import Jaxpr

from experiments.engine.peers import BETA, LEARNING_RATE, JobSize
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.policy import Features, Policy, PolicyConfig, Slots
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.rewards import HostReward
from touchr1_jax.rl.config import Advantage, AnyAlgorithm, GRPOConfig, Paper
from touchr1_jax.rl.grpo import FrozenInputs, make_grpo_step, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.scoring import ScoreFn, make_score
from touchr1_jax.types import Params, Parsed, Target

PLAIN = Paper(beta=BETA, gamma=0.0)  # GRPO with a reference policy and without the counterfactual pass

VIEW, TOUCH = 4, 8
"""Prompt tokens that are embeddings of the view and of the touch of the one sensor; the others are text."""


class Job:
    """One iteration as a call: `step()` samples, scores and updates, and returns the metrics.

    Args:
      size: the decoder and the numbers of prompts, rollouts and tokens.
      prefix: prompt tokens.
      config: the step.
      repeated: encode the prefix for every rollout, as if each were a prompt of its own.
      host: compute the reward in Python.
      end_share: share of the vocabulary that ends a completion, whose mean length is then 1/share; at 0 none does.
      learning_rate: AdamW's; 0 keeps the policy as it is.
      seed: of the prompts and of the sampling.
    """

    def __init__(
        self,
        size: JobSize,
        prefix: int,
        config: GRPOConfig,
        *,
        repeated: bool = False,
        host: bool = False,
        end_share: float = 0.0,
        learning_rate: float = LEARNING_RATE,
        seed: int = 0,
    ) -> None:
        if repeated:  # a group of one has no mean of its own
            config = dataclasses.replace(
                config,
                prompts=size.prompts * size.group,
                group=1,
                micro_prompts=config.micro_prompts * size.group,
                algorithm=dataclasses.replace(config.algorithm, advantage=Advantage.GLOBAL),
            )
        self.fns, optimizer, self._step = engine(size, prefix, config, host, end_share, learning_rate)
        self.batch = make_batch(size, prefix, config.drawn, seed)
        params = init_decoder(self.fns, self.batch)
        self.frozen = FrozenInputs(reference=params, noise=jnp.zeros((1, 1, TOUCH, size.hidden_size)))
        self.state = start_state(params, optimizer, jax.random.key(seed), config)

    def step(self) -> dict[str, jax.Array]:
        """Run one iteration, which replaces the state."""
        self.state, metrics = self._step(self.state, self.batch, self.frozen)
        return metrics

    @property
    def compilations(self) -> int:
        """Number of programs that the steps so far compiled."""
        return self._step._cache_size()

    def traced(self) -> Jaxpr:
        """The step as a program of JAX's primitives."""
        return self._step.trace(self.state, self.batch, self.frozen).jaxpr.jaxpr

    def lowered(self) -> jax.stages.Lowered:
        """The step before compilation."""
        return self._step.lower(self.state, self.batch, self.frozen)


@functools.cache
def engine(
    size: JobSize, prefix: int, config: GRPOConfig, host: bool, end_share: float, learning_rate: float
) -> tuple[PolicyFns, optax.GradientTransformation, Any]:
    """Policy, optimizer and jitted step, made once for all seeds."""
    fns, optimizer = make_fns(size, prefix, end_share), optax.adamw(learning_rate)
    return fns, optimizer, make_grpo_step(fns, low_ids(size.vocab_size, host=host), optimizer, config)


def config_of(size: JobSize, algorithm: AnyAlgorithm = PLAIN, **options: Any) -> GRPOConfig:
    """A step of the job's size, plain GRPO with a reference policy by default; `options` are fields of `GRPOConfig`."""
    sizes: dict[str, Any] = {"prompts": size.prompts, "group": size.group, "length": size.length, "micro_prompts": 1}
    return GRPOConfig(**sizes, algorithm=algorithm, inverse_draws=True, **options)


def decoder_config(size: JobSize) -> DecoderConfig:
    """The decoder; row and column get three eighths of the rotary frequencies each, time the rest."""
    names = {f.name for f in dataclasses.fields(DecoderConfig)}
    half = size.head_dim // 2
    sections = (half - 2 * (3 * half // 8), 3 * half // 8, 3 * half // 8)
    shape = {name: value for name, value in dataclasses.asdict(size).items() if name in names}
    return DecoderConfig(**shape, mrope_section=sections, rope_theta=1e6)


def make_fns(size: JobSize, prefix: int, end_share: float = 0.0) -> PolicyFns:
    """A policy whose prompts have `prefix` tokens and whose highest token ids end a completion."""
    tactile = TactileViTConfig(sensors=1, width=8, num_layers=0, num_heads=1)
    policy = Policy(PolicyConfig(tactile=tactile, vision=VisionConfig(), decoder=decoder_config(size)))
    slots = Slots(touch=np.arange(VIEW, VIEW + TOUCH)[None], view=np.arange(VIEW), stream_text=np.full(prefix, -1))
    first_end = size.vocab_size - round(end_share * size.vocab_size)
    ends = tuple(range(first_end, size.vocab_size)) or (size.vocab_size,)  # out of reach
    return PolicyFns(module=policy, slots=slots, banned=np.zeros(size.vocab_size, bool), end_ids=ends, pad_id=0)


def make_batch(size: JobSize, prefix: int, prompts: int, seed: int = 0) -> GRPOBatch:
    """Random prompts."""
    rng = np.random.default_rng(seed)
    normal = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)
    target = Target(
        asked=jnp.ones((prompts, 1), bool),
        label=jnp.zeros((prompts, 1), jnp.int32),
        levels=jnp.full((prompts, 1), 3),
        ordinal=jnp.ones((prompts, 1), bool),
        streams=jnp.ones((prompts, 1), bool),
    )
    features = Features(
        touch=normal(prompts, 1, TOUCH, size.hidden_size),
        touch_time=jnp.tile(jnp.arange(TOUCH) // 2, (prompts, 1, 1)),
        stream_mask=jnp.ones((prompts, 1), bool),
        view=normal(prompts, VIEW, size.hidden_size),
        view_mask=jnp.ones(prompts, bool),
    )
    ids = jnp.asarray(rng.integers(0, size.vocab_size, (prompts, prefix)), jnp.int32)
    return GRPOBatch(features=features, ids=ids, mask=jnp.ones((prompts, prefix), bool), target=target)


def init_decoder(fns: PolicyFns, batch: GRPOBatch) -> Params:
    """N(0, .02²) weights and unit scales, drawn in NumPy: compiling an initialiser would add to the memory."""
    one = jax.tree.map(lambda x: x[0], batch)

    def forward(module: Policy) -> jax.Array:
        first, prefix = module.prefill_state(one.features, one.ids, one.mask, fns.slots)
        return module.logits(module.completion_states(one.ids, first, prefix), jnp.asarray(fns.banned))

    shapes = jax.eval_shape(lambda: fns.module.init(jax.random.key(0), method=forward))["params"]
    rng = np.random.default_rng(0)

    def draw(path: tuple, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        kind = path[-1].key
        value = np.ones(leaf.shape) if kind == "scale" else rng.normal(0, 0.02, leaf.shape) * (kind != "bias")
        return jnp.asarray(value, leaf.dtype)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def low_ids(vocab_size: int, *, host: bool) -> ScoreFn:
    """Share of token ids in the lower half of the vocabulary; on the host to measure the cost of leaving the device."""
    if host:  # the text has one character for each token
        low = lambda text, parsed, target: sum(ord(c) < vocab_size // 2 for c in text) / len(text)
        return make_score(parsed_without_tags, {"low": HostReward(low)}, {"low": 1.0}, lambda t: "".join(map(chr, t)))

    def score(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
        del target
        return jnp.mean(tokens < vocab_size // 2), {}, parsed_without_tags(tokens)

    return score


def parsed_without_tags(tokens: jax.Array) -> Parsed:
    """The parsed form of a text without tags."""
    none = jnp.full(1, -1)
    return Parsed(
        perceive=none[None],
        compare=none,
        conclude=none,
        formatted=jnp.array(False),
        truncated=jnp.array(True),
        length=jnp.int32(tokens.shape[0]),
    )
