"""`python -m sensors_io check` and `list`."""

import dataclasses
import pathlib

import tyro

from sensors_io import overview, quality
from sensors_io.commands.console import OUT, complain, progress_bar
from sensors_io.records import CorruptRecordsError, IncompleteRecordsError, RecordsError, RecordStore


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """Read every entry, verify its checksum; exit status 1 if anything is damaged or missing.

    Two tables count frames by quality flag: as recorded, and as the quality filters judge them today.  Nothing is
    changed or deleted.
    """

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""

    def run(self) -> int:
        store = RecordStore(self.records, allow_incomplete=True)
        recorded, judged = overview.FlagCounts(), overview.FlagCounts()
        problems: list[RecordsError] = []
        with progress_bar("contacts") as progress:
            for i in range(len(store)):
                try:
                    contact = store.contact(i).values()
                    recorded.add(contact)
                    judged.add(quality.judged(sequence) for sequence in contact)
                except CorruptRecordsError as damage:
                    problems.append(damage)
                progress(i + 1, len(store))
        OUT.print(overview.summary_table(store))
        OUT.print(overview.flag_table(recorded, "flags as recorded"))
        OUT.print(overview.flag_table(judged, "flags by the filters"))
        if not store.complete:
            problems.append(IncompleteRecordsError(f"{self.records}: its writing has not ended; run its command again"))
        for problem in problems:
            complain(problem)
        return 1 if problems else 0


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
