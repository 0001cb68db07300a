"""Frame decoder: the picture that a tactile sensor will see, from the last one and what the encoder knows.

A frame is worked on in cells of a few pixels.  Three answers are added: the last frame; a share, cell by cell, of its
change since the first one, which is what a growing contact asks for; and a correction.
"""

import dataclasses

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Real


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameDecoderConfig:
    """Pixels of a cell, channels, and 3 × 3 convolutions over the cells."""

    cell_px: int = 4
    width: int = 48
    num_layers: int = 2


class FrameDecoder(nn.Module):
    """x̂ = x_t + a ⊙ (x_t − x_0) + Δ; a fresh decoder answers x_t."""

    config: FrameDecoderConfig

    @nn.compact
    def __call__(
        self,
        last: Float[Array, "n H W 3"],
        first: Float[Array, "n H W 3"],
        patches: Float[Array, "n patch D"],
        condition: Float[Array, "n E"],
    ) -> Float[Array, "n H W 3"]:
        """Decode.

        Args:
          last, first: frames with pixels in [0, 1].
          patches: what the encoder says of each patch of the last step, row by row of a grid of the frame's shape.
          condition: what else is known, such as how far ahead to look.

        Raises:
          ValueError: the cells do not fill the frame, or the patches no grid over it.
        """
        c = self.config
        n, h, w, _ = last.shape
        rows = round((patches.shape[1] * h / w) ** 0.5)
        columns = patches.shape[1] // max(rows, 1)
        if rows * columns != patches.shape[1] or h % (c.cell_px * rows) or w % (c.cell_px * columns):
            raise ValueError(
                f"frames of {h}×{w} px, {patches.shape[1]} patches: cells of {c.cell_px} px must fill every patch; "
                "change cell_px or the encoder's patches"
            )
        seen = to_cells(jnp.concatenate([2 * last - 1, 4 * (last - first)], -1), c.cell_px)
        x = nn.Dense(c.width, name="pixels")(seen)
        known = nn.Dense(c.width, name="patches")(patches).reshape(n, rows, columns, c.width)
        known = jnp.repeat(jnp.repeat(known, x.shape[1] // rows, 1), x.shape[2] // columns, 2)
        x = nn.gelu(x + known + nn.Dense(c.width, name="condition")(condition)[:, None, None])
        for i in range(c.num_layers):
            x = x + nn.gelu(nn.Conv(c.width, (3, 3), name=f"conv_{i}")(x))
        out = nn.Dense(3 * c.cell_px**2 + 1, kernel_init=nn.initializers.zeros, name="out")(x)
        grown = jnp.repeat(jnp.repeat(out[..., :1], c.cell_px, 1), c.cell_px, 2)
        return last + grown * (last - first) + from_cells(out[..., 1:], c.cell_px)


def to_cells(x: Real[Array, "n H W C"], cell_px: int) -> Real[Array, "n h w c"]:
    """Every square of `cell_px` pixels as the channels of one cell."""
    n, h, w, c = x.shape
    x = x.reshape(n, h // cell_px, cell_px, w // cell_px, cell_px, c)
    return x.swapaxes(2, 3).reshape(n, h // cell_px, w // cell_px, -1)


def from_cells(x: Real[Array, "n h w c"], cell_px: int) -> Real[Array, "n H W C"]:
    """The inverse of `to_cells`."""
    n, h, w, c = x.shape
    x = x.reshape(n, h, w, cell_px, cell_px, c // cell_px**2).swapaxes(2, 3)
    return x.reshape(n, h * cell_px, w * cell_px, -1)
