"""Numbers that no command line means."""

import dataclasses
from typing import Any

PORTS = 65_535

MOST = 1e15
"""Beyond it no quantity of an option lies in its unit, and a time in seconds no clock can hold."""


def require_possible(value: Any, where: str = "") -> None:
    """Refuse numbers that are no quantity and ports that there are not, anywhere in a command's fields.

    Args:
      value: the command, or one of its fields.
      where: name of the field.

    Raises:
      ValueError: such a number.
    """
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            require_possible(getattr(value, field.name), field.name)
    elif isinstance(value, tuple):
        for each in value:
            require_possible(each, where)
    elif isinstance(value, float) and not abs(value) <= MOST:
        raise ValueError(f"{where} is {value}: must be a number within ±{MOST:g}; correct it")
    elif isinstance(value, int) and where.endswith("port") and not 0 <= value <= PORTS:
        raise ValueError(f"{where} is {value}: must lie in 0 … {PORTS}; correct it")
