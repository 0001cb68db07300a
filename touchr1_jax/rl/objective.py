"""The objective of one GRPO update and its gradient, prompt by prompt.

Per prompt the policy and the reference each encode their prefix once and score the whole group; the perturbed policy
encodes only what follows the first perturbed token.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.agent import Agent
from touchr1_jax.models.lm import PrefixCache
from touchr1_jax.models.policy import Features
from touchr1_jax.rl.config import Algorithm, Average, GRPOConfig
from touchr1_jax.rl.kl import estimated_kl, exact_kl
from touchr1_jax.rl.losses import (
    entropy,
    entropy_bonus,
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

    `old` are the log-probabilities that ratios are taken to: the sampler's, or the learner's before the update.
    """

    batch: GRPOBatch
    masked_touch: Float[Array, "P S N D"]
    masked_stream: Int[Array, "P"]
    rollout: Rollout
    old: Float[Array, "P G T"]
    advantage: Float[Array, "P G"]
    weight: Float[Array, "P"]


class Scored(NamedTuple):
    """Log-probabilities of the vocabulary at each completion token, and the prefix that they stand on."""

    log_p: Float[Array, "G T V"]
    prefix: PrefixCache


def objective_gradient(
    agent: Agent, config: GRPOConfig, params: Params, reference: Params, experience: Experience
) -> tuple[Params, dict[str, Array]]:
    """Gradient of −J with respect to the parameters, and the mean of each of `PARTS` (of a peak the largest).

    Summed over micro-batches of `micro_prompts` prompts, whose working set stays in cache.
    """
    chunks = config.prompts // config.micro_prompts
    cut = lambda x: x.reshape(chunks, config.micro_prompts, *x.shape[1:])
    algorithm = config.algorithm

    def loss(params: Params, chunk: Experience) -> tuple[Array, dict[str, Array]]:
        terms = chunk_terms(agent, config, params, reference, chunk)
        gain = jnp.sum(chunk.weight * terms["surrogate"])
        extra = algorithm.gamma * terms["grounding"] - algorithm.beta * terms["kl"]
        bonus = jax.vmap(lambda h: entropy_bonus(h, algorithm))(terms["entropy"])
        gain += jnp.sum(extra + bonus) / config.prompts
        return -gain, terms | {"loss": jnp.broadcast_to(-gain, chunk.weight.shape)}

    def body(grads: Params, chunk: Experience):
        more, terms = jax.grad(loss, has_aux=True)(params, chunk)
        return jax.tree.map(jnp.add, grads, more), terms

    grads, terms = jax.lax.scan(body, jax.tree.map(jnp.zeros_like, params), jax.tree.map(cut, experience))
    parts = {name: _gathered(name, value) for name, value in terms.items()}
    return grads, parts | _grounding_by_stream(terms["grounding"].reshape(-1), experience)


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
    agent: Agent, config: GRPOConfig, params: Params, reference: Params, chunk: Experience
) -> dict[str, Float[Array, "micro"]]:
    """`prompt_terms` of every prompt of a micro-batch; a single prompt is not batched, so that its branches stay."""
    terms = lambda e: prompt_terms(agent, config, params, reference, e)
    if chunk.weight.shape[0] > 1:
        return jax.vmap(terms)(chunk)
    one = jax.tree.map(lambda x: x[0], chunk)
    return {name: value[None] for name, value in terms(one).items()}


def prompt_terms(
    agent: Agent, config: GRPOConfig, params: Params, reference: Params, experience: Experience
) -> dict[str, Float[Array, ""]]:
    """Terms of one prompt, each its configured mean over the tokens of the group; peaks are largest tokens."""
    batch, rollout, algorithm = experience.batch, experience.rollout, config.algorithm
    score = scorer(agent, config, batch, rollout.tokens)
    scored = score(params, batch.features)
    log_p, mask = scored.log_p, rollout.mask
    log_prob = token_log_probs(log_p, rollout.tokens)
    objective, clipped = jax.vmap(surrogate, in_axes=(None, 0, 0, 0, 0))(
        algorithm, log_prob, experience.old, mask, experience.advantage
    )
    if algorithm.importance_cap is not None:
        objective *= importance_weight(experience.old, rollout.log_prob, algorithm.importance_cap)
    kl = _kl_to_reference(algorithm, score, reference, experience, log_p)
    grounding = perturbed_kl(agent, config, params, experience, scored)
    mean = lambda kind, x: group_mean(kind, x, mask, config.length)
    per_rollout = lambda x: mean(Average.ROLLOUT, x)
    spread = entropy(log_p if algorithm.entropy_weight else jax.lax.stop_gradient(log_p))
    peak = lambda x: jnp.max(jnp.where(mask, jax.lax.stop_gradient(x), 0.0))
    return {
        "surrogate": mean(algorithm.average, objective),
        "kl": mean(algorithm.average, kl),
        "kl_peak": peak(kl),
        "grounding": per_rollout(grounding),
        "grounding_peak": peak(grounding),
        "entropy": per_rollout(spread),
        "clip_share": per_rollout(clipped.astype(jnp.float32)),
    }


