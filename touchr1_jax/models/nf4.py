"""Frozen weights in four bits, 16 quantiles of a normal distribution (NF4), each block with the scale of its largest.

    W[i, o] ≈ s[⌊i/32⌋, o] · q[c[i, o]],   s = max |W| over the block,   c = argmin_k |W / s − q_k|

(QLoRA, Dettmers et al. 2023, arXiv 2305.14314, §3).  Departures: blocks are 32 inputs of one output in place of 64
consecutive weights, and scales have the type of the weights in place of 8 bits: 4.5 bits a weight in bfloat16, where
QLoRA has 4.13.
"""

from typing import NamedTuple

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from touchr1_jax.models.stacked import LAST, STACKED
from touchr1_jax.types import Params

BLOCK = 32
"""Weights that share a scale."""

QUANTILES = np.array(
    [-1.0, -0.6961928, -0.52507305, -0.39491749, -0.28444138, -0.18477343, -0.09105004, 0.0, 0.0795803, 0.1609302,
     0.2461123, 0.33791524, 0.44070983, 0.562617, 0.72295684, 1.0], np.float32,
)  # fmt: skip
"""q, as bitsandbytes has them: 0 is exact."""


class Nf4(NamedTuple):
    """A matrix, or a stack of them: two codes in each byte, the even input in its lower half."""

    codes: UInt8[Array, "*layer half out"]
    scale: Float[Array, "*layer block out"]

    @property
    def shape(self) -> tuple[int, ...]:
        """That of the matrix."""
        *stack, half, out = self.codes.shape
        return (*stack, 2 * half, out)

    @property
    def dtype(self) -> jnp.dtype:
        """That of the weights it was made of, and decodes to."""
        return self.scale.dtype

    def decode(self) -> Float[Array, "*layer inp out"]:
        """The matrix."""
        codes = jnp.stack([self.codes & 15, self.codes >> 4], -2).reshape(self.shape)
        scale = jnp.repeat(self.scale.astype(jnp.float32), BLOCK, axis=-2)[..., : self.shape[-2], :]
        return (jnp.asarray(QUANTILES)[codes] * scale).astype(self.dtype)


@jax.jit
def encode(w: Float[Array, "*layer inp out"]) -> Nf4:
    """The nearest codes of a matrix, or of a stack.

    Raises:
      ValueError: an odd number of inputs.
    """
    *stack, inputs, out = w.shape
    if inputs % 2:
        raise ValueError(
            f"w has {inputs} inputs: must have an even number, two share a byte; leave this layer as it is"
        )
    padding = [(0, 0)] * len(stack) + [(0, -inputs % BLOCK), (0, 0)]
    blocks = jnp.pad(w.astype(jnp.float32), padding).reshape(*stack, -1, BLOCK, out)
    scale = jnp.max(jnp.abs(blocks), -2).astype(w.dtype)
    unit = blocks / jnp.where(scale > 0, scale, 1).astype(jnp.float32)[..., None, :]
    nearest = jnp.searchsorted(jnp.asarray((QUANTILES[1:] + QUANTILES[:-1]) / 2), unit).astype(jnp.uint8)
    pairs = nearest.reshape(*stack, -1, out)[..., :inputs, :].reshape(*stack, inputs // 2, 2, out)
    return Nf4(pairs[..., 0, :] | pairs[..., 1, :] << 4, scale)


def in_four_bits(path: tuple[str, ...]) -> bool:
    """True for the kernels of the decoder's layers; its embedding, its head and the vision tower stay as they are."""
    return path[0] == "decoder" and path[-1] == "kernel" and bool({LAST, *STACKED}.intersection(path))


def quantised(params: Params) -> Params:
    """Parameters whose decoder has its layers' kernels in four bits; also of shapes, under `jax.eval_shape`."""
    flat = flax.traverse_util.flatten_dict(params)
    return flax.traverse_util.unflatten_dict({path: encode(x) if in_four_bits(path) else x for path, x in flat.items()})
