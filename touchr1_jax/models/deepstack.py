"""DeepStack: features of several layers of a vision tower, added to its tokens after the decoder's first layers.

    y_i = layer_i(x_i),   x_{i+1} = y_i + v_i   at the tokens of pictures, i < K

(Meng et al. 2024, arXiv 2406.04334; Qwen3-VL, arXiv 2511.21631).  A tower with K such levels gives each token (1 + K) D
numbers: its embedding, then v_0 … v_{K−1}.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

Levels = Float[Array, "level n D"] | None
"""What is added to n tokens after each of the first K layers, 0 for words; nothing in a model without DeepStack."""


def split_levels(seen: Float[Array, "n E"], width: int) -> tuple[Float[Array, "n D"], Levels]:
    """Embeddings of tokens and their levels, from what the tower gave."""
    first, *others = jnp.split(seen, seen.shape[-1] // width, -1)
    return first, jnp.stack(others) if others else None


def placed(levels: Levels, slots: Int[np.ndarray | Array, "n"], length: int) -> Float[Array, "level L D"] | None:
    """Levels of all tokens of a prompt, from those of its pictures' tokens, which stand in `slots`."""
    if levels is None:
        return None
    return jnp.zeros((levels.shape[0], length, levels.shape[2]), levels.dtype).at[:, slots].set(levels)


def add_level(y: Float[Array, "n D"], levels: Float[Array, "level n D"], i: Int[Array, ""]) -> Float[Array, "n D"]:
    """The tokens after layer i with their level, if there is one for it."""
    level = jax.lax.dynamic_index_in_dim(levels, jnp.minimum(i, len(levels) - 1), keepdims=False)
    return y + jnp.where(i < len(levels), level, 0).astype(y.dtype)