def scorer(agent: Agent, config: GRPOConfig, batch: GRPOBatch, tokens: Int[Array, "G T"]) -> Callable[..., Scored]:
    """The function (params, features, known, start) → `Scored` of one prompt's completions, as configured."""

    def score(start: int, params: Params, features: Features, known: PrefixCache | None) -> Scored:
        p = at_precision(config, params)
        first, prefix = agent.prefill(p, features, batch.ids, batch.mask, known, start)
        return Scored(jax.nn.log_softmax(agent.completion_logits(p, tokens, first, prefix)), prefix)

    def configured(params: Params, features: Features, known: PrefixCache | None = None, start: int = 0) -> Scored:
        run: Callable[..., Scored] = functools.partial(score, start)
        if config.remat:
            run = jax.checkpoint(run, policy=jax.checkpoint_policies.dots_with_no_batch_dims_saveable)
        return run(params, features, known)

    return configured


def at_precision(config: GRPOConfig, params: Params) -> Params:
    """The parameters as the forward passes use them."""
    return jax.tree.map(lambda x: x.astype(jnp.bfloat16), params) if config.bfloat16 else params


def learner_log_probs(
    agent: Agent, config: GRPOConfig, params: Params, batch: GRPOBatch, tokens: Int[Array, "P G T"]
) -> Float[Array, "P G T"]:
    """Log-probabilities of sampled tokens under the learner, prompt by prompt."""

    def of_prompt(x: tuple[GRPOBatch, Array]) -> Array:
        scored = scorer(agent, config, *x)(params, x[0].features)
        return token_log_probs(scored.log_p, x[1])

    return jax.lax.map(of_prompt, (batch, tokens))


def _kl_to_reference(
    algorithm: Algorithm, score: Callable[..., Scored], reference: Params, experience: Experience, log_p: Array
) -> Float[Array, "G T"]:
    """KL to the reference at each token; the reference is not even run when β is 0."""
    if algorithm.beta == 0.0:
        return jnp.zeros(log_p.shape[:-1])
    log_ref = jax.lax.stop_gradient(score(reference, experience.batch.features).log_p)
    return reference_kl(algorithm, log_p, log_ref, experience.rollout.tokens)


def reference_kl(
    algorithm: Algorithm, log_p: Float[Array, "G T V"], log_ref: Float[Array, "G T V"], tokens: Int[Array, "G T"]
) -> Float[Array, "G T"]:
    """KL to the reference policy at each token, by the configured estimator."""
    if algorithm.kl == "exact":
        return exact_kl(log_p, log_ref)
    return estimated_kl(token_log_probs(log_p, tokens), token_log_probs(log_ref, tokens), algorithm.kl)


def perturbed_kl(
    agent: Agent, config: GRPOConfig, params: Params, experience: Experience, scored: Scored
) -> Float[Array, "G T"]:
    """Tactile grounding at each token; skipped, not computed and multiplied by 0, when γ is 0.

    Only what follows the perturbed stream's first token is encoded again: for a single prompt exactly that, for a
    batch of prompts, whose branches would all be computed, what follows the first stream's.
    """
    algorithm, batch = config.algorithm, experience.batch
    if algorithm.gamma == 0.0:
        return jnp.zeros(scored.log_p.shape[:-1])
    score = scorer(agent, config, batch, experience.rollout.tokens)
    features = dataclasses.replace(batch.features, touch=experience.masked_touch)
    fixed = jax.lax.stop_gradient if algorithm.grounding_stop_masked else lambda x: x
    prefix, own = fixed(scored.prefix), fixed(params)
    starts = [int(row.min()) for row in agent.slots.touch]

    def again(start: int, p: Params) -> Array:
        return score(p, features, prefix, start).log_p

    if config.micro_prompts == 1:
        branches = [functools.partial(again, start) for start in starts]
        log_masked = jax.lax.switch(experience.masked_stream, branches, own)
    else:
        log_masked = again(min(starts), own)
    return grounding_kl(
        scored.log_p, log_masked, stop_masked=algorithm.grounding_stop_masked, cap=algorithm.grounding_cap_nat
    )
