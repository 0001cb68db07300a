"""What latents hold, told by linear probes and by their rank, and the alarms of stage 1.

A probe is multinomial logistic regression on frozen features (`evidence.probe_log_probs`), fitted on some objects and
read on others; the same probe on an encoder that was never trained says what training brought.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.masked import AnyArray
from touchr1_jax.rl.alarms import Alarm
from touchr1_jax.training.dynamics import FLAT
from touchr1_jax.training.evidence import ProbeConfig, probe_log_probs

ORDINAL_LEVELS = 3


def contact_features(latent: Float[AnyArray, "P S T N D"], exists: Bool[AnyArray, "P S T"]) -> Float[Array, "P S*N*D"]:
    """What a linear probe reads of a contact: each stream's tokens, mean over its steps; zeros for an absent stream."""
    mean = masked.mean(latent, exists[..., None, None], 2)
    return mean.reshape(len(mean), -1)


def probe_right(
    features: Float[np.ndarray, "n D"],
    label: Int[np.ndarray, "n A"],
    train: Bool[np.ndarray, "n"],
    config: ProbeConfig,
) -> Bool[np.ndarray, "test A"]:
    """Whether the probe of each ordinal attribute is right about each contact that it was not fitted on.

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


BOUNDS: Mapping[str, tuple[float, bool, str]] = {
    "flat_share": (0.5, False, f"most dimensions vary by less than {FLAT} between contacts"),
    "rank_share": (0.1, True, "effective rank below a tenth of the width"),
    "skill": (0.0, True, "prediction no better than copying the last latent"),
    "probe_lead": (0.0, True, "linear probe no better than on a random encoder"),
}
"""Metric → bound, whether it fires at or below the bound instead of above, meaning."""


def collapse_alarms(metrics: Mapping[str, float]) -> list[Alarm]:
    """F11: signs that latent prediction has collapsed, among the metrics that were measured.

    Args:
      metrics: any of the names of `BOUNDS`; others are ignored.
    """
    return [
        Alarm(code="F11", meaning=meaning, value=metrics[name], bound=bound)
        for name, (bound, below, meaning) in BOUNDS.items()
        if name in metrics and (metrics[name] <= bound if below else metrics[name] > bound)
    ]
