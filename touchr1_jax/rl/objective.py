"""The objective of one GRPO update and its gradient, prompt by prompt.

Per prompt the policy and the reference each encode their prefix once and pass over the whole group; the perturbed
policy encodes only what follows the first perturbed token.  What is wanted of the vocabulary, a few numbers a token, is
computed from the hidden states of all of them in one place, `token_terms`, and in blocks where it is large.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.chunked_logits import Rows, by_blocks
from touchr1_jax.models.lm import PrefixCache
from touchr1_jax.models.policy import Features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.config import Algorithm, Average, GRPOConfig, left_out
from touchr1_jax.rl.kl import estimated_kl, exact_kl
from touchr1_jax.rl.losses import (
    entropy,
    entropy_bonus,
    grounding_bonus,
    grounding_kl,
    group_mean,
    importance_weight,
    surrogate,
    token_log_probs,
)
from touchr1_jax.types import Params, Rollout, Target

PARTS = ("loss", "surrogate", "kl", "kl_peak", "grounding", "grounding_peak", "entropy", "clip_share")


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


class Experience(NamedTuple):
    """What an update needs of each prompt; every field has a leading P.

    `old` are the log-probabilities that ratios are taken to: the sampler's, or, under an importance cap and after the
    first of several updates, the learner's before it.
    """

    batch: GRPOBatch
    masked_touch: Float[Array, "P S N D"]
    masked_stream: Int[Array, "P"]
    rollout: Rollout
    old: Float[Array, "P G T"]
    advantage: Float[Array, "P G"]
    weight: Float[Array, "P"]


class Scored(NamedTuple):
    """Hidden states that predict each completion token, and the prefix that they stand on."""

    states: Float[Array, "G T D"]
    prefix: PrefixCache


def objective_gradient(
    fns: PolicyFns,
    config: GRPOConfig,
    params: Params,
    reference: Params,
    experience: Experience,
    *,
    first: bool | Bool[Array, ""] = True,
) -> tuple[Params, dict[str, Array]]:
    """Gradient of −J with respect to the parameters, and the mean of each of `PARTS` (of a peak the largest).

    Summed over micro-batches of `micro_prompts` prompts, whose working set stays in cache.

    Args:
      fns, config: as in `make_grpo_step`.
      params: the learner.
      reference: the policy that the KL is taken to.
      experience: rollouts and what they are worth.
      first: whether `params` are those before any update from this experience; asked only under an importance cap,
        where the learner's own log-probabilities are then the old ones.  The parts hold them as `old`, [P, G, T].
    """
    algorithm = config.algorithm

    def loss(params: Params, chunk: Experience) -> tuple[Array, dict[str, Array]]:
        terms = chunk_terms(fns, config, params, reference, chunk, first)
        gain = jnp.sum(chunk.weight * terms["surrogate"])
        extra = grounding_bonus(terms["grounding"], algorithm) - algorithm.beta * terms["kl"]
        bonus = jax.vmap(lambda h: entropy_bonus(h, algorithm))(terms["entropy"])
        gain += jnp.sum(extra + bonus) / config.prompts
        return -gain, terms | {"loss": jnp.broadcast_to(-gain, chunk.weight.shape)}

    def body(grads: Params, chunk: Experience):
        more, terms = jax.grad(loss, has_aux=True)(params, chunk)
        return jax.tree.map(jnp.add, grads, more), terms

    grads, terms = jax.lax.scan(body, jax.tree.map(jnp.zeros_like, params), micro_batches(config, experience))
    parts = {name: _gathered(name, value) for name, value in terms.items() if name != "old"}
    if "old" in terms:
        parts["old"] = in_order(terms["old"])
    parts["kl_cost_peak"] = algorithm.beta * parts["kl_peak"]
    return grads, parts | _grounding_by_stream(in_order(terms["grounding"]), experience)


def micro_batches(config: GRPOConfig, tree: Any) -> Any:
    """Arrays [P, …] cut into [P / `micro_prompts`, `micro_prompts`, …], neighbours into different micro-batches.

    Where devices share the prompts, neighbours on each of them, every device so has its part of every micro-batch.
    """
    size = config.micro_prompts
    cut = lambda x: x.reshape(size, x.shape[0] // size, *x.shape[1:])  # not −1: a prompt without a view has 0 tokens
    return jax.tree.map(lambda x: cut(x).swapaxes(0, 1), tree)


def in_order(x: Array) -> Array:
    """An array [P, …] again from its micro-batches."""
    return x.swapaxes(0, 1).reshape(-1, *x.shape[2:])


def _grounding_by_stream(grounding: Float[Array, "P"], experience: Experience) -> dict[str, Array]:
    """G_tg of the prompts in which each stream was perturbed, and how many they were: none may be left out for good."""
    streams = experience.batch.features.stream_mask
    found = {}
    for s in range(streams.shape[1]):
        perturbed = (experience.masked_stream == s) & streams[:, s]
        found[f"grounding_stream_{s}"] = masked.mean(grounding, perturbed)
        found[f"perturbed_stream_{s}"] = jnp.sum(perturbed).astype(jnp.float32)
    return found


def _gathered(name: str, value: Float[Array, "chunk micro"]) -> Float[Array, ""]:
    """One number from the prompts of all chunks; each chunk's share of the loss stands at every prompt of it."""
    if name == "loss":
        return jnp.sum(value[:, 0])
    return jnp.max(value) if name.endswith("_peak") else jnp.mean(value)


