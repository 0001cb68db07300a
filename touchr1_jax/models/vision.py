"""Vision tower: a small transformer over the object's picture, merged 2 × 2 into tokens for the language model."""

import dataclasses
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

from touchr1_jax.models.frame_statistics import view_statistics
from touchr1_jax.models.layers import RMSNorm, SizeError, check_heads, check_layers, check_sizes
from touchr1_jax.models.tactile_vit import EncoderLayer


@dataclasses.dataclass(frozen=True, kw_only=True)
class VisionConfig:
    """Shape of the vision tower; a 64 px view in 16 px patches gives 16 patches, merged to 4 tokens.

    Stem `statistics` reads fixed statistics of each square of 2 × 2 patches in the place of pixels: of few objects the
    pixels are memorised, and so are their levels.

    Raises:
      SizeError: a size below 1, heads that do not share the width, patches that do not fill the image in pairs.
    """

    image_px: int = 64
    patch_px: int = 16
    width: int = 64
    num_layers: int = 1
    num_heads: int = 2
    mlp_ratio: int = 2
    stem: Literal["pixels", "statistics"] = "pixels"

    def __post_init__(self) -> None:
        check_sizes(self, "image_px", "patch_px", "width", "num_heads", "mlp_ratio")
        check_layers(self, least=0)
        check_heads(self.width, self.num_heads)
        if self.image_px % (2 * self.patch_px):
            raise SizeError(
                f"image_px {self.image_px} must be a multiple of 2 · patch_px = {2 * self.patch_px}; change either"
            )

    @property
    def grid(self) -> int:
        """Tokens along one side after the merger."""
        return self.image_px // self.patch_px // 2

    def tower(self, out_width: int) -> nn.Module:
        """The module that makes tokens of `out_width` channels."""
        return VisionTower(self, out_width)


class VisionTower(nn.Module):
    """f(view) → grid² tokens of the language model's width, row by row."""

    config: VisionConfig
    out_width: int

    @nn.compact
    def __call__(self, view: UInt8[Array, "*n H W 3"]) -> Float[Array, "*n token D"]:
        c = self.config
        *lead, h, w, _ = view.shape
        if (h, w) != (c.image_px, c.image_px):
            raise ValueError(
                f"view is {h}×{w} px, the vision config says {c.image_px}²; resize it or change the config"
            )
        if c.stem == "statistics":
            x = nn.Dense(c.width, name="cell")(view_statistics(view, 2 * c.patch_px))
        else:
            x = nn.Dense(c.width, name="patch")(_merged_patches(view, c))
        x = x + self.param("position", nn.initializers.normal(0.02), (x.shape[-2], c.width))
        for i in range(c.num_layers):
            x = EncoderLayer(c.width, c.num_heads, c.mlp_ratio, name=f"layer_{i}")(x, jnp.ones(x.shape[:-1], bool))
        x = RMSNorm(name="norm")(x).reshape(*lead, c.grid**2, -1)
        x = nn.gelu(nn.Dense(4 * c.width, name="merge_in")(x))
        return nn.Dense(self.out_width, name="merge_out")(x)


def _merged_patches(view: UInt8[Array, "*n H W 3"], c: VisionConfig) -> Float[Array, "*n patch pixel"]:
    """Pixels of all patches from −1 to 1; the four that become one token follow each other."""
    *lead, _, _, _ = view.shape
    x = view.astype(jnp.float32) / 127.5 - 1.0
    # windows of 2 × 2 patches are the outer blocks, so that the merger is a reshape
    block = 2 * c.patch_px
    x = x.reshape(*lead, c.grid, block, c.grid, block, 3)
    x = jnp.moveaxis(x, -3, -4).reshape(*lead, c.grid**2, 2, c.patch_px, 2, c.patch_px, 3)
    return jnp.moveaxis(x, -3, -4).reshape(*lead, 4 * c.grid**2, -1)
