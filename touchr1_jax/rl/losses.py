"""The terms of the objective, per token of one rollout; the objective averages them.

Every surrogate takes one rollout and is to be maximised; it returns also where its clip cut the gradient off.
"""

from typing import assert_never

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from touchr1_jax import masked
from touchr1_jax.rl.config import Algorithm, Average, Surrogate
from touchr1_jax.rl.kl import LOG_RATIO_CLAMP, exact_kl


def clipped_surrogate(
    log_prob: Float[Array, "T"], old: Float[Array, "T"], advantage: Float[Array, ""], low: float, high: float
) -> tuple[Float[Array, "T"], Bool[Array, "T"]]:
    """Clipped policy-gradient objective, min(ρ_t A, clip(ρ_t, 1 − low, 1 + high) A) with ρ_t = π/π_old.

    Args:
      log_prob: learner's log-probabilities of the sampled tokens.
      old: those of the policy that the ratio is taken to.
      advantage: one number for the whole rollout.
      low: clip range below 1.
      high: clip range above 1; DAPO (arXiv 2503.14476) sets it higher than `low`.

    Returns:
      The objective of each token, to be maximised, and where the clip cut its gradient off.

    Source: PPO (arXiv 1707.06347, eq. 7) with GRPO's per-rollout advantage.
    """
    return _clip(_ratio(log_prob - old), advantage, low, high)


def sequence_surrogate(
    log_prob: Float[Array, "T"],
    old: Float[Array, "T"],
    mask: Bool[Array, "T"],
    advantage: Float[Array, ""],
    low: float,
    high: float,
) -> tuple[Float[Array, "T"], Bool[Array, "T"]]:
    """The same with one ratio for all tokens, s = exp(1/|o| Σ_t log π_t/π_old,t), whose gradient all tokens share.

    Its mean over the tokens of a rollout is GSPO's objective (arXiv 2507.18071, eq. 5 and 7).

    Args:
      mask: which tokens exist; the others as in `clipped_surrogate`.
    """
    ratio = _ratio(masked.mean(log_prob - old, mask))
    return _clip(jnp.broadcast_to(ratio, log_prob.shape), advantage, low, high)


def cispo_surrogate(
    log_prob: Float[Array, "T"], old: Float[Array, "T"], advantage: Float[Array, ""], low: float, high: float
) -> tuple[Float[Array, "T"], Bool[Array, "T"]]:
    """Policy gradient with a clipped weight, sg(clip(ρ_t, 1 − low, 1 + high)) A log π_t.

    No token loses its gradient; the flags say where the weight was clipped.  Source: MiniMax-M1 (arXiv 2506.13585,
    eq. 4), which leaves the lower bound open: `low` = 1.
    """
    ratio = jax.lax.stop_gradient(_ratio(log_prob - old))
    weight = jnp.clip(ratio, 1.0 - low, 1.0 + high)
    return weight * advantage * log_prob, weight != ratio


def surrogate(
    algorithm: Algorithm,
    log_prob: Float[Array, "T"],
    old: Float[Array, "T"],
    mask: Bool[Array, "T"],
    advantage: Float[Array, ""],
) -> tuple[Float[Array, "T"], Bool[Array, "T"]]:
    """The configured surrogate of one rollout."""
    low, high = algorithm.clip_low, algorithm.clip_high
    match algorithm.surrogate:
        case Surrogate.TOKEN:
            return clipped_surrogate(log_prob, old, advantage, low, high)
        case Surrogate.SEQUENCE:
            return sequence_surrogate(log_prob, old, mask, advantage, low, high)
        case Surrogate.CISPO:
            return cispo_surrogate(log_prob, old, advantage, low, high)
        case _:
            assert_never(algorithm.surrogate)


