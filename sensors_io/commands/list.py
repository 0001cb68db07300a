"""`python -m sensors_io list`."""

import dataclasses
import pathlib

import tyro

from sensors_io import overview
from sensors_io.commands.console import OUT
from sensors_io.records import RecordStore


@dataclasses.dataclass(frozen=True, kw_only=True)
class List:
    """Print the objects with their split, labels and number of contacts."""

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""

    def run(self) -> int:
        store = RecordStore(self.records, allow_incomplete=True)
        OUT.print(overview.object_table(store))
        OUT.print(overview.summary_table(store))
        return 0
