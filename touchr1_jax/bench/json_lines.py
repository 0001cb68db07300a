"""Files of JSON Lines, written completely or not at all."""

import json
import os
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any


class LinesError(ValueError):
    """A file that is missing or not JSON Lines; the message names it and the line."""


def write_lines(path: str | os.PathLike[str], trees: Iterable[Mapping[str, Any]]) -> None:
    """Replace a file of JSON Lines in one step."""
    lines = (json.dumps(tree, ensure_ascii=False, allow_nan=False) + "\n" for tree in trees)
    write_text(pathlib.Path(path), "".join(lines))


def write_text(path: pathlib.Path, text: str) -> None:
    """Replace a text file in one step; a folder that is missing is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")  # another process may write the same file
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def read_lines(path: str | os.PathLike[str]) -> list[tuple[int, Any]]:
    """Line numbers, from 1, and objects of a file of JSON Lines; blank lines are skipped.

    Raises:
      LinesError: no such file, one that is no text, or a line that is no JSON object.
    """
    rows = []
    for number, line in enumerate(_text(pathlib.Path(path)).split("\n"), 1):
        if not line.strip():
            continue
        try:
            tree = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise LinesError(f"{path}, line {number}: {error}; every line must be one JSON object") from error
        if not isinstance(tree, dict):
            raise LinesError(f"{path}, line {number} is {tree!r}: must be a JSON object; write one per line")
        rows.append((number, tree))
    return rows


def _text(path: pathlib.Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise LinesError(
            f"{path} is missing: must be a file of JSON Lines; correct the path, or write it first"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise LinesError(f"{path} cannot be read ({error}): must be text, one JSON object per line") from error
