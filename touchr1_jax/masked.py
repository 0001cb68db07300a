"""Statistics over the selected elements of an array; all masked divisions are here, so that no epsilon is needed.

`mask` (boolean) broadcasts against `x`, and `axis` is as in NumPy.  Elements that are not selected have no influence,
even if they are NaN or infinite.  Gradients are finite: 0 where nothing is selected or nothing varies.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Shaped

AnyArray = Array | np.ndarray
Axis = int | tuple[int, ...] | None


def count(x: Shaped[AnyArray, "*n"], mask: Bool[AnyArray, "*m"], axis: Axis = None, *, keepdims: bool = False) -> Array:
    """Number of selected elements, float32."""
    selected = jnp.broadcast_to(mask, jnp.broadcast_shapes(x.shape, mask.shape))
    return jnp.sum(selected, axis=axis, keepdims=keepdims, dtype=jnp.float32)


def total(x: Shaped[AnyArray, "*n"], mask: Bool[AnyArray, "*m"], axis: Axis = None, *, keepdims: bool = False) -> Array:
    """Sum of the selected elements, Σ m x."""
    return jnp.sum(jnp.where(mask, x, 0), axis=axis, keepdims=keepdims)


def mean(x: Shaped[AnyArray, "*n"], mask: Bool[AnyArray, "*m"], axis: Axis = None, *, keepdims: bool = False) -> Array:
    """Mean of the selected elements, Σ m x / max(Σ m, 1): 0 where none is selected."""
    size = count(x, mask, axis, keepdims=keepdims)
    return total(x, mask, axis, keepdims=keepdims) / jnp.maximum(size, 1)


def mean_of_means(x: Shaped[AnyArray, "*n G T"], mask: Bool[AnyArray, "*n G T"]) -> Array:
    """Mean of the rows' means, of the rows of which an element is selected."""
    return mean(mean(x, mask, -1), jnp.any(mask, -1), -1)


def var(x: Shaped[AnyArray, "*n"], mask: Bool[AnyArray, "*m"], axis: Axis = None, *, keepdims: bool = False) -> Array:
    """Population variance of the selected elements, Σ m (x − mean)² / max(Σ m, 1)."""
    centred = jnp.where(mask, x, 0) - mean(x, mask, axis, keepdims=True)
    return mean(centred**2, mask, axis, keepdims=keepdims)


def std(x: Shaped[AnyArray, "*n"], mask: Bool[AnyArray, "*m"], axis: Axis = None, *, keepdims: bool = False) -> Array:
    """Standard deviation of the selected elements, √var, with gradient 0 where the variance is 0."""
    variance = var(x, mask, axis, keepdims=keepdims)
    varies = variance > 0
    return jnp.where(varies, jnp.sqrt(jnp.where(varies, variance, 1)), 0)


def maximum(x: Shaped[AnyArray, "*n"], mask: Bool[AnyArray, "*m"], axis: Axis = None, *, empty: float) -> Array:
    """Largest selected element; `empty` where none is selected."""
    return _extreme(jnp.max, -jnp.inf, x, mask, axis, empty)


def minimum(x: Shaped[AnyArray, "*n"], mask: Bool[AnyArray, "*m"], axis: Axis = None, *, empty: float) -> Array:
    """Smallest selected element; `empty` where none is selected."""
    return _extreme(jnp.min, jnp.inf, x, mask, axis, empty)


def _extreme(reduce, neutral: float, x: AnyArray, mask: AnyArray, axis: Axis, empty: float) -> Array:
    some = count(x, mask, axis) > 0
    return jnp.where(some, reduce(jnp.where(mask, x, neutral), axis=axis), empty)
