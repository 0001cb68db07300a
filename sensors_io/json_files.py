"""Small files, JSON above all, that are whole or not there, and the checksum of a JSON object.

A *sealed* object ends with the CRC-32 of the text before it, since a flipped bit on a disk raises no error of its own.
Objects without this key, such as those of earlier versions, are read as well.
"""

import collections
import json
import os
import pathlib
import re
import zlib
from collections.abc import Mapping
from typing import Any

CHECKSUM = "crc32"
"""Last key of a sealed object."""

_VALUE = re.compile(r": ?([0-9]{1,10})\s*\}")  # of the last key, if it is a whole number


def write_json(path: pathlib.Path, tree: Mapping[str, Any]) -> None:
    """Replace a file by JSON in one step; its folder is made if need be, for what is written was measured."""
    write_whole(path, seal(json.dumps(tree, indent=1, allow_nan=False)).encode())


def write_whole(path: pathlib.Path, data: bytes) -> None:
    """Write a file by way of a temporary one in the same folder, so that no reader ever sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")  # another process may write the same file
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def require_writable(path: pathlib.Path) -> None:
    """Find out whether a file can be written before it is measured what to write.

    Raises:
      OSError: it is a folder, or its folder cannot be made or written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: must be a file; name one in it")
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"{path.parent} is read-only: must be writable; name another folder")


def require_regular(path: pathlib.Path) -> None:
    """Refuse a folder, a pipe or a device in the place of a file: who reads a pipe waits, maybe for ever.

    Raises:
      ValueError: it is none; the caller names it.
    """
    if path.exists() and not path.is_file():
        raise ValueError("it is a folder, a pipe or a device")


def read_json(path: pathlib.Path) -> Any:
    """The value of a JSON file, without its checksum.

    Raises:
      OSError, ValueError: it cannot be read, or its checksum does not hold.
    """
    require_regular(path)
    return unseal(path.read_text(encoding="utf-8"))


def distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object of its names and values, as a hook of `json.loads`, which would take the last of two of one name.

    Raises:
      ValueError: a name is there twice.
    """
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = collections.Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(
            f"{twice!r} stands there twice in one object: keep one of them, or copy the file again if nobody edited it"
        )
    return found


def seal(text: str) -> str:
    """Add the checksum to the text of a JSON object, as its last key; bytes that are no UTF-8 become JSON's escapes."""
    text = text.encode(errors="backslashreplace").decode()
    body = text.removesuffix("}").rstrip()
    comma, space, end = "" if body == "{" else ",", "\n  " if "\n" in text else " ", "\n}" if "\n" in text else "}"
    return f'{body}{comma}{space}"{CHECKSUM}": {zlib.crc32(body.encode())}{end}'


def unseal(text: str) -> Any:
    """The value of a JSON text, without its checksum.

    Raises:
      ValueError: it is no JSON, an object has two values of one name, or its checksum does not hold.
    """
    try:
        value, text = json.loads(text, object_pairs_hook=distinct), text.rstrip()
    except RecursionError as error:
        raise ValueError("it nests too deeply") from error
    end = text.rfind('"')
    start, stated = text.rfind('"', 0, max(end, 0)), _VALUE.fullmatch(text, end + 1)
    if start < 0 or stated is None or not isinstance(value, dict):
        return value
    name = text[start + 1 : end]
    if int(stated[1]) == zlib.crc32(text[:start].rstrip().removesuffix(",").encode()):  # whatever became of its name
        del value[name]
    elif name == CHECKSUM:
        raise ValueError("its checksum does not hold")
    return value
