"""`python -m sensors_io label`."""

import csv
import dataclasses
import pathlib
from collections.abc import Mapping

import tyro

from sensors_io import overview
from sensors_io.cards import replace_cards
from sensors_io.commands.console import OUT
from sensors_io.errors import UserError
from sensors_io.importers.holdout import split_by_name
from sensors_io.importers.keep import Shares
from sensors_io.records import RecordStore
from sensors_io.schema import ATTRIBUTES, LEVELS, MATERIALS, SPLITS, ObjectCard

ID, SPLIT, NAME = "object_id", "split", "name"
COLUMNS = (ID, *ATTRIBUTES, SPLIT, NAME)
"""Of a table of labels; all but the first may be missing, and a cell may be empty."""

LEAST = {"hardness": "soft", "roughness": "smooth", "protrusion": "flat"}
"""Meaning of level 0 of an attribute."""

Row = Mapping[str, str]


class LabelsError(UserError, ValueError):
    """A table of labels that does not fit; the message names the place, the value, the constraint and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Label(Shares):
    """Give recorded objects labels and splits from a table, so that a study can train on them; contacts stay.

    The table is a CSV file with a column object_id and any of hardness, roughness, protrusion (0, 1 or 2, from soft,
    smooth, flat upwards), material, split and name.  An empty cell is unknown.  Objects that are labelled for the first
    time and have no split are dealt out to train, val and test by their ids.
    """

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""
    labels: pathlib.Path
    """CSV table of labels."""
    annotator: str
    """Name of the annotator."""

    def run(self) -> int:
        store = RecordStore(self.records, allow_incomplete=True)
        rows = read_labels(self.labels)
        strange = sorted(set(rows) - set(store.objects))
        if strange:
            raise LabelsError(
                f"{self.labels}: object_id is {strange[0]!r}: must be an object of {self.records}, which `list` names; "
                "correct it"
            )
        cards = {name: labelled(store.objects[name], row, self.annotator) for name, row in rows.items()}
        new = [name for name, card in cards.items() if card.split == "unlabelled" and card.labels]
        for name, split in split_by_name(new, val_share=self.val_share, test_share=self.test_share).items():
            cards[name] = dataclasses.replace(cards[name], split=split)
        replace_cards(self.records, cards.values())
        OUT.print(overview.object_table(RecordStore(self.records, allow_incomplete=True)))
        return 0


def read_labels(path: pathlib.Path) -> dict[str, Row]:
    """The rows of a table of labels by object.

    Raises:
      LabelsError: no table, no column of objects, an unknown column, a row of another length, or an object twice.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.DictReader(file, strict=True)
            columns, lines = tuple(table.fieldnames or ()), list(table)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LabelsError(
            f"{path} cannot be read as a CSV table ({error}); write one with {', '.join(COLUMNS)}"
        ) from error
    unknown = [name for name in columns if name not in COLUMNS]
    if ID not in columns or unknown:
        raise LabelsError(
            f"{path}: columns are {columns}: must be object_id and any of {COLUMNS[1:]}; rename or drop them"
        )
    rows: dict[str, Row] = {}
    for number, line in enumerate(lines, start=2):
        if None in line or None in line.values():
            raise LabelsError(f"{path}, line {number}: must have {len(columns)} cells; complete it")
        row = {column: cell.strip() for column, cell in line.items()}
        if row[ID] in rows:
            raise LabelsError(f"{path}, line {number}: object_id {row[ID]!r} appears twice; keep one line")
        rows[row[ID]] = row
    return rows


def labelled(card: ObjectCard, row: Row, annotator: str) -> ObjectCard:
    """The card with the labels of its row in the place of its own, and its split and name where the row has them.

    Raises:
      LabelsError: a level, material or split that does not exist.
    """
    labels = {
        attribute: _level(card.object_id, attribute, row[attribute]) for attribute in ATTRIBUTES if row.get(attribute)
    }
    split = row.get(SPLIT) or card.split
    if split not in SPLITS:
        raise LabelsError(f"split of {card.object_id!r} is {split!r}: must be one of {', '.join(SPLITS)}; correct it")
    return dataclasses.replace(card, labels=labels, split=split, name=row.get(NAME) or card.name, annotator=annotator)


def _level(object_id: str, attribute: str, cell: str) -> int:
    words = MATERIALS if attribute == "material" else tuple(map(str, range(LEVELS[attribute])))
    if cell not in words:
        order = f" (from {LEAST[attribute]} upwards)" if attribute in LEAST else ""
        raise LabelsError(
            f"{attribute} of {object_id!r} is {cell!r}: must be one of {', '.join(words)}{order}, or empty; correct it"
        )
    return words.index(cell)