def chunk_terms(
    fns: PolicyFns,
    config: GRPOConfig,
    params: Params,
    reference: Params,
    chunk: Experience,
    first: bool | Bool[Array, ""] = True,
) -> dict[str, Array]:
    """`prompt_terms` of every prompt of a micro-batch; a single prompt is not batched, so that its branches stay."""
    terms = lambda e: prompt_terms(fns, config, params, reference, e, first)
    if chunk.weight.shape[0] > 1:
        return jax.vmap(terms)(chunk)
    one = jax.tree.map(lambda x: x[0], chunk)
    return {name: value[None] for name, value in terms(one).items()}


def prompt_terms(
    fns: PolicyFns,
    config: GRPOConfig,
    params: Params,
    reference: Params,
    experience: Experience,
    first: bool | Bool[Array, ""] = True,
) -> dict[str, Array]:
    """Terms of one prompt, each its configured mean over the tokens of the group; peaks are largest tokens.

    Under an importance cap also `old`, [G, T] (see `objective_gradient`).
    """
    rollout, algorithm = experience.rollout, config.algorithm
    mask = rollout.mask
    tokens = token_terms(fns, config, params, reference, experience)
    capped = algorithm.importance_cap is not None
    old = jnp.where(first, jax.lax.stop_gradient(tokens["log_prob"]), experience.old) if capped else experience.old
    objective, clipped = jax.vmap(surrogate, in_axes=(None, 0, 0, 0, 0))(
        algorithm, tokens["log_prob"], old, mask, experience.advantage
    )
    if algorithm.importance_cap is not None:
        objective *= importance_weight(old, rollout.log_prob, algorithm.importance_cap)
    mean = lambda kind, x: group_mean(kind, x, mask, config.length)
    per_rollout = lambda x: mean(Average.ROLLOUT, x)
    peak = lambda x: jnp.max(jnp.where(mask, jax.lax.stop_gradient(x), 0.0))
    return {
        "surrogate": mean(algorithm.average, objective),
        "kl": mean(algorithm.average, tokens["kl"]),
        "kl_peak": peak(tokens["kl"]),
        "grounding": per_rollout(tokens["grounding"]),
        "grounding_peak": peak(tokens["grounding"]),
        "entropy": per_rollout(tokens["entropy"]),
        "clip_share": per_rollout(clipped.astype(jnp.float32)),
        **({"old": old} if capped else {}),
    }


def token_terms(
    fns: PolicyFns, config: GRPOConfig, params: Params, reference: Params, experience: Experience
) -> dict[str, Float[Array, "G T"]]:
    """Of every token: its log-probability, KL to the reference, tactile grounding, entropy of its distribution.

    Logits exist nowhere else, and at most `max_logits` of each policy at once.  The reference is not run at β = 0, the
    perturbed policy not at γ = 0.
    """
    algorithm, shape = config.algorithm, experience.rollout.tokens.shape
    score = scorer(fns, config, experience.batch, experience.rollout.tokens)
    own = score(params, experience.batch.features)
    rows: Rows = {"own": own.states, "token": experience.rollout.tokens}
    if not left_out(algorithm.beta):
        rows["reference"] = jax.lax.stop_gradient(score(reference, experience.batch.features).states)
    if not left_out(algorithm.gamma):
        rows["perturbed"] = perturbed_states(fns, config, params, experience, own.prefix)
    terms = vocabulary_terms(fns, config, params, reference)
    rows = {name: x.reshape(-1, *x.shape[2:]) for name, x in rows.items()}
    found = by_blocks(terms, rows, width=len(fns.banned), most=config.max_logits)
    return {name: x.reshape(shape) for name, x in found.items()}


