"""Comma-separated tables with a header, checked for the columns that an importer needs."""

import csv
import io
import pathlib
from collections.abc import Sequence as Seq
from typing import TypeVar

from sensors_io.importers.keep import ImportSourceError
from sensors_io.json_files import require_regular

Row = TypeVar("Row", dict[str, str], list[str])


def read_table(path: pathlib.Path, columns: Seq[str]) -> list[dict[str, str]]:
    """Rows of a table by column; a short row has empty cells.

    Raises:
      ImportSourceError: it is absent, is no text, lacks a column, has no row, or ends in the middle of one.
    """
    _require_file(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            text = file.read()
            reader = csv.DictReader(io.StringIO(text, newline=""))
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise ImportSourceError(
                    f"{path} has the columns {reader.fieldnames!s:.200}: must have {', '.join(columns)}; "
                    "give the published table"
                )
            rows = _with_a_row(path, list(reader))
            if text[-1] not in "\r\n" and (None in rows[-1].values() or text.count('"') % 2):
                raise ImportSourceError(f"{path} ends in the middle of row {len(rows)}; give the whole published table")
            return [{name: cell or "" for name, cell in row.items()} for row in rows]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ImportSourceError(f"{path} cannot be read ({error}); give the published table") from error


def read_rows(path: pathlib.Path) -> list[list[str]]:
    """Rows of a table without a header.

    Raises:
      ImportSourceError: it is absent, empty or no text.
    """
    _require_file(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            return _with_a_row(path, [row for row in csv.reader(file) if row])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ImportSourceError(f"{path} cannot be read ({error}); give the published table") from error


def _with_a_row(path: pathlib.Path, rows: list[Row]) -> list[Row]:
    if not rows:
        raise ImportSourceError(f"{path} is empty: must have a row; give the published table")
    return rows


def _require_file(path: pathlib.Path) -> None:
    try:
        require_regular(path)
    except ValueError as error:
        raise ImportSourceError(f"{path} cannot be read ({error}); give the published table") from error
