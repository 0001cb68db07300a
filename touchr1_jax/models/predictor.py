"""Predictor of tactile dynamics: from the latents of some streams up to now to the latents of all streams next.

Every (stream, step) is one token of a small causal transformer.  The token of (s, t) holds the latent of that step
where the stream is shown, says when and how hard the next touch will be, and is turned into the latent of (s, t + 1).
"""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.layers import MASKED, RMSNorm
from touchr1_jax.models.tactile_vit import earlier_steps, force_features, sinusoid

TIME_WAVES = 32
"""Numbers that encode a frame index, as in the encoder."""

LN_FLOOR = 1e-6
"""Added to the variance of a latent under the root of its layer norm."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PredictorConfig:
    """Shape of the predictor, which knows the force of the next step, as a planner knows what it will do."""

    width: int = 96
    num_layers: int = 2
    num_heads: int = 3
    mlp_ratio: int = 2


class LatentPredictor(nn.Module):
    """P(z_≤t) = LN(z_t) + Δ(z_≤t) → ẑ_{t+1} of every stream at every step; LN(z_t) is 0 where it is not shown.

    A fresh predictor has Δ = 0 and copies the last latent: all that it learns is skill over copying.
    """

    config: PredictorConfig
    sensors: int

    @nn.compact
    def __call__(
        self,
        latent: Float[Array, "P S T N D"],
        shown: Bool[Array, "P S T"],
        next_index: Int[Array, "P S T"],
        next_force_n: Float[Array, "P S T 3"],
    ) -> Float[Array, "P S T N D"]:
        """Predict.

        Args:
          latent: of each step of each stream.
          shown: which of them may be looked at; the others are asked about all the same.
          next_index: frame index of the step after each.
          next_force_n: its force, newton; zero where it is unknown.
        """
        c = self.config
        p, s, t, n, d = latent.shape
        hidden = self.param("hidden", nn.initializers.normal(0.02), (c.width,))
        x = nn.Dense(c.width, name="latent")(latent.reshape(p, s, t, n * d))
        x = jnp.where(shown[..., None], x, hidden)
        x = x + nn.Embed(self.sensors, c.width, name="sensor")(jnp.arange(s))[:, None]
        x = x + nn.Dense(c.width, name="time")(sinusoid(next_index, TIME_WAVES))
        force = nn.gelu(nn.Dense(c.width, name="force_in")(force_features(next_force_n)))
        x = x + nn.Dense(c.width, name="force_out")(force)
        x = x.swapaxes(1, 2).reshape(p, t * s, c.width)  # step by step, as `earlier_steps` counts
        keys = shown.swapaxes(1, 2).reshape(p, t * s)
        for i in range(c.num_layers):
            x = PredictorLayer(c, name=f"layer_{i}")(x, keys, earlier_steps(t, s))
        x = nn.Dense(n * d, kernel_init=nn.initializers.zeros, name="out")(RMSNorm(name="norm")(x))
        last = jnp.where(shown[..., None, None], layer_norm(latent), 0.0)
        return last + x.reshape(p, t, s, n, d).swapaxes(1, 2)


class Head(nn.Module):
    """Two dense layers with a gelu between them, from latents to `out` numbers."""

    width: int
    out: int

    @nn.compact
    def __call__(self, x: Float[Array, "*n D"]) -> Float[Array, "*n out"]:
        return nn.Dense(self.out, name="out")(nn.gelu(nn.Dense(self.width, name="in")(x)))


def layer_norm(x: Float[Array, "*n D"]) -> Float[Array, "*n D"]:
    """(x − mean)/√(var + 1e-6) over the last axis, without scale and shift."""
    centred = x - x.mean(-1, keepdims=True)
    return centred * jax.lax.rsqrt(jnp.mean(centred**2, -1, keepdims=True) + LN_FLOOR)


class PredictorLayer(nn.Module):
    """Pre-norm transformer layer in which a token looks at itself and at the shown ones that its order allows."""

    config: PredictorConfig

    @nn.compact
    def __call__(
        self, x: Float[Array, "P N D"], shown: Bool[Array, "P N"], order: Bool[np.ndarray, "N N"]
    ) -> Float[Array, "P N D"]:
        c, n = self.config, x.shape[-2]
        head = c.width // c.num_heads
        qkv = nn.Dense(3 * c.width, name="qkv")(RMSNorm(name="norm_attention")(x))
        q, k, v = jnp.split(qkv.reshape(*qkv.shape[:-1], 3 * c.num_heads, head), 3, -2)
        allowed = shown[:, None, None, :] & order | jnp.eye(n, dtype=bool)
        scores = jnp.einsum("pqhd,pkhd->phqk", q, k) * head**-0.5
        weights = nn.softmax(jnp.where(allowed, scores, MASKED), -1)
        mixed = jnp.einsum("phqk,pkhd->pqhd", weights, v)
        x = x + nn.Dense(c.width, name="out")(mixed.reshape(x.shape))
        y = nn.gelu(nn.Dense(c.mlp_ratio * c.width, name="up")(RMSNorm(name="norm_mlp")(x)))
        return x + nn.Dense(c.width, name="down")(y)
