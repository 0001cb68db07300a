"""`python -m sensors_io label`."""

import dataclasses
import pathlib
from collections.abc import Iterable, Mapping

import tyro

from sensors_io import overview
from sensors_io.cards import replace_cards
from sensors_io.commands.console import OUT
from sensors_io.importers.holdout import split_by_name
from sensors_io.importers.keep import Shares
from sensors_io.importers.label_table import ID, SPLIT, LabelRow, LabelsError, labelled, read_labels
from sensors_io.records import RecordStore
from sensors_io.schema import ObjectCard


@dataclasses.dataclass(frozen=True, kw_only=True)
class Label(Shares):
    """Give recorded objects labels and splits from a table, so that a study can train on them; contacts stay.

    The table is a CSV file with a column object_id and any of hardness, roughness, protrusion (0, 1 or 2, from soft,
    smooth, flat upwards), material, split and name.  An empty cell is unknown, a missing column keeps what there is.
    Objects that are labelled for the first time and have no split are dealt out to train, val and test by their ids.
    """

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""
    labels: pathlib.Path
    """CSV table of labels."""
    annotator: str
    """Name of the annotator."""

    def run(self) -> int:
        store = RecordStore(self.records, allow_incomplete=True)
        rows = read_labels(self.labels, ID)
        strange = sorted(set(rows) - set(store.objects))
        if strange:
            raise LabelsError(
                f"{rows[strange[0]].place}: object_id is {strange[0]!r}: must be an object of {self.records}, which "
                "`list` names; correct it"
            )
        replace_cards(self.records, lambda known: self._labelled(known, rows))
        OUT.print(overview.object_table(RecordStore(self.records, allow_incomplete=True)))
        return 0

    def _labelled(self, known: Mapping[str, ObjectCard], rows: Mapping[str, LabelRow]) -> Iterable[ObjectCard]:
        cards = {name: labelled(known[name], row, self.annotator) for name, row in rows.items()}
        new = [
            name
            for name, card in cards.items()
            if card.split == "unlabelled" and card.labels and not rows[name].cells.get(SPLIT)
        ]
        for name, split in split_by_name(new, val_share=self.val_share, test_share=self.test_share).items():
            cards[name] = dataclasses.replace(cards[name], split=split)
        return cards.values()
