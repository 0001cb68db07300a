"""The run-time type checker that `conftest` puts on every function of `touchr1_jax`."""

from collections.abc import Callable

from beartype import beartype


def functions(fn: Callable) -> Callable:
    """Check arguments and results, but not the fields of pytrees: JAX itself fills those with specs, and feeds with NumPy."""
    return fn if fn.__name__ == "__init__" else beartype(fn)
