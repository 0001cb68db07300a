"""All modules of this directory compile quickly."""

from tests.touchr1_jax.quick import compile_quickly

__all__ = ["compile_quickly"]