def vocabulary_terms(
    fns: PolicyFns, config: GRPOConfig, params: Params, reference: Params
) -> Callable[[Rows], dict[str, Float[Array, "n"]]]:
    """The function from hidden states [n, D] of the policies, and tokens [n], to `token_terms`, [n] each."""
    algorithm = config.algorithm
    heads = {"own": params, "reference": reference, "perturbed": _masked_branch(config, params)}
    heads = {name: at_precision(config, p) for name, p in heads.items()}

    def terms(rows: Rows) -> dict[str, Float[Array, "n"]]:
        log = {n: jax.nn.log_softmax(fns.logits(p, rows[n])) for n, p in heads.items() if n in rows}
        log_p, nothing = log["own"], jnp.zeros(rows["token"].shape)
        return {
            "log_prob": token_log_probs(log_p, rows["token"]),
            "kl": reference_kl(algorithm, log_p, log["reference"], rows["token"]) if "reference" in log else nothing,
            "grounding": _grounding(algorithm, log_p, log["perturbed"]) if "perturbed" in log else nothing,
            "entropy": entropy(jax.lax.stop_gradient(log_p) if left_out(algorithm.entropy_weight) else log_p),
        }

    return _remat(config, terms)


def scorer(fns: PolicyFns, config: GRPOConfig, batch: GRPOBatch, tokens: Int[Array, "G T"]) -> Callable[..., Scored]:
    """The function (params, features, known, start) → `Scored` of one prompt's completions, as configured."""

    if config.remat:
        fns = dataclasses.replace(fns, module=fns.module.clone(remat=True))

    def score(params: Params, features: Features, known: PrefixCache | None = None, start: int = 0) -> Scored:
        p = at_precision(config, params)
        return Scored(*fns.group_states(p, features, batch.ids, batch.mask, tokens, known, start))

    return score


def _remat(config: GRPOConfig, f: Callable[..., Any]) -> Callable[..., Any]:
    """f, of which the backward pass keeps only matrix products where the configuration says so."""
    if not config.remat:
        return f
    return jax.checkpoint(f, policy=jax.checkpoint_policies.dots_with_no_batch_dims_saveable)


def at_precision(config: GRPOConfig, params: Params) -> Params:
    """The parameters as the forward passes use them."""
    return jax.tree.map(lambda x: x.astype(jnp.bfloat16), params) if config.bfloat16 else params


def reference_kl(
    algorithm: Algorithm, log_p: Float[Array, "*n V"], log_ref: Float[Array, "*n V"], tokens: Int[Array, "*n"]
) -> Float[Array, "*n"]:
    """KL to the reference policy at each token, by the configured estimator."""
    if algorithm.kl == "exact":
        return exact_kl(log_p, log_ref)
    return estimated_kl(token_log_probs(log_p, tokens), token_log_probs(log_ref, tokens), algorithm.kl)


def perturbed_states(
    fns: PolicyFns, config: GRPOConfig, params: Params, experience: Experience, prefix: PrefixCache
) -> Float[Array, "G T D"]:
    """Hidden states of the completions under perturbed touch.

    Only what follows the perturbed stream's first token is encoded again: for a single prompt exactly that, for a
    batch of prompts, whose branches would all be computed, what follows the first stream's.

    Args:
      prefix: the prompt as the policy encodes it.
    """
    batch = experience.batch
    score = scorer(fns, config, batch, experience.rollout.tokens)
    features = dataclasses.replace(batch.features, touch=experience.masked_touch)
    known, own = _masked_branch(config, prefix), _masked_branch(config, params)
    starts = [int(row.min()) for row in fns.slots.touch]

    def again(start: int, p: Params) -> Array:
        return score(p, features, known, start).states

    if config.micro_prompts > 1:
        return again(min(starts), own)
    return jax.lax.switch(experience.masked_stream, [functools.partial(again, start) for start in starts], own)


def _masked_branch(config: GRPOConfig, tree: Any) -> Any:
    """What the perturbed branch reads, without gradient where the algorithm holds that branch fixed."""
    return jax.lax.stop_gradient(tree) if config.algorithm.grounding_stop_masked else tree


def _grounding(algorithm: Algorithm, log_p: Float[Array, "n V"], log_masked: Float[Array, "n V"]) -> Float[Array, "n"]:
    return grounding_kl(log_p, log_masked, stop_masked=algorithm.grounding_stop_masked, cap=algorithm.grounding_cap_nat)
