"""Range checks for fields of a configuration; NaN is rejected."""

from typing import Any


def at_least(config: Any, bound: float, *fields: str) -> None:
    """Check that fields are ≥ a bound.

    Raises:
      ValueError: naming the field, its value and the bound.
    """
    for field in fields:
        value = getattr(config, field)
        if not value >= bound:
            raise ValueError(f"{field} is {value}: must be at least {bound}; raise it")


def above(config: Any, bound: float, *fields: str) -> None:
    """Check that fields are > a bound.

    Raises:
      ValueError: naming the field, its value and the bound.
    """
    for field in fields:
        value = getattr(config, field)
        if not value > bound:
            raise ValueError(f"{field} is {value}: must be above {bound}; raise it")


def within(config: Any, low: float, high: float, *fields: str) -> None:
    """Check that fields lie in [low, high].

    Raises:
      ValueError: naming the field, its value and the bounds.
    """
    for field in fields:
        value = getattr(config, field)
        if not low <= value <= high:
            raise ValueError(f"{field} is {value}: must lie in {low} … {high}; change it")