def importance_weight(old: Float[Array, "*n"], sampler: Float[Array, "*n"], cap: float) -> Float[Array, "*n"]:
    """Truncated importance sampling, min(π_old/π_sampler, cap): corrects a sampler that rounds unlike the learner.

    Args:
      old: log-probabilities of the learner before the update.
      sampler: those that the tokens were drawn with.
      cap: largest weight; truncation trades a little bias for bounded variance (Ionides 2008).
    """
    return jnp.minimum(_ratio(old - sampler), cap)


def group_mean(kind: Average, x: Float[Array, "G T"], mask: Bool[Array, "G T"], longest: int) -> Float[Array, ""]:
    """One number for the tokens of a group.

    ROLLOUT: mean_i 1/|o_i| Σ_t x (GRPO).  TOKEN: Σ_i Σ_t x / Σ_i |o_i| (DAPO), so that long rollouts weigh more.
    LENGTH: mean_i 1/N Σ_t x with the longest length N that is allowed (Dr. GRPO), so that no length is favoured.

    Args:
      kind: which.
      x: value of each token.
      mask: which tokens exist.
      longest: N, which may exceed the T at hand.
    """
    match kind:
        case Average.ROLLOUT:
            return jnp.mean(masked.mean(x, mask, axis=-1))
        case Average.TOKEN:
            return masked.mean(x, mask)
        case Average.LENGTH:
            return jnp.mean(masked.total(x, mask, axis=-1)) / longest
        case _:
            assert_never(kind)


def grounding_kl(
    log_p: Float[Array, "*n V"], log_masked: Float[Array, "*n V"], *, stop_masked: bool, cap: float | None
) -> Float[Array, "*n"]:
    """Tactile grounding of each token, KL(π(· | touch) ‖ π(· | one stream made noise)), exact over the vocabulary.

    Args:
      log_p: log-probabilities under the true touch.
      log_masked: the same tokens under the perturbed touch.
      stop_masked: no gradient through the perturbed branch (a departure of the `stable` preset).
      cap: largest value a token may contribute, nat; `None` leaves it unbounded as in the paper.
    """
    kl = exact_kl(log_p, jax.lax.stop_gradient(log_masked) if stop_masked else log_masked)
    return kl if cap is None else jnp.minimum(kl, cap)


def grounding_bonus(mean_grounding: Float[Array, "*n"], algorithm: Algorithm) -> Float[Array, "*n"]:
    """min(γ G_tg, budget): what a prompt's grounding adds to the objective, and no gradient once that is the budget.

    Without a budget the term is linear, as published: at a large γ it pays more than any answer can earn.
    """
    linear = algorithm.gamma * mean_grounding
    return linear if algorithm.grounding_budget is None else jnp.minimum(linear, algorithm.grounding_budget)


def entropy_bonus(mean_entropy: Float[Array, ""], algorithm: Algorithm) -> Float[Array, ""]:
    """w · min(H, floor): pays for entropy as long as a prompt's mean entropy H lies below the floor, nat."""
    if algorithm.entropy_floor_nat is None:
        return algorithm.entropy_weight * mean_entropy
    return algorithm.entropy_weight * jnp.minimum(mean_entropy, algorithm.entropy_floor_nat)


def token_log_probs(log_p: Float[Array, "*n V"], tokens: Array) -> Float[Array, "*n"]:
    """Log-probability of each given token."""
    return jnp.take_along_axis(log_p, tokens[..., None], -1)[..., 0]


def entropy(log_p: Float[Array, "*n V"]) -> Float[Array, "*n"]:
    """Shannon entropy of each distribution, nat."""
    return -jnp.sum(jnp.exp(log_p) * log_p, -1)


def _ratio(log_ratio: Array) -> Array:
    return jnp.exp(jnp.clip(log_ratio, -LOG_RATIO_CLAMP, LOG_RATIO_CLAMP))


def _clip(ratio: Array, advantage: Array, low: float, high: float) -> tuple[Array, Array]:
    free, bound = ratio * advantage, jnp.clip(ratio, 1.0 - low, 1.0 + high) * advantage
    return jnp.minimum(free, bound), free > bound
