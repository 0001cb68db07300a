"""Completions of prompts: a group of samples or the greedy answer, from a shared prefix that is encoded once.

The loop body is one rollout's token step, vmapped over the group (prefix unbatched) and over the prompts (prefix
batched).  The loop itself is not vmapped: one scalar condition ends it when every rollout has ended; if whole steps are
batched by `vmap`, when those of all runs have ended.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.layers import TEMPERATURES
from touchr1_jax.models.lm import PrefixCache
from touchr1_jax.models.policy import Features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.stacked import layer_by_layer
from touchr1_jax.models.token_cache import CompletionCaches
from touchr1_jax.rl.losses import token_log_probs
from touchr1_jax.text.constraint import Constraint
from touchr1_jax.types import Params, Parsed, Rollout, Target
from touchr1_jax.validation import above, within


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
    answer: Int[Array, "P T"] | None = None
    """Verified answers, whose likelihood an anchor raises; `None` where there is no anchor."""
    answer_mask: Bool[Array, "P T"] | None = None
    rollout: Rollout | None = None
    """Completions that another program drew, [P, G, T], padding after their ends; `None` lets the step draw them."""


class EncodedPrompts(NamedTuple):
    """Encoded prompts, [P, …]: logits of the first token, and the keys and values that completions attend to."""

    first: Float[Array, "P V"]
    prefix: PrefixCache


@struct.dataclass
class GreedyAnswers:
    """The most likely completion of each prompt, token by token, and what the parser read in it."""

    tokens: Int[Array, "P T"]
    parsed: Parsed


DecodeFn = Callable[[Array, Array, PrefixCache, CompletionCaches], tuple[Array, CompletionCaches]]
"""(token [], t [], prefix, caches) → (logits [V] of token t + 1, caches), for one rollout."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SampleConfig:
    """Settings of the sampler: `group` completions per prompt of at most `length` tokens, greedy or at a temperature.

    `top_p` and `min_p` choose the tokens that may be drawn (see `nucleus`); `inverse` draws by the inverse distribution
    function, with one random number per rollout instead of V; `constraint` allows only tokens from which a formatted
    answer can still be finished in time.
    """

    group: int
    length: int
    end_ids: tuple[int, ...]
    pad_id: int
    greedy: bool = False
    temperature: float = 1.0
    top_p: float = 1.0
    min_p: float = 0.0
    inverse: bool = False
    constraint: Constraint | None = None

    def __post_init__(self) -> None:
        above(self, 0, "top_p")
        within(self, 0, 1, "top_p", "min_p")
        within(self, *TEMPERATURES, "temperature")
        if self.constraint is not None and self.length < self.constraint.shortest:
            least = f"must be at least {self.constraint.shortest}, the shortest formatted answer with its end"
            raise ValueError(f"length is {self.length}: {least}; raise it, or sample without constraint")


def encode_prompts(
    fns: PolicyFns, params: Params, batch: GRPOBatch, known: PrefixCache | None = None, start: int = 0
) -> EncodedPrompts:
    """Prefill each prompt once, or only what follows `start` if `known` holds the rest."""
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
    fns: PolicyFns, parser: Callable[[Int[Array, "T"]], Parsed], length: int, constraint: Constraint | None = None
) -> Callable[[Params, GRPOBatch], GreedyAnswers]:
    """Build the jitted (params, batch) → greedy answers of at most `length` tokens, under a constraint if any."""
    draw = SampleConfig(
        group=1, length=length, end_ids=fns.end_ids, pad_id=fns.pad_id, greedy=True, constraint=constraint
    )

    def answer(params: Params, batch: GRPOBatch) -> GreedyAnswers:
        tokens = sample_group(fns, params, batch, jax.random.key(0), draw).tokens[:, 0]
        return GreedyAnswers(tokens=tokens, parsed=jax.vmap(parser)(tokens))

    return jax.jit(answer, compiler_options=layer_by_layer(fns.cache_dtype))


class _Loop(NamedTuple):
    t: Int[Array, ""]
    logits: Float[Array, "P G V"]
    alive: Bool[Array, "P G"]
    caches: Any
    state: Int[Array, "P G"]
    tokens: Int[Array, "T P G"]
    log_prob: Float[Array, "T P G"]
    mask: Bool[Array, "T P G"]


