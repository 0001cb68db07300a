"""Numbers and lists of a configuration that can mean nothing, by those that all scales of its experiment have."""

import dataclasses
import types
from collections.abc import Collection, Iterator
from typing import Any, get_args, get_type_hints

INT32_MAX = 2**31 - 1  # of the whole numbers that arrays, seeds and sizes are made of

LEAST_FLOAT, MOST_FLOAT = 1e-30, 1e15
"""Numbers beyond them become 0 or infinite in the products of float32, in which everything is computed."""

LARGER = 1000
"""A setting that may be above `INT32_MAX`, such as bytes, is at most so many times that of a scale."""


def require_sizes(config: Any, scales: Collection[Any]) -> None:
    """Refuse what no scale has: numbers below 0 where none is, no steps, seeds or rounds where all have some, overflow.

    So are lists that are empty, or hold a value twice, where that of no scale is or does.

    What a class checks by itself is left to it, and a seed may be 0.

    Args:
      config: of a command.
      scales: configurations of the experiment, of the same class.

    Raises:
      ValueError: naming the field, its value and the bound.
    """
    usual = [_leaves(scale) for scale in scales]
    for path, (value, owner) in _leaves(config).items():
        others = [scale[path][0] for scale in usual if path in scale]
        numbers = [x for x in _several(value) if _is_number(x)]
        known = [x for other in others for x in _several(other) if _is_number(x)]
        least, most = min(known, default=None), max(INT32_MAX, LARGER * max(known, default=0))
        if any(isinstance(x, int) and x > most for x in numbers):
            raise ValueError(f"{path} is {value}: must be at most {most:.0f}; lower it")
        if any(abs(x) > MOST_FLOAT for x in numbers):
            raise ValueError(f"{path} is {value}: must be at most {MOST_FLOAT:g}; lower it")
        if any(0 < abs(x) < LEAST_FLOAT for x in numbers):
            raise ValueError(f"{path} is {value}: must be 0 or at least {LEAST_FLOAT:g}; raise it")
        if least is not None and least >= 0 and any(x < 0 for x in numbers):
            raise ValueError(f"{path} is {value}: must be at least 0; raise it")
        counts = least is not None and least >= 1 and not path.endswith("seeds" if isinstance(value, tuple) else "seed")
        if counts and any(isinstance(x, int) and x < 1 for x in numbers) and _is_unchecked(owner, path, value):
            raise ValueError(f"{path} is {value}: must be at least 1; raise it")
        if isinstance(value, tuple) and others:
            _require_list(owner, path, value, others)


def _require_list(owner: Any, path: str, value: tuple[Any, ...], others: Collection[tuple[Any, ...]]) -> None:
    """Refuse an empty list, and a value that is in it twice, unless its length is fixed or its class checks it."""
    field = path.rpartition(".")[2]
    if types.EllipsisType not in map(type, get_args(get_type_hints(type(owner))[field])):
        return
    if not value and all(others) and _takes(owner, field, next(iter(others)) * 2):
        raise ValueError(f"{path} is (): must not be empty; name at least one")
    if not any(map(_repeats, others)) and _repeats(value) and _takes(owner, field, tuple(dict.fromkeys(value))):
        raise ValueError(f"{path} is {value}: must hold each once; drop what is there twice")


def _repeats(value: tuple[Any, ...]) -> bool:
    return len({*value}) < len(value)


def _takes(owner: Any, field: str, value: Any) -> bool:
    """True if a class accepts a value of its field."""
    try:
        dataclasses.replace(owner, **{field: value})
    except (ValueError, TypeError):
        return False
    return True


def _leaves(config: Any, prefix: str = "") -> dict[str, tuple[Any, Any]]:
    """Dotted name → value and the dataclass that holds it."""
    found: dict[str, tuple[Any, Any]] = {}
    for field in dataclasses.fields(config):
        value, path = getattr(config, field.name), f"{prefix}{field.name}"
        found |= _leaves(value, f"{path}.") if dataclasses.is_dataclass(value) else {path: (value, config)}
    return found


def _several(value: Any) -> Iterator[Any]:
    yield from value if isinstance(value, tuple) else (value,)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_unchecked(owner: Any, path: str, value: Any) -> bool:
    """True if a class accepts −1, which is no count: then it does not check the field."""
    wrong: Any = (-1,) * len(value) if isinstance(value, tuple) else -1
    return _takes(owner, path.rpartition(".")[2], wrong)
