"""Checks of ranges and names for fields of a configuration; NaN is rejected."""

import math
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp


def at_least(config: Any, bound: float, *fields: str) -> None:
    """Check that fields are ≥ a bound, and finite.

    Raises:
      ValueError: naming the field, its value and the bound.
    """
    for field in fields:
        value = getattr(config, field)
        if value == math.inf:
            raise ValueError(f"{field} is {value}: must be finite; lower it")
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


def some_of(config: Any, field: str, known: Collection[Any]) -> None:
    """Check that a field holds some of what is known, each once.

    Raises:
      ValueError: naming the field, its value and what is known.
    """
    names = getattr(config, field)
    if not names or len({*names}) < len(names) or not {*names} <= {*known}:
        raise ValueError(f"{field} is {names}: must hold some of {', '.join(known)}, each once; correct it")


def unused(config: Any, where: str, **values: Any) -> None:
    """Check that fields that a stage does not read have the value that changes nothing.

    Args:
      config: of the stage.
      where: name of the field that holds it.
      values: field → that value.

    Raises:
      ValueError: naming the field, its value and the one that it must have.
    """
    for field, value in values.items():
        if (given := getattr(config, field)) != value:
            raise ValueError(
                f"{where}.{field} is {given}: must be {value}, for this stage does not read it; leave it out"
            )


def require_wide(params: Any) -> None:
    """Check that no trained parameter is rounded to fewer than 32 bits, which would swallow small updates.

    Args:
      params: arrays, or their shapes.

    Raises:
      ValueError: naming a parameter and its type.
    """
    for path, x in jax.tree_util.tree_leaves_with_path(params):
        if jnp.issubdtype(x.dtype, jnp.floating) and x.dtype.itemsize < 4:
            raise ValueError(
                f"params{jax.tree_util.keystr(path)} is {x.dtype}: must be float32 where it is trained, for its "
                "rounding swallows small updates; cast it, and set bfloat16 to compute in bfloat16, or train adapters"
            )


def by_name(kind: type) -> Any:
    """Annotation of a mapping that a command line gives as `NAME VALUE NAME VALUE`, each name once.

    Of a name that is given twice, tyro itself takes the last value without a word.

    Args:
      kind: of the values.
    """
    from tyro.constructors import PrimitiveConstructorSpec  # of command lines alone

    def read(words: list[str]) -> dict[str, Any]:
        names, values = words[::2], words[1::2]
        if len(names) > len(values):
            raise ValueError(f"{names[-1]} has no value: must be NAME VALUE, as often as needed; add it")
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"{twice[0]} is given twice: must have one value; leave one out")
        return {name: kind(value) for name, value in zip(names, values, strict=True)}

    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=f"[NAME {kind.__name__.upper()} …]",
        instance_from_str=read,
        is_instance=lambda found: isinstance(found, dict),
        str_from_instance=lambda found: [str(word) for pair in found.items() for word in pair],
    )
