"""The terms of the objective, per token of one rollout; the step sums and averages them."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from touchr1_jax.rl.kl import LOG_RATIO_CLAMP, exact_kl


def clipped_surrogate(
    log_prob: Float[Array, "T"], old: Float[Array, "T"], advantage: Float[Array, ""], low: float, high: float
) -> tuple[Float[Array, "T"], Bool[Array, "T"]]:
    """Clipped policy-gradient objective, min(ρ_t A, clip(ρ_t, 1 − low, 1 + high) A) with ρ_t = π/π_old.

    Args:
      log_prob: learner's log-probabilities of the sampled tokens.
      old: sampler's.
      advantage: one number for the whole rollout.
      low: clip range below 1.
      high: clip range above 1.

    Returns:
      The objective of each token, to be maximised, and where the clip cut its gradient off.

    Source: PPO (arXiv 1707.06347, eq. 7) with GRPO's per-rollout advantage.
    """
    ratio = jnp.exp(jnp.clip(log_prob - old, -LOG_RATIO_CLAMP, LOG_RATIO_CLAMP))
    free, bound = ratio * advantage, jnp.clip(ratio, 1.0 - low, 1.0 + high) * advantage
    return jnp.minimum(free, bound), free > bound


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


def token_log_probs(log_p: Float[Array, "*n V"], tokens: Array) -> Float[Array, "*n"]:
    """Log-probability of each given token."""
    return jnp.take_along_axis(log_p, tokens[..., None], -1)[..., 0]


def entropy(log_p: Float[Array, "*n V"]) -> Float[Array, "*n"]:
    """Shannon entropy of each distribution, nat."""
    return -jnp.sum(jnp.exp(log_p) * log_p, -1)
