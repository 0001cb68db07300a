"""Completions of prompts: a group of samples of each, or the greedy answer, from a shared, once-encoded prefix.

The loop body is one rollout's token step, vmapped over the group (prefix unbatched) and over the prompts (prefix
batched).  The loop itself is not vmapped: one scalar condition ends it as soon as every rollout has ended, those of all
runs where whole steps are batched by `vmap`.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.lm import LayerCache, PrefixCache
from touchr1_jax.models.policy import Features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.text.constraint import Constraint
from touchr1_jax.types import Params, Parsed, Rollout, Target


@struct.dataclass
class GRPOBatch:
    """P encoded contacts with a question each.

    `ordered` marks questions whose answer depends on the order of frames; `None`: none does.
    """

    features: Features
    ids: Int[Array, "P L"]
    mask: Bool[Array, "P L"]
    target: Target
    ordered: Bool[Array, "P"] | None = None


class EncodedPrompts(NamedTuple):
    """Encoded prompts, [P, …]: logits of the first token, and the keys and values that completions attend to."""

    first: Float[Array, "P V"]
    prefix: PrefixCache


@struct.dataclass
class GreedyAnswers:
    """The most likely completion of each prompt, token by token, and what the parser read in it."""

    tokens: Int[Array, "P T"]
    parsed: Parsed


DecodeFn = Callable[[Array, Array, PrefixCache, tuple[LayerCache, ...]], tuple[Array, tuple[LayerCache, ...]]]
"""(token [], t [], prefix, caches) → (logits [V] of token t + 1, caches), for one rollout."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SampleConfig:
    """Settings of the sampler: `group` completions per prompt of at most `length` tokens, greedy or at temperature 1.

    `inverse` draws by the inverse distribution function, with one random number per rollout instead of V;
    `constraint` allows only tokens from which a formatted answer can still be finished in time.
    """

    group: int
    length: int
    end_ids: tuple[int, ...]
    pad_id: int
    greedy: bool = False
    inverse: bool = False
    constraint: Constraint | None = None


def encode_prompts(
    fns: PolicyFns, params: Params, batch: GRPOBatch, known: PrefixCache | None = None, start: int = 0
) -> EncodedPrompts:
    """Prefill each prompt once, or only what follows `start` where `known` holds the rest."""
    prefill = lambda f, i, m, k: fns.prefill(params, f, i, m, k, start)
    return EncodedPrompts(*jax.vmap(prefill)(batch.features, batch.ids, batch.mask, known))


def sample_prompts(fns: PolicyFns, params: Params, prompts: EncodedPrompts, key: Array, draw: SampleConfig) -> Rollout:
    """Draw the completions of encoded prompts."""
    decode = lambda token, t, past, caches: fns.decode(params, token, t, past, caches)
    return sample(decode, prompts.first, prompts.prefix, fns.empty_cache(draw.length), key, draw)


def sample_group(fns: PolicyFns, params: Params, batch: GRPOBatch, key: Array, draw: SampleConfig) -> Rollout:
    """Prefill each prompt once and draw its completions."""
    return sample_prompts(fns, params, encode_prompts(fns, params, batch), key, draw)


def make_answer(
    fns: PolicyFns, parser: Callable[[Int[Array, "T"]], Parsed], length: int
) -> Callable[[Params, GRPOBatch], GreedyAnswers]:
    """Build the jitted (params, batch) → greedy answers of at most `length` tokens."""
    draw = SampleConfig(group=1, length=length, end_ids=fns.end_ids, pad_id=fns.pad_id, greedy=True)

    @jax.jit
    def answer(params: Params, batch: GRPOBatch) -> GreedyAnswers:
        tokens = sample_group(fns, params, batch, jax.random.key(0), draw).tokens[:, 0]
        return GreedyAnswers(tokens=tokens, parsed=jax.vmap(parser)(tokens))

    return answer


class _Loop(NamedTuple):
    t: Int[Array, ""]
    logits: Float[Array, "P G V"]
    alive: Bool[Array, "P G"]
    caches: tuple[LayerCache, ...]
    state: Int[Array, "P G"]
    tokens: Int[Array, "T P G"]
    log_prob: Float[Array, "T P G"]
    mask: Bool[Array, "T P G"]