def sample(
    decode: DecodeFn,
    first: Float[Array, "P V"],
    prefix: PrefixCache,
    empty: Any,
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
      constraint, log-probabilities are still those of the unconstrained policy, as in the learner.
    """
    return sample_with_caches(decode, first, prefix, empty, key, config)[0]


def sample_with_caches(
    decode: Callable[[Array, Array, Any, Any], tuple[Array, Any]],
    first: Float[Array, "P V"],
    prefix: Any,
    empty: Any,
    key: Array,
    config: SampleConfig,
) -> tuple[Rollout, Any]:
    """As `sample`, and the caches [P, G, …], any pytree, after the last token step."""
    p, g, t_max = first.shape[0], config.group, config.length
    step = jax.vmap(jax.vmap(decode, in_axes=(0, None, None, 0)), in_axes=(0, None, 0, 0))
    ends = jnp.asarray(config.end_ids)

    def body(loop: _Loop) -> _Loop:
        logits = tempered(loop.logits, config.temperature)
        token = draw_token(_allowed(logits, loop, config), jax.random.fold_in(key, loop.t), config)
        log_prob = drawn_log_probs(jax.nn.log_softmax(logits), token, config.top_p, config.min_p)
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
    end = jax.lax.while_loop(lambda s: (s.t < t_max) & any_alive(s.alive), body, start)
    by_rollout = lambda x: jnp.moveaxis(x, 0, -1)
    drawn = Rollout(tokens=by_rollout(end.tokens), log_prob=by_rollout(end.log_prob), mask=by_rollout(end.mask))
    return drawn, end.caches


@custom_vmap
def any_alive(alive: Bool[Array, "*runs P G"]) -> Bool[Array, ""]:
    """True while any rollout continues.

    Under `vmap`, one condition serves all runs, because a condition per run would batch the token index and every write
    to a cache.
    """
    return jnp.any(alive)


@any_alive.def_vmap
def any_alive_anywhere(size: int, batched: list[bool], alive: Array) -> tuple[Array, bool]:
    del size, batched
    return any_alive(alive), False


def _allowed(logits: Float[Array, "P G V"], loop: _Loop, config: SampleConfig) -> Float[Array, "P G V"]:
    """The logits, those of tokens that the constraint forbids at −∞."""
    if config.constraint is None:
        return logits
    return jnp.where(config.constraint.allowed(loop.state, config.length - loop.t), logits, -jnp.inf)


def tempered(logits: Float[Array, "*n V"], temperature: float) -> Float[Array, "*n V"]:
    """Logits at a temperature; at 1 as they are."""
    return logits if temperature == 1.0 else logits / temperature


def truncates(top_p: float, min_p: float) -> bool:
    """True if some tokens are never drawn."""
    return top_p < 1.0 or min_p > 0.0


def nucleus(log_p: Float[Array, "*n V"], top_p: float, min_p: float) -> Bool[Array, "*n V"]:
    """Tokens that may be drawn: the fewest most likely ones with total probability `top_p` (Holtzman et al., arXiv
    1904.09751), and of these all with at least `min_p` times the largest probability (arXiv 2407.01082).
    """
    p = jnp.exp(log_p)
    kept = p >= min_p * jnp.max(p, -1, keepdims=True)
    if top_p == 1.0:
        return kept
    falling = -jnp.sort(-p, axis=-1)
    before = jnp.cumsum(falling, -1) - falling
    least = jnp.min(jnp.where(before < top_p, falling, jnp.inf), -1, keepdims=True)
    return kept & (p >= least)


def drawn_log_probs(
    log_p: Float[Array, "*n V"], tokens: Int[Array, "*n"], top_p: float, min_p: float
) -> Float[Array, "*n"]:
    """Log-probability of each drawn token among those that may be drawn, for the sampler and for the learner.

    The learner computes its own nucleus, without gradient, and adds the drawn token; on policy it equals the sampler's.
    """
    drawn = token_log_probs(log_p, tokens)
    if not truncates(top_p, min_p):
        return drawn
    kept = nucleus(jax.lax.stop_gradient(log_p), top_p, min_p) | (jnp.arange(log_p.shape[-1]) == tokens[..., None])
    return drawn - jax.nn.logsumexp(jnp.where(kept, log_p, -jnp.inf), -1)


def draw_token(logits: Float[Array, "P G V"], key: Array, config: SampleConfig) -> Int[Array, "P G"]:
    """The most likely token, or one drawn from the softmax of the logits, in the nucleus if there is one."""
    if truncates(config.top_p, config.min_p):
        logits = jnp.where(nucleus(jax.nn.log_softmax(logits), config.top_p, config.min_p), logits, -jnp.inf)
    if config.greedy:
        return jnp.argmax(logits, -1).astype(jnp.int32)
    if config.inverse:
        return inverse_draw(logits, jax.random.uniform(key, logits.shape[:-1]))
    return jnp.argmax(logits + jax.random.gumbel(key, logits.shape), -1).astype(jnp.int32)


def inverse_draw(logits: Float[Array, "*n V"], uniform: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """The first word whose cumulative probability exceeds u: word v with probability softmax(logits)_v.

    A word of weight 0 is never drawn.  Rounding alone would draw some: a compiled cumulative sum adds in an order of
    its own for each word, and so rises and falls by 1e-7 where nothing is added.
    """
    weight = jnp.exp(logits - jnp.max(logits, -1, keepdims=True))
    total = jnp.where(weight > 0, _running_sums(weight), 0.0)
    exceeds = total > uniform[..., None] * jnp.max(total, -1, keepdims=True)
    last = logits.shape[-1] - 1
    return jnp.min(jnp.where(exceeds, jnp.arange(last + 1, dtype=jnp.int32), last), -1)


_BLOCK = 32  # words summed by one product


def _running_sums(x: Float[Array, "*n V"]) -> Float[Array, "*n V"]:
    """Σ_{w ≤ v} x_w by products with a triangular matrix; XLA on CPU takes three times as long for `cumsum`."""
    *lead, v = x.shape
    blocks = jnp.pad(x, [(0, 0)] * len(lead) + [(0, -v % _BLOCK)]).reshape(*lead, -1, _BLOCK)
    within = jnp.matmul(blocks, jnp.triu(jnp.ones((_BLOCK, _BLOCK))), precision=jax.lax.Precision.HIGHEST)
    ends = jnp.cumsum(within[..., -1], -1)
    before = ends - within[..., -1]
    return (within + before[..., None]).reshape(*lead, -1)[..., :v]
