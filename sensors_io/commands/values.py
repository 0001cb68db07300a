"""Numbers and files that no command line means."""

import dataclasses
import errno
import pathlib
from typing import Any

from sensors_io.errors import UserError, path_text
from sensors_io.remote import at_url

PORTS = 65_535

_WRITTEN = ("out", "html")  # options, also of `experiments`, that name what a command writes

MOST = 1e15
"""Beyond it no quantity of an option lies in its unit, and a time in seconds no clock can hold."""


def require_possible(value: Any, where: str = "") -> None:
    """Refuse numbers that are no quantity, times and seeds below 0, wrong ports, pipes and devices, in all fields.

    A pipe or a device is read without end, or not at all, and an output is renamed onto its path.  For an output at a
    URL a folder of that name would be made here.

    Args:
      value: the command, or one of its fields.
      where: name of the field.

    Raises:
      ValueError: such a number or path.
    """
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            require_possible(getattr(value, field.name), field.name)
        _require_other_output(value)
    elif isinstance(value, tuple):
        for each in value:
            require_possible(each, where)
    elif isinstance(value, pathlib.Path) and where in _WRITTEN and at_url(value):
        raise ValueError(f"{where} is {value}: must be a path on this machine; name one (`push` uploads records)")
    elif isinstance(value, pathlib.Path) and _in_circle(value):
        raise ValueError(f"{where} is {value}: its symbolic links lead in a circle; correct them, or name another path")
    elif isinstance(value, pathlib.Path) and value.exists() and not (value.is_file() or value.is_dir()):
        raise ValueError(f"{where} is {value}: must be a file or a folder, not a pipe or a device; save what it gives")
    elif isinstance(value, pathlib.Path):
        try:
            path_text(value)
        except UserError as error:
            raise ValueError(f"{where}: {error}") from error
    elif isinstance(value, float) and not abs(value) <= MOST:
        raise ValueError(f"{where} is {value}: must be a number within ±{MOST:g}; correct it")
    elif isinstance(value, float) and value < 0 and (where == "seconds" or where.endswith("_s")):
        raise ValueError(f"{where} is {value}: must be ≥ 0 seconds; correct it")
    elif isinstance(value, int) and where == "seed" and value < 0:
        raise ValueError(f"seed is {value}: must be at least 0; raise it")
    elif isinstance(value, int) and where.endswith("port") and not 0 <= value <= PORTS:
        raise ValueError(f"{where} is {value}: must lie in 0 … {PORTS}; correct it")


def _require_other_output(command: Any) -> None:
    """Refuse an output that would replace a file which the command reads."""
    out = getattr(command, "out", None)
    if not isinstance(out, pathlib.Path) or not out.is_file():
        return
    for field in dataclasses.fields(command):
        found = getattr(command, field.name)
        for path in found if isinstance(found, tuple) else (found,):
            if field.name != "out" and isinstance(path, pathlib.Path) and path.exists() and path.samefile(out):
                raise ValueError(f"out is {out}: is {field.name} as well, which would be lost; name another file")


def _in_circle(path: pathlib.Path) -> bool:
    try:
        path.stat()
    except OSError as error:
        return error.errno == errno.ELOOP
    return False
