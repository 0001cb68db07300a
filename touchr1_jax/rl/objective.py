"""The objective of one GRPO update and its gradient, prompt by prompt.

Per prompt the policy, the reference and the perturbed policy each encode their prefix once and score the whole group.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.agent import Agent
from touchr1_jax.models.policy import Features
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.kl import estimated_kl, exact_kl
from touchr1_jax.rl.losses import clipped_surrogate, entropy, grounding_kl, token_log_probs
from touchr1_jax.types import Params, Rollout, Target

PARTS = ("loss", "surrogate", "kl", "grounding", "entropy", "clip_share")


@struct.dataclass
class GRPOBatch:
    """P encoded contacts with a question each."""

    features: Features
    ids: Int[Array, "P L"]
    mask: Bool[Array, "P L"]
    target: Target


class Experience(NamedTuple):
    """What an update needs of each prompt; every field has a leading P."""

    batch: GRPOBatch
    masked_touch: Float[Array, "P S N D"]
    rollout: Rollout
    advantage: Float[Array, "P G"]
    weight: Float[Array, "P"]


def objective_gradient(
    agent: Agent, config: GRPOConfig, params: Params, reference: Params, experience: Experience
) -> tuple[Params, dict[str, Array]]:
    """Gradient of −J with respect to the parameters, and the mean of each of `PARTS`.

    Summed over micro-batches of `micro_prompts` prompts, whose working set stays in cache.
    """
    chunks = config.prompts // config.micro_prompts
    cut = lambda x: x.reshape(chunks, config.micro_prompts, *x.shape[1:])

    def loss(params: Params, chunk: Experience) -> tuple[Array, dict[str, Array]]:
        terms = jax.vmap(lambda e: prompt_terms(agent, config, params, reference, e))(chunk)
        gain = jnp.sum(chunk.weight * terms["surrogate"])
        gain += jnp.sum(config.gamma * terms["grounding"] - config.beta * terms["kl"]) / config.prompts
        return -gain, jax.tree.map(lambda x: jnp.sum(x) / config.prompts, terms) | {"loss": -gain}

    def body(carry, chunk: Experience):
        grads, parts = jax.grad(loss, has_aux=True)(params, chunk)
        return jax.tree.map(jnp.add, carry, (grads, parts)), None

    zero = (jax.tree.map(jnp.zeros_like, params), {name: jnp.zeros(()) for name in PARTS})
    return jax.lax.scan(body, zero, jax.tree.map(cut, experience))[0]


def prompt_terms(
    agent: Agent, config: GRPOConfig, params: Params, reference: Params, experience: Experience
) -> dict[str, Float[Array, ""]]:
    """Terms of one prompt, each a mean over rollouts of the mean over their tokens."""
    batch, rollout = experience.batch, experience.rollout
    scored = lambda p, f: jax.nn.log_softmax(agent.group_logits(p, f, batch.ids, batch.mask, rollout.tokens))
    log_p = scored(params, batch.features)
    log_prob = token_log_probs(log_p, rollout.tokens)
    log_ref = jax.lax.stop_gradient(scored(reference, batch.features))
    surrogate, clipped = jax.vmap(clipped_surrogate, in_axes=(0, 0, 0, None, None))(
        log_prob, rollout.log_prob, experience.advantage, config.clip_low, config.clip_high
    )
    per_token = {
        "surrogate": surrogate,
        "kl": reference_kl(config, log_p, log_ref, rollout.tokens),
        "grounding": perturbed_kl(config, scored, params, experience, log_p),
        "entropy": entropy(jax.lax.stop_gradient(log_p)),
        "clip_share": clipped.astype(jnp.float32),
    }
    mean = lambda x: jnp.mean(masked.mean(x, rollout.mask, axis=-1))
    return {name: mean(value) for name, value in per_token.items()}


def reference_kl(
    config: GRPOConfig, log_p: Float[Array, "G T V"], log_ref: Float[Array, "G T V"], tokens: Int[Array, "G T"]
) -> Float[Array, "G T"]:
    """KL to the reference policy at each token, by the configured estimator."""
    if config.kl == "exact":
        return exact_kl(log_p, log_ref)
    return estimated_kl(token_log_probs(log_p, tokens), token_log_probs(log_ref, tokens), config.kl)


def perturbed_kl(config: GRPOConfig, scored, params: Params, experience: Experience, log_p: Array) -> Array:
    """Tactile grounding at each token; skipped, not computed and multiplied by 0, when γ is 0."""
    if config.gamma == 0.0:
        return jnp.zeros(log_p.shape[:-1])
    features = dataclasses.replace(experience.batch.features, touch=experience.masked_touch)
    log_masked = scored(params, features)
    return grounding_kl(log_p, log_masked, stop_masked=config.grounding_stop_masked, cap=config.grounding_cap_nat)