def sample(
    decode: DecodeFn,
    first: Float[Array, "P V"],
    prefix: PrefixCache,
    empty: tuple[LayerCache, ...],
    key: Array,
    config: SampleConfig,
) -> Rollout:
    """Draw `group` completions of each prompt, o_t ~ π(· | prefix, o_<t), stopping when all have ended.

    Args:
      decode: token step of one rollout.
      first: logits of the first token of each prompt.
      prefix: encoded prompts, batched over P.
      empty: caches of one completion.
      key: randomness; token t uses `fold_in(key, t)`.
      config: group size, lengths, end and padding ids.

    Returns:
      A `Rollout` [P, G, T]; after the end token ids are `pad_id`, log-probabilities 0 and the mask false.  Under a
      constraint the log-probabilities are still those of the unconstrained policy, which is what the learner scores.
    """
    p, g, t_max = first.shape[0], config.group, config.length
    step = jax.vmap(jax.vmap(decode, in_axes=(0, None, None, 0)), in_axes=(0, None, 0, 0))
    ends = jnp.asarray(config.end_ids)

    def body(loop: _Loop) -> _Loop:
        token = _draw(_allowed(loop, config), jax.random.fold_in(key, loop.t), config)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(loop.logits), token[..., None], -1)[..., 0]
        token = jnp.where(loop.alive, token, config.pad_id)
        logits, caches = step(token, loop.t, prefix, loop.caches)
        return _Loop(
            t=loop.t + 1,
            logits=logits,
            alive=loop.alive & ~jnp.isin(token, ends),
            caches=caches,
            state=loop.state if config.constraint is None else config.constraint.advance(loop.state, token),
            tokens=loop.tokens.at[loop.t].set(token),
            log_prob=loop.log_prob.at[loop.t].set(jnp.where(loop.alive, log_prob, 0.0)),
            mask=loop.mask.at[loop.t].set(loop.alive),
        )

    start = _Loop(
        t=jnp.zeros((), jnp.int32),
        logits=jnp.broadcast_to(first[:, None], (p, g, first.shape[-1])),
        alive=jnp.ones((p, g), bool),
        caches=jax.tree.map(lambda c: jnp.broadcast_to(c, (p, g, *c.shape)), empty),
        state=jnp.zeros((p, g), jnp.int32),
        tokens=jnp.full((t_max, p, g), config.pad_id, jnp.int32),
        log_prob=jnp.zeros((t_max, p, g)),
        mask=jnp.zeros((t_max, p, g), bool),
    )
    end = jax.lax.while_loop(lambda s: (s.t < t_max) & _any_alive(s.alive), body, start)
    by_rollout = lambda x: jnp.moveaxis(x, 0, -1)
    return Rollout(tokens=by_rollout(end.tokens), log_prob=by_rollout(end.log_prob), mask=by_rollout(end.mask))


@custom_vmap
def _any_alive(alive: Bool[Array, "*runs P G"]) -> Bool[Array, ""]:
    """True while any rollout continues.

    Under `vmap` one condition serves all runs: a condition per run would batch the token index too, and with it every
    write to a cache.
    """
    return jnp.any(alive)


@_any_alive.def_vmap
def _any_alive_anywhere(size: int, batched: list[bool], alive: Array) -> tuple[Array, bool]:
    del size, batched
    return _any_alive(alive), False


def _allowed(loop: _Loop, config: SampleConfig) -> Float[Array, "P G V"]:
    """The logits, those of tokens that the constraint forbids at −∞."""
    if config.constraint is None:
        return loop.logits
    return jnp.where(config.constraint.allowed(loop.state, config.length - loop.t), loop.logits, -jnp.inf)


def _draw(logits: Float[Array, "P G V"], key: Array, config: SampleConfig) -> Int[Array, "P G"]:
    """The most likely token, or one drawn from the softmax of the logits."""
    if config.greedy:
        return jnp.argmax(logits, -1).astype(jnp.int32)
    if config.inverse:
        return inverse_draw(logits, jax.random.uniform(key, logits.shape[:-1]))
    return jnp.argmax(logits + jax.random.gumbel(key, logits.shape), -1).astype(jnp.int32)


def inverse_draw(logits: Float[Array, "*n V"], uniform: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """Number of words whose cumulative probability does not exceed u: word v with probability softmax(logits)_v.

    The cumulative sum, not 1, is the scale of u, so that rounding never reaches past the last word of any weight.
    """
    weight = jnp.exp(logits - jnp.max(logits, -1, keepdims=True))
    total = jnp.cumsum(weight, -1)
    drawn = jnp.sum(total <= uniform[..., None] * total[..., -1:], -1)
    return drawn.astype(jnp.int32)
