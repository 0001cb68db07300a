"""Updates of bounded size: the KL of each update is measured, and an update that is too long is shortened."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from touchr1_jax import masked
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.gradient import Experience, log_probs
from touchr1_jax.rl.losses import estimated_kl
from touchr1_jax.types import Params

NEAR = 1.5
"""Factor on δ up to which a KL is accepted; where KL is quadratic, one shortening ends at 1."""

MOST = 4
"""Largest number of measurements of an update; each is a forward pass over the rollouts."""


def within_trust(
    fns: PolicyFns, config: GRPOConfig, before: Params, after: Params, learn: Experience, delta: float
) -> tuple[Params, dict[str, Array]]:
    """Shorten an update until it changes the policy by at most about δ nat a token, on the rollouts of the update.

    θ = θ₀ + s (θ₁ − θ₀), starting at s = 1, with s ← s √(δ / KL(π₀ ‖ π_s)) while KL(π₀ ‖ π_s) > 1.5 δ, at most four
    times: KL is quadratic in a small step, so one shortening is enough for a step that is slightly too long, but not
    for a much longer one, where KL grows more slowly.  If the KL is not finite, s is halved; if it stays so,
    the update is left out, s = 0.  A short update is measured once.  The KL is the k3 estimate on the rollouts, with
    `learn.old` as log π₀.  This applies the scaling of the trust-region step (TRPO, arXiv 1502.05477, appendix C) to
    any optimizer, with this fixed point instead of a line search.

    Args:
      fns, config: as in `make_grpo_step`.
      before: parameters θ₀.
      after: parameters θ₁ that the optimizer proposes.
      learn: the rollouts, and the log-probabilities `old` from which the KL is measured.
      delta: δ; it bounds several updates from the same rollouts together, since the KL is measured from the policy
        before the first.

    Returns:
      The parameters θ; `update_kl`, the KL of the proposed update; and `update_scale`, s.
    """
    # by selection: 0 times what is not finite is not 0
    between = lambda scale: jax.tree.map(lambda a, b: jnp.where(scale > 0, a + scale * (b - a), a), before, after)
    mask, algorithm = learn.rollout.mask, config.algorithm

    def moved_by(scale: Float[Array, ""]) -> Float[Array, ""]:
        moved = log_probs(fns, config, between(scale), learn.batch, learn.rollout)
        by_rollout = masked.mean(estimated_kl(learn.old, moved, "k3"), mask, axis=-1)
        # without a reason to select, the plain mean: the selecting one rounds otherwise
        return masked.mean(by_rollout, jnp.any(mask, -1)) if algorithm.mask_truncated else jnp.mean(by_rollout)

    def too_long(carry: tuple[Array, Array, Array]) -> Array:
        _, kl, measured = carry
        return ~(kl <= NEAR * delta) & (measured < MOST)

    def shortened(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        scale, kl, measured = carry
        scale = scale * jnp.where(jnp.isfinite(kl), jnp.sqrt(delta / kl), 0.5)
        return scale, moved_by(scale), measured + 1

    whole = jnp.ones(())
    proposed = moved_by(whole)
    scale, kl, _ = jax.lax.while_loop(too_long, shortened, (whole, proposed, jnp.ones((), jnp.int32)))
    scale = jnp.where(jnp.isfinite(kl), scale, 0.0)
    return between(scale), {"update_kl": proposed, "update_scale": scale}
