"""The made-up bench of the tests of the library."""

from tests.touchr1_jax.bench.questions.conftest import found, items, quota, source

__all__ = ["found", "items", "quota", "source"]
