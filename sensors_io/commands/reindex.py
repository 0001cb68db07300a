"""`python -m sensors_io reindex`."""

import dataclasses
import pathlib

import tyro

from sensors_io.commands.console import OUT
from sensors_io.contents import convert
from sensors_io.index import Index
from sensors_io.locks import write_lock


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reindex:
    """Convert the index of records that an earlier version wrote, one JSON, to tables that grow; shards stay."""

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""

    def run(self) -> int:
        Index.read(self.records)  # before a lock file is made where there are no records
        with write_lock(self.records):
            index = Index.read(self.records)
            converted = convert(self.records, index)
            if converted:
                index.write(self.records)
        state = "converted" if converted else "had its tables already"
        OUT.print(f"{self.records}: the index of {len(index.contacts)} contacts {state}", highlight=False)
        return 0
