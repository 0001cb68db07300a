"""Vision tower of Qwen3-VL: learned and rotary positions, full attention in each frame, mergers at several depths."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from touchr1_jax.models.layers import Rotation
from touchr1_jax.models.qwen.config import Qwen3VisionConfig
from touchr1_jax.models.qwen.geometry import Grid, Groups, stretched
from touchr1_jax.models.qwen.vision import attend_within, axial_rotation, check_patches, turned
from touchr1_jax.models.stacked import scan_layers


class Qwen3Vision(nn.Module):
    """f(patches) → one token per merged patch with its levels for the decoder (arXiv 2511.21631, §2).

    Parameters fix the precision: the patches are cast to the type of the first kernel.
    """

    config: Qwen3VisionConfig

    @nn.compact
    def __call__(self, patches: Float[Array, "n pixel"], grids: tuple[Grid, ...]) -> Float[Array, "token E"]:
        """Encode all pictures and videos together; no frame sees another.

        Args:
          patches: normalised pixels of each patch (channel, frame, row, column), merged square by merged square.
          grids: static; which patches are whose, in order.

        Returns:
          Embedding of each token, then what is added to it after each of the decoder's first layers.

        Raises:
          ValueError: patches that are not those of the grids, or as `geometry.stretched`.
        """
        c = self.config
        check_patches(patches, grids, c)
        place = stretched(grids, c)
        kernel = self.param("patch_embed", nn.initializers.lecun_normal(), (c.patch_size, c.hidden_size))
        bias = self.param("patch_bias", nn.initializers.zeros, (c.hidden_size,))
        table = self.param("patch_position", nn.initializers.normal(0.02), (c.positions, c.hidden_size))
        learned = jnp.einsum("cnd,cn->nd", table[place.corner], place.weight.astype(table.dtype))
        x = patches.astype(kernel.dtype) @ kernel + bias + learned
        rotation = axial_rotation(place.row, place.column, c.hidden_size // c.num_heads)
        again = nn.remat(lambda block, y: block(y, rotation, place.frames), prevent_cse=False)
        taps = jnp.array(c.deepstack_layers, jnp.int32)

        def each(block: FrameBlock, carry: tuple[Array, Array], i: Int[Array, ""]) -> tuple[tuple[Array, Array], None]:
            y, kept = carry
            y = again(block, y)
            return (y, jnp.where((taps == i)[:, None, None], y, kept)), None

        carry = x, jnp.zeros((c.levels, *x.shape), x.dtype)
        (x, kept), _ = scan_layers(each, c.depth)(FrameBlock(c, name="blocks"), carry, jnp.arange(c.depth))
        levels = [Merger(c, of_squares=True, name=f"deepstack_merger_list_{k}")(y) for k, y in enumerate(kept)]
        return jnp.concatenate([Merger(c, name="merger")(x), *levels], -1)


class FrameBlock(nn.Module):
    """Pre-norm transformer layer whose patches attend inside their frame."""

    config: Qwen3VisionConfig

    @nn.compact
    def __call__(self, x: Float[Array, "n D"], rotation: Rotation, frames: Groups) -> Float[Array, "n D"]:
        """All patches."""
        c = self.config
        qkv = nn.Dense(3 * c.hidden_size, name="qkv")(_norm("norm1")(x))
        x = x + nn.Dense(c.hidden_size, name="proj")(attend_within(*turned(qkv, c.num_heads, rotation), frames))
        return x + PlainMLP(c.intermediate_size, name="mlp")(_norm("norm2")(x))


class PlainMLP(nn.Module):
    """W₂ gelu(W₁ x), with biases, of the same width; gelu by tanh."""

    hidden: int

    @nn.compact
    def __call__(self, x: Float[Array, "n D"]) -> Float[Array, "n D"]:
        hidden = nn.gelu(nn.Dense(self.hidden, name="linear_fc1")(x), approximate=True)
        return nn.Dense(x.shape[-1], name="linear_fc2")(hidden)


class Merger(nn.Module):
    """Squares of patches as tokens of the decoder's width, normalised patch by patch, or as squares."""

    config: Qwen3VisionConfig
    of_squares: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "n D"]) -> Float[Array, "token E"]:
        c = self.config
        wide = c.merge**2 * c.hidden_size
        x = _norm("norm")(x.reshape(-1, wide) if self.of_squares else x).reshape(-1, wide)
        x = nn.gelu(nn.Dense(wide, name="linear_fc1")(x), approximate=False)
        return nn.Dense(c.out_size, name="linear_fc2")(x)


def _norm(name: str) -> nn.LayerNorm:
    return nn.LayerNorm(epsilon=1e-6, use_fast_variance=False, name=name)
