"""The run-time type checker that `conftest` puts on the functions of `touchr1_jax`."""

from collections.abc import Callable
from typing import Any, get_args

from beartype import beartype
from jaxtyping import AbstractArray


def functions(fn: Callable) -> Callable:
    """Check arguments and results of a function that annotates shapes.

    Not the fields of pytrees: JAX fills those with specs, and the feeds with NumPy arrays.
    """
    wanted = fn.__name__ != "__init__" and any(map(_shaped, fn.__annotations__.values()))
    return beartype(fn) if wanted else fn


def _shaped(hint: Any) -> bool:
    """Whether an array type with a shape occurs in a type hint."""
    return (isinstance(hint, type) and issubclass(hint, AbstractArray)) or any(map(_shaped, get_args(hint)))
