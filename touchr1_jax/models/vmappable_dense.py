"""A product with a weight matrix, y = x W, that stays one matrix product under `vmap` and in the gradient.

A vmapped `dot_general` keeps every batch axis apart, and its weight gradient contracts over several of them, for which
XLA first writes the wider operand out transposed: a quarter of a training step on CPU.  `linear` is a primitive whose
batching rule makes a batch axis one more axis of rows, and whose weight gradient, xᵀ g, contracts over all rows at
once.

    y = x W,    ∂L/∂x = g Wᵀ,    ∂L/∂W = Σ_rows xᵀ g

It is bilinear for JAX, so gradients of any order, per-example gradients (`vmap` of `grad`), `jit`, `scan` and
rematerialisation see it as they see `dot_general`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

from touchr1_jax.models.nf4 import Nf4


def linear(x: Float[Array, "*n i"], w: Float[Array, "i o"]) -> Float[Array, "*n o"]:
    """x W over all rows of x, in their common type.

    Raises:
      ValueError: shapes that do not fit.
    """
    if w.ndim != 2 or x.ndim < 1 or x.shape[-1] != w.shape[0]:
        raise ValueError(f"x is {x.shape} and w {w.shape}: must be [*n, i] and [i, o]; check the layer's width")
    kind = jnp.result_type(x, w)
    return linear_p.bind(x.astype(kind), w.astype(kind))


def _as_dot_general(x: Array, w: Array, dimensions: Any, precision: Any = None) -> Array:
    """`linear` as Flax asks for a product, always over the last axis of x and the first of w."""
    del dimensions, precision
    return linear(x, w)


CHEAP = 8
"""Outputs for each input above which a product is repeated: an MLP has at most six, an adapter's second factor more."""


def product_with_weights(primitive: Primitive, *shapes: Any, **_: Any) -> bool:
    """Policy of rematerialisation: the backward pass keeps results of `linear` and computes all else again.

    JAX's own policies know `dot_general` alone; what is no weight, such as the scores of attention, is not kept, nor
    is a product with few inputs and many outputs, which takes more memory than work.
    """
    if primitive is not linear_p:
        return False
    inputs, outputs = shapes[1].shape
    return outputs <= CHEAP * inputs


class Dense(nn.Dense):
    """Flax's dense layer, x W + b, by `linear`; a frozen W may be `Nf4`, which is decoded where it is used."""

    dot_general: Callable[..., Array] | None = _as_dot_general

    @nn.nowrap
    def param(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """A parameter, as Flax's layer asks for it."""
        stored: Any = self.get_variable("params", name)
        return stored.decode() if isinstance(stored, Nf4) else super().param(name, *args, **kwargs)


class Embed(nn.Embed):
    """Flax's table of embeddings, which computes logits by `linear`."""

    def attend(self, query: Float[Array, "*n D"]) -> Float[Array, "*n V"]:
        """Inner products with every row."""
        return linear(query, self.embedding.T)


def _dot(x: Array, w: Array) -> Array:
    return jax.lax.dot_general(x, w, (((x.ndim - 1,), (0,)), ((), ())))


def _rows(x: Array) -> Array:
    return x.reshape(-1, x.shape[-1])


def _for_input(g: Array, x: Any, w: Array) -> Array:
    del x
    return linear_p.bind(g, w.T)


def _for_weight(g: Array, x: Array, w: Any) -> Array:
    """xᵀ g, on CPU (gᵀ x)ᵀ where x is wider: XLA reads the narrow operand by columns twice as fast there.

    The barrier keeps XLA from turning the product back.
    """
    del w
    columns = lambda a, b: jax.lax.dot_general(_rows(a), _rows(b), (((0,), (0,)), ((), ())))
    if x.shape[-1] <= g.shape[-1] or jax.default_backend() != "cpu":
        return columns(x, g)
    return jax.lax.optimization_barrier(columns(g, x)).T


def _batched(operands: Sequence[Array], axes: Sequence[int | None]) -> tuple[Array, int]:
    (x, w), (x_axis, w_axis) = operands, axes
    if w_axis is None and x_axis is not None:
        return linear_p.bind(jnp.moveaxis(x, x_axis, 0), w), 0
    return jax.vmap(_dot, in_axes=(x_axis, w_axis))(x, w), 0


linear_p = Primitive("linear")
linear_p.def_impl(jax.jit(_dot))
linear_p.def_abstract_eval(lambda x, w: jax.core.ShapedArray((*x.shape[:-1], w.shape[1]), x.dtype))
ad.defbilinear(linear_p, _for_input, _for_weight)
batching.primitive_batchers[linear_p] = _batched
mlir.register_lowering(linear_p, mlir.lower_fun(_dot, multiple_results=False))
