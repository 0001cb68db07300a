"""Divergences between next-token distributions, exact and estimated (Schulman, "Approximating KL divergence", 2020)."""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

KLEstimator = Literal["k1", "k2", "k3", "exact"]
LOG_RATIO_CLAMP = 20.0
"""Bound of a log-ratio before `exp`: e^20 is far past any meaning and far from float32 overflow."""


def exact_kl(log_p: Float[Array, "*n V"], log_q: Float[Array, "*n V"]) -> Float[Array, "*n"]:
    """KL(p ‖ q) = Σ_v p_v (log p_v − log q_v) over the whole vocabulary, from log-probabilities."""
    return jnp.sum(jnp.exp(log_p) * (log_p - log_q), -1)


def estimated_kl(
    log_p: Float[Array, "*n"], log_q: Float[Array, "*n"], estimator: Literal["k1", "k2", "k3"]
) -> Float[Array, "*n"]:
    """Per-token estimate of KL(p ‖ q) from the sampled token's log-probabilities, with r = q/p.

    k1 = −log r, k2 = (log r)²/2, k3 = r − 1 − log r.  Under samples of p and the gradient of the estimate itself,
    E[∇k1] = 0, E[∇k2] = ∇KL(p ‖ q) and E[∇k3] = ∇KL(q ‖ p) (arXiv 2510.01555): k3 as a loss pulls the other way round.
    """
    log_r = jnp.clip(log_q - log_p, -LOG_RATIO_CLAMP, LOG_RATIO_CLAMP)
    if estimator == "k1":
        return -log_r
    if estimator == "k2":
        return 0.5 * log_r**2
    return jnp.expm1(log_r) - log_r
