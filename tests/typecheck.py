"""The run-time type checker that `conftest` puts on the functions of `touchr1_jax`."""

from collections.abc import Callable
from typing import Any, get_args

import jaxtyping
from beartype import beartype
from jaxtyping import AbstractArray


def install(package: str) -> None:
    """Check the functions of a package that annotate shapes from its first import on, and leave the others as they are.

    The hook would wrap these too, and bind the arguments of each of their calls to check nothing.
    """
    whole = jaxtyping.jaxtyped

    def where_shapes_are(*, typechecker: Callable) -> Callable:
        spared = lambda fn: fn.__module__.split(".")[0] == package and not _wanted(fn)
        return lambda fn: fn if spared(fn) else whole(fn, typechecker=typechecker)

    jaxtyping.jaxtyped = where_shapes_are
    jaxtyping.install_import_hook(package, f"{functions.__module__}.{functions.__name__}")


def functions(fn: Callable) -> Callable:
    """Check arguments and results of a function that annotates shapes.

    Not the fields of pytrees: JAX fills those with specs, and the feeds with NumPy arrays.
    """
    return beartype(fn) if _wanted(fn) else fn


def _wanted(fn: Any) -> bool:
    """Whether this is a function that annotates shapes."""
    return not isinstance(fn, type) and fn.__name__ != "__init__" and any(map(_shaped, fn.__annotations__.values()))


def _shaped(hint: Any) -> bool:
    """Whether an array type with a shape occurs in a type hint."""
    return (isinstance(hint, type) and issubclass(hint, AbstractArray)) or any(map(_shaped, get_args(hint)))
