"""`python -m sensors_io check`."""

import collections
import dataclasses
import pathlib
from collections.abc import Iterator

import tyro
from rich.table import Table

from sensors_io import overview, quality
from sensors_io.commands.console import OUT, complain, progress_bar
from sensors_io.fields.recorded import RecordedGels, RestGel, recorded_fields
from sensors_io.fields.sources import read_picture
from sensors_io.fields.types import Calibration, CalibrationError
from sensors_io.index import JOURNALS
from sensors_io.recording.book import require_own
from sensors_io.records import (
    CorruptRecordsError,
    IncompleteRecordsError,
    RecordsError,
    RecordsExistError,
    RecordStore,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """Read every entry, verify its checksum; exit status 1 if anything is damaged or missing.

    Tables count what an import left out, and frames by quality flag: as recorded, and as the quality filters judge them
    today.  A table shows the least and greatest value of each array.  Another, by `--pictures`, looks at the pictures
    themselves: contact, its border and number, saturation, lost markers.  A dot stands where the records hold nothing
    to tell a flag by.  Nothing is changed or deleted: a flag is a bit stored with its frame, and who reads the records
    chooses which flags to leave out.
    """

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""
    pictures: bool = False
    """Judge the pictures too, against the gel at rest that was recorded with them, or else `--background`."""
    background: pathlib.Path | None = None
    """Picture of the gel at rest, if none was recorded, at the size of the pictures or at one of the same window."""
    rest_frames: int = 0
    """Frames at the start of each recording that show the gel at rest, if no picture of it was recorded."""
    mm_per_px: float | None = None
    """Millimetres per pixel of the recorded pictures, if none were recorded or imported with them."""
    calibration: pathlib.Path | None = None
    """Calibration from `calibrate`: contact is then judged by depth, and mm per pixel are known."""

    def run(self) -> int:
        store = RecordStore(self.records, allow_incomplete=True)
        recorded, judged, looked = overview.FlagCounts(), overview.FlagCounts(), overview.FlagCounts()
        ranges = overview.ValueRanges()
        unseen: collections.Counter[str] = collections.Counter()
        problems: list[RecordsError] = []
        gels, left_out = self._gels(store), _left_out(store)
        with progress_bar("contacts") as progress:
            for i in range(len(store)):
                try:
                    contact = store.contact(i).values()
                except CorruptRecordsError as damage:
                    problems.append(damage)
                    continue
                for sequence in contact:
                    left_out[_OTHERS] += sequence.camera.get("recording", {}).get("left_out", 0)
                    recorded.add(sequence)
                    ranges.add(sequence)
                    found = quality.judge(sequence)
                    judged.add(quality.judged(sequence, found), found)
                for sequence in contact if self.pictures else ():
                    try:
                        extractor = gels.extractor(sequence)
                    except CalibrationError as error:
                        unseen.update([str(error)])
                        continue
                    flags = recorded_fields(sequence, extractor).flags
                    looked.add(dataclasses.replace(sequence, flags=flags), extractor.judged)
                progress(i + 1, len(store))
        OUT.print(overview.summary_table(store))
        if left_out := +left_out:
            OUT.print(_counted(left_out))
        if ranges.found:
            OUT.print(overview.range_table(ranges))
        OUT.print(overview.flag_table(recorded, "flags as recorded"))
        OUT.print(overview.flag_table(judged, "flags by the filters"))
        if self.pictures:
            if looked.frames:
                OUT.print(overview.flag_table(looked, "flags by the pictures"))
            for reason, count in unseen.items():
                OUT.print(f"not looked at: {count} sequences, {reason}", highlight=False)
        problems.extend(self._unfinished(store))
        if kept := [*(self.records / JOURNALS).glob("*.refused")]:
            words = "contacts that were refused when they were recorded; move them away or delete them"
            OUT.print(f"{kept[0].parent} holds {len(kept)} {words}", markup=False, highlight=False, soft_wrap=True)
        for problem in problems:
            complain(problem)
        return 1 if problems else 0

    def _unfinished(self, store: RecordStore) -> Iterator[RecordsError]:
        """Name what a writer has not brought in, and what another one left."""
        if not store.complete:
            yield IncompleteRecordsError(f"{self.records}: its writing has not ended; run its command again")
        else:
            try:
                require_own(self.records)
            except RecordsExistError as strange:
                yield strange
        if journals := [*(self.records / JOURNALS).glob("*.journal")]:
            yield IncompleteRecordsError(
                f"{journals[0].parent} holds {len(journals)} contacts that are not in the records: the next "
                "`record` there brings in what a killed one left"
            )

    def _gels(self, store: RecordStore) -> RecordedGels:
        background = None if self.background is None else read_picture(self.background)
        gel = RestGel(background=background, rest_frames=self.rest_frames, mm_per_px=self.mm_per_px)
        return RecordedGels(store.path, gel, None if self.calibration is None else Calibration.load(self.calibration))


def _left_out(store: RecordStore) -> collections.Counter[str]:
    """Counts of recordings that the import or `extract` left out, by reason."""
    notes = [store.meta.notes.get(name, {}) for name in ("report", "fields")]
    return collections.Counter(skip["reason"] for note in notes for skip in note.get("skipped", ()))


def _counted(reasons: collections.Counter[str]) -> Table:
    table = Table("left out when imported, recorded or extracted", "count")
    for reason, count in reasons.most_common(_MOST_REASONS):
        table.add_row(reason, str(count))
    rest = len(reasons) - _MOST_REASONS
    if rest > 0:
        table.add_row(f"{rest} other reasons", str(sum(sorted(reasons.values())[:rest])))
    return table


_OTHERS = "frame of another size or with other arrays than most of its contact"
_MOST_REASONS = 12  # that are listed one by one
