"""Vision tower of Qwen2.5-VL: patches of any pictures and videos, windowed attention, 2 × 2 merger."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from touchr1_jax.models.layers import GatedMLP, RMSNorm, Rotation, rotate
from touchr1_jax.models.qwen.config import ROPE_THETA, QwenVisionConfig, TowerConfig
from touchr1_jax.models.qwen.geometry import Geometry, Grid, Groups, geometry
from touchr1_jax.models.stacked import scan_layers


class QwenVision(nn.Module):
    """f(patches) → one token per merged patch, in the given order (arXiv 2502.13923, §2.1.1).

    Parameters fix the precision: the patches are cast to the type of the first kernel.
    """

    config: QwenVisionConfig

    @nn.compact
    def __call__(self, patches: Float[Array, "n pixel"], grids: tuple[Grid, ...]) -> Float[Array, "token D"]:
        """Encode all pictures and videos together; none sees another.

        Args:
          patches: normalised pixels of each patch (channel, frame, row, column), merged square by merged square.
          grids: static; which patches are whose, in order.

        Raises:
          ValueError: patches that are not those of the grids, or as `geometry`.
        """
        c = self.config
        check_patches(patches, grids, c)
        place = geometry(grids, c)
        kernel = self.param("patch_embed", nn.initializers.lecun_normal(), (c.patch_size, c.hidden_size))
        x = patches[place.order].astype(kernel.dtype) @ kernel
        rotation = axial_rotation(place.row, place.column, c.hidden_size // c.num_heads)
        whole_frames = jnp.isin(jnp.arange(c.depth), jnp.array(c.full_layers, jnp.int32))
        again = nn.remat(lambda block, y, whole: block(y, rotation, place, whole), prevent_cse=False)
        x, _ = scan_layers(lambda *args: (again(*args), None), c.depth)(VisionBlock(c, name="blocks"), x, whole_frames)
        x = RMSNorm(name="merger_norm")(x).reshape(-1, c.merge**2 * c.hidden_size)
        x = nn.gelu(nn.Dense(x.shape[-1], name="merger_in")(x), approximate=False)
        return nn.Dense(c.out_size, name="merger_out")(x)[place.token_order]


class VisionBlock(nn.Module):
    """Pre-norm transformer layer whose patches attend inside their group."""

    config: QwenVisionConfig

    @nn.compact
    def __call__(
        self, x: Float[Array, "n D"], rotation: Rotation, place: Geometry, whole: Bool[Array, ""]
    ) -> Float[Array, "n D"]:
        """All patches; inside the whole frame or inside windows."""
        c = self.config
        qkv = nn.Dense(3 * c.hidden_size, name="qkv")(RMSNorm(name="norm1")(x))
        over = lambda groups: lambda q, k, v: attend_within(q, k, v, groups)
        mixed = jax.lax.cond(whole, over(place.frames), over(place.windows), *turned(qkv, c.num_heads, rotation))
        x = x + nn.Dense(c.hidden_size, name="proj")(mixed)
        return x + GatedMLP(c.intermediate_size, use_bias=True, name="mlp")(RMSNorm(name="norm2")(x))


def check_patches(patches: Array, grids: tuple[Grid, ...], config: TowerConfig) -> None:
    """Refuse patches that are not those of the grids.

    Raises:
      ValueError: naming both shapes.
    """
    expected = (sum(g.patches for g in grids), config.patch_size)
    if patches.shape != expected:
        raise ValueError(f"patches are {patches.shape}, grids {tuple(map(tuple, grids))} have {expected}; match them")


def turned(
    qkv: Float[Array, "n width"], heads: int, rotation: Rotation
) -> tuple[Float[Array, "n H d"], Float[Array, "n H d"], Float[Array, "n H d"]]:
    """Queries and keys after their rotation, and values; angles are never rounded to bfloat16."""
    q, k, v = jnp.split(qkv.reshape(len(qkv), 3 * heads, -1), 3, 1)
    turn = lambda y: rotate(y.astype(jnp.float32), rotation).astype(y.dtype)
    return turn(q), turn(k), v


def attend_within(
    q: Float[Array, "n H d"], k: Float[Array, "n H d"], v: Float[Array, "n H d"], groups: Groups
) -> Float[Array, "n H*d"]:
    """Full attention inside each group, softmax(q kᵀ/√d) v, softmax in float32; the groups are one batch."""
    shape = (*groups.patch.shape, *q.shape[1:])
    gather = lambda y: y.reshape(shape) if groups.even else y[groups.patch]
    length = None if groups.even else jnp.asarray(groups.length, jnp.int32)
    mixed = jax.nn.dot_product_attention(gather(q), gather(k), gather(v), key_value_seq_lengths=length)
    flat = mixed.reshape(-1, q.shape[1] * q.shape[2])
    return flat if groups.even else flat[groups.back]


def axial_rotation(row: np.ndarray, column: np.ndarray, head_dim: int) -> Rotation:
    """Rotary angles of each patch: the first half of a head's frequencies turn by row, the other by column.

    Frequency j of an axis is θ^(−4j/d), j < d/4 (Qwen2-VL, arXiv 2409.12191, §2.1).
    """
    frequency = ROPE_THETA ** (-np.arange(0, head_dim, 4, dtype=np.float64) / head_dim)
    angle = np.concatenate([row[:, None] * frequency, column[:, None] * frequency], -1)
    return Rotation(jnp.asarray(np.cos(angle), jnp.float32), jnp.asarray(np.sin(angle), jnp.float32))
