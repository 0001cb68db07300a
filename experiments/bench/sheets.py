"""Tables that people fill in, as CSV files: written blank, read back with every cell checked."""

import csv
import io
import os
import pathlib
from collections.abc import Iterable, Mapping, Sequence


class SheetError(ValueError):
    """A sheet that cannot be used; the message names the file, the line, the value, the constraint and the fix."""


def write_sheet(path: str | os.PathLike[str], columns: Sequence[str], rows: Iterable[Mapping[str, str]]) -> None:
    """Write a sheet in one step; columns that a row lacks stay blank.

    Raises:
      SheetError: the file exists, and may be filled in.
    """
    path = pathlib.Path(path)
    if path.exists():
        raise SheetError(f"{path} exists and may be filled in; move it away, or choose another place")
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text.getvalue(), encoding="utf-8")
    temporary.replace(path)


def read_sheet(
    path: str | os.PathLike[str], key: str, cells: Mapping[str, Sequence[str]], wanted: Iterable[str]
) -> dict[str, dict[str, str]]:
    """A filled-in sheet: key → column → word.

    Args:
      path: the file.
      key: the column that names the row.
      cells: column → the words that it may hold.
      wanted: the keys that must be there, each once.

    Raises:
      SheetError: a file that is missing or not text, a key that is unknown, missing or there twice, a missing column,
        or a word that is not allowed.
    """
    path, names = pathlib.Path(path), set(wanted)
    rows: dict[str, dict[str, str]] = {}
    reader = csv.DictReader(io.StringIO(_text(path), newline=""))
    missing = [column for column in (key, *cells) if column not in (reader.fieldnames or ())]
    if missing:
        raise SheetError(f"{path} lacks the columns {missing}: must have {key}, {', '.join(cells)}; add them")
    for row in reader:
        where, name = f"{path}, line {reader.line_num}", row[key]
        if name not in names or name in rows:
            why = "occurs twice" if name in rows else "is not asked for"
            raise SheetError(f"{where}: {key} {name!r} {why}; each row of the blank sheet belongs there once")
        rows[name] = {column: _word(where, column, row[column], words) for column, words in cells.items()}
    absent = sorted(names - set(rows))
    if absent:
        raise SheetError(f"{path} lacks {len(absent)} rows, the first {absent[0]!r}; fill in all of the blank sheet")
    return rows


def _text(path: pathlib.Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise SheetError(f"{path} is missing: must be a filled-in sheet; correct the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SheetError(f"{path} cannot be read ({error}): must be CSV in UTF-8; save it so") from error


def _word(where: str, column: str, cell: str | None, words: Sequence[str]) -> str:
    word = (cell or "").strip().lower()
    if word not in words:
        raise SheetError(f"{where}: {column} is {cell!r}: must be one of {', '.join(words)}; fill it in")
    return word
