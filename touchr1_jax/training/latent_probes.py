"""Linear probes and effective rank of latents, and the alarms of stage 1.

A probe is multinomial logistic regression on frozen features (`linear_probe`), fitted on some objects and evaluated on
others; the same probe on an untrained encoder shows the effect of training.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.masked import AnyArray
from touchr1_jax.rl.alarms import Alarm
from touchr1_jax.training.dynamics import residuals
from touchr1_jax.training.linear_probe import ProbeConfig, probe_log_probs

ORDINAL_LEVELS = 3


def contact_features(latent: Float[AnyArray, "P S T N D"], exists: Bool[AnyArray, "P S T"]) -> Float[Array, "P S*N*D"]:
    """Input of a linear probe for a contact: each stream's tokens, mean over its steps; zeros for an absent stream."""
    mean = masked.mean(latent, exists[..., None, None], 2)
    return mean.reshape(len(mean), -1)


def probe_right(
    features: Float[np.ndarray, "n D"],
    label: Int[np.ndarray, "n A"],
    train: Bool[np.ndarray, "n"],
    config: ProbeConfig,
) -> Bool[np.ndarray, "test A"]:
    """Correctness of each ordinal attribute's probe on each contact outside its fit.

    Args:
      features: one row per contact.
      label: 0 … 2 of each attribute; −1 for unknown, which is neither fitted on nor ever right.
      train: contacts to fit on; the others are read, in their order.
      config: penalty and iterations.
    """
    right = []
    for column in label.T:
        weights = (train & (column >= 0))[None]
        found = probe_log_probs(features, column, weights, ORDINAL_LEVELS, config)[0]
        right.append((found.argmax(-1) == column)[~train])
    return np.stack(right, 1)


def rank_me(rows: Float[Array, "n D"]) -> Float[Array, ""]:
    """Effective rank, exp(−Σ p_k ln p_k) with p_k = σ_k/Σσ over the singular values of the centred rows.

    1 for rows on a line, D for a sphere.  Source: Garrido et al. 2023 (RankMe), eq. 2, which does not centre: a mean
    that all contacts share would hide their rank.
    """
    centred = rows - rows.mean(0)
    energy = jnp.maximum(jnp.linalg.eigvalsh(centred.T @ centred), 0.0)
    sigma = jnp.sqrt(energy)
    total = sigma.sum()
    share = sigma / jnp.where(total > 0, total, 1.0)
    return jnp.exp(-jnp.sum(jnp.where(share > 0, share * jnp.log(jnp.where(share > 0, share, 1.0)), 0.0)))


def told_apart(latent: Float[AnyArray, "P S T N D"], exists: Bool[AnyArray, "P S T"]) -> Float[Array, ""]:
    """Variation between contacts relative to the latents, √(Σ (z − z̄)² / Σ z²), z̄ of one sensor, step and token.

    A decoder that normalises its input can use only this share; the scale of the latents has no effect.
    """
    size = jnp.sum(jnp.where(exists[..., None, None], latent, 0.0) ** 2)
    return jnp.sqrt(jnp.sum(residuals(jnp.asarray(latent), jnp.asarray(exists)) ** 2) / size)


BOUNDS: Mapping[str, tuple[float, str]] = {
    "kept": (0.5, "contacts differ by less than half of what they did before training"),
    "rank_share": (0.1, "effective rank below a tenth of the width"),
    "skill": (0.0, "prediction no better than copying the last latent"),
    "probe_lead": (0.0, "linear probe no better than on a random encoder"),
}
"""Metric → bound at which or below which it fires, meaning.

`kept` is `told_apart` over what it was before training.  A bound on the spread itself, such as a share of dimensions
below .1, strikes also where latents are merely small.
"""


def collapse_alarms(before: Mapping[str, float], now: Mapping[str, float]) -> list[Alarm]:
    """F11: latent prediction has collapsed: two measurements in a row pass a bound, without recovery.

        m_{t−1} ≤ bound,   m_t ≤ bound,   m_t ≤ m_{t−1}

    In a healthy run, a moving target can be below its bound for some dozen steps before it rises again.  NaN, of
    latents that diverge or are all 0, passes every bound.

    Args:
      before: the previous measurement, of the trained encoder; names outside `BOUNDS` are ignored.
      now: the present measurement.
    """
    sound = lambda name, bound: now[name] > before[name] or before[name] > bound or now[name] > bound
    return [
        Alarm(code="F11", meaning=meaning, value=now[name], bound=bound)
        for name, (bound, meaning) in BOUNDS.items()
        if name in before and name in now and not sound(name, bound)
    ]
