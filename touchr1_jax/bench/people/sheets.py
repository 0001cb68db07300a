"""Tables that people fill in, as CSV files, written blank and read back with every cell checked; their agreement."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from touchr1_jax.bench.json_lines import write_text
from touchr1_jax.bench.statistics import cohens_kappa


class SheetError(ValueError):
    """A sheet that cannot be used; the message names the file, the line, the value, the constraint and the fix."""


def write_sheet(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, str]]) -> None:
    """Write a sheet in one step; columns that a row lacks stay blank.

    Raises:
      SheetError: the file exists, and may be filled in.
    """
    if path.exists():
        raise SheetError(f"{path} exists and may be filled in; move it away, or choose another place")
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def read_sheet(
    path: Path, key: str, cells: Mapping[str, Sequence[str]], wanted: Iterable[str]
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
    names = set(wanted)
    rows: dict[str, dict[str, str]] = {}
    try:
        reader = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"), newline=""))
        lines = [(reader.line_num, row) for row in reader]
    except FileNotFoundError:
        raise SheetError(f"{path} is missing: must be a filled-in sheet; correct the path") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:  # a quotation mark that is not closed takes all lines
        raise SheetError(f"{path} cannot be read ({error}): must be CSV in UTF-8; save it so") from error
    missing = [column for column in (key, *cells) if column not in (reader.fieldnames or ())]
    if missing:
        raise SheetError(f"{path} lacks the columns {missing}: must have {key}, {', '.join(cells)}; add them")
    for line, row in lines:
        where, name = f"{path}, line {line}", row[key]
        if name not in names or name in rows:
            why = "occurs twice" if name in rows else "is not asked for"
            raise SheetError(f"{where}: {key} {name!r} {why}; each row of the blank sheet belongs there once")
        rows[name] = {column: (row[column] or "").strip().lower() for column in cells}
        for column, words in cells.items():
            if rows[name][column] not in words:
                choices = ", ".join(words)
                raise SheetError(f"{where}: {column} is {row[column]!r}: must be one of {choices}; fill it in")
    absent = sorted(names - set(rows))
    if absent:
        raise SheetError(f"{path} lacks {len(absent)} rows, the first {absent[0]!r}; fill in all of the blank sheet")
    return rows


def kappa_unless_constant(
    a: np.ndarray, b: np.ndarray, categories: int, weights: Literal["none", "quadratic"] = "none"
) -> float | None:
    """Cohen's κ of two columns of categories; `None` where all entries are equal, for which κ is undefined."""
    return cohens_kappa(a, b, categories, weights=weights) if len({*a.tolist(), *b.tolist()}) > 1 else None
