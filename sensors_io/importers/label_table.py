"""Tables of labels: CSV files with a row for each object, or for each recording of one."""

import csv
import dataclasses
import pathlib
from collections.abc import Mapping
from collections.abc import Sequence as Seq

from sensors_io.errors import UserError
from sensors_io.schema import ATTRIBUTES, LEVELS, MATERIALS, SPLITS, ObjectCard

ID, SPLIT, NAME = "object_id", "split", "name"
COLUMNS = (ID, *ATTRIBUTES, SPLIT, NAME)
"""Of a table of labels; all but the one that names its rows may be missing, and a cell may be empty."""

LEAST = {"hardness": "soft", "roughness": "smooth", "protrusion": "flat"}
"""Meaning of level 0 of an attribute."""


class LabelsError(UserError, ValueError):
    """A table of labels that does not fit; the message names the place, the value, the constraint and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LabelRow:
    """A row of a table: where it is, as "FILE, line N", and its cells by column."""

    place: str
    cells: Mapping[str, str]

    def labels(self, of: str) -> dict[str, int]:
        """The levels of its cells; an empty one has none.

        Raises:
          LabelsError: a level or material that does not exist, `of` the object or recording that it names.
        """
        return {name: self._level(of, name) for name in ATTRIBUTES if self.cells.get(name)}

    def split(self, of: str, otherwise: str) -> str:
        """The split in its cell, else another.

        Raises:
          LabelsError: a split that does not exist.
        """
        split = self.cells.get(SPLIT) or otherwise
        if split not in SPLITS:
            raise LabelsError(
                f"{self.place}: split of {of!r} is {split!r}: must be one of {', '.join(SPLITS)}; correct it"
            )
        return split

    def _level(self, of: str, attribute: str) -> int:
        cell = self.cells[attribute]
        words = MATERIALS if attribute == "material" else tuple(map(str, range(LEVELS[attribute])))
        if cell not in words:
            order = f" (from {LEAST[attribute]} upwards)" if attribute in LEAST else ""
            raise LabelsError(
                f"{self.place}: {attribute} of {of!r} is {cell!r}: must be one of {', '.join(words)}{order}, or empty; "
                "correct it"
            )
        return words.index(cell)


def read_labels(path: pathlib.Path, key: str, columns: Seq[str] = COLUMNS) -> dict[str, LabelRow]:
    """The rows of a table of labels by their cell in the column `key`.

    Raises:
      LabelsError: no table, no column `key`, an unknown column, a row of another length, or a row named twice.
    """
    others = [name for name in columns if name != key]
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.DictReader(file, strict=True)
            found, lines = tuple(table.fieldnames or ()), [(table.line_num, line) for line in table]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LabelsError(
            f"{path} cannot be read as a CSV table ({error}); write one in UTF-8, separated by commas, with "
            f"{', '.join((key, *others))}"
        ) from error
    if key not in found or set(found) - set(columns) or len(set(found)) < len(found):
        raise LabelsError(
            f"{path}: columns are {found}: must be {key} and any of {tuple(others)}, each once, separated by commas; "
            "rename or drop them"
        )
    rows: dict[str, LabelRow] = {}
    for number, line in lines:
        place = f"{path}, line {number}"
        if None in line or None in line.values():
            raise LabelsError(f"{place}: must have {len(found)} cells; complete it")
        cells = {column: cell.strip() for column, cell in line.items()}
        if not any(cells.values()):  # as spreadsheets end their tables
            continue
        if cells[key] in rows:
            raise LabelsError(f"{place}: {key} {cells[key]!r} appears twice; keep one line")
        rows[cells[key]] = LabelRow(place=place, cells=cells)
    return rows


def labelled(card: ObjectCard, row: LabelRow, annotator: str) -> ObjectCard:
    """The card with the labels of its row's columns in the place of its own, and a split and name that the row has.

    Raises:
      LabelsError: a level, material or split that does not exist.
    """
    kept = {attribute: level for attribute, level in card.labels.items() if attribute not in row.cells}
    labels, split = kept | row.labels(card.object_id), row.split(card.object_id, card.split)
    name = row.cells.get(NAME) or card.name
    return dataclasses.replace(card, labels=labels, split=split, name=name, annotator=annotator)
