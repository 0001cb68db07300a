"""`python -m sensors_io check`."""

import collections
import dataclasses
import pathlib

import numpy as np
import tyro
from rich.table import Table

from sensors_io import overview, quality
from sensors_io.commands.console import OUT, complain, progress_bar
from sensors_io.fields.extract import Extractor
from sensors_io.fields.sources import read_picture
from sensors_io.fields.types import Calibration, CalibrationError
from sensors_io.records import CorruptRecordsError, IncompleteRecordsError, RecordsError, RecordStore
from sensors_io.schema import Flag, SchemaError, Sequence


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """Read every entry, verify its checksum; exit status 1 if anything is damaged or missing.

    Tables count what an import left out, and frames by quality flag: as recorded, and as the quality filters judge them
    today.  Another, by `--pictures`, looks at the pictures themselves: contact, its border and number, saturation, lost
    markers.  A dot stands where the records hold nothing to tell a flag by.  Nothing is changed or deleted: a flag is a
    bit beside its frame, and whoever reads the records chooses which flags to leave out.
    """

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""
    pictures: bool = False
    """Judge the pictures too, against the gel at rest that was recorded with them, or else `--background`."""
    background: pathlib.Path | None = None
    """Picture of the gel at rest, if none was recorded."""
    calibration: pathlib.Path | None = None
    """Calibration from `calibrate`: contact is then judged by depth, and mm per pixel are known."""

    def run(self) -> int:
        store = RecordStore(self.records, allow_incomplete=True)
        recorded, judged, looked = overview.FlagCounts(), overview.FlagCounts(), overview.FlagCounts()
        unseen: collections.Counter[str] = collections.Counter()
        problems: list[RecordsError] = []
        eye = _Eye(self.records, self.background, self.calibration)
        with progress_bar("contacts") as progress:
            for i in range(len(store)):
                try:
                    contact = store.contact(i).values()
                except CorruptRecordsError as damage:
                    problems.append(damage)
                    continue
                for sequence in contact:
                    recorded.add(sequence)
                    found = quality.judge(sequence)
                    judged.add(quality.judged(sequence, found), found)
                for sequence in contact if self.pictures else ():
                    reason = eye.cannot_see(sequence)
                    if reason:
                        unseen.update([reason])
                    else:
                        looked.add(*eye.look(sequence))
                progress(i + 1, len(store))
        OUT.print(overview.summary_table(store))
        left_out = _left_out(store)
        if left_out:
            OUT.print(_counted(left_out))
        OUT.print(overview.flag_table(recorded, "flags as recorded"))
        OUT.print(overview.flag_table(judged, "flags by the filters"))
        if self.pictures:
            if looked.frames:
                OUT.print(overview.flag_table(looked, "flags by the pictures"))
            for reason, count in unseen.items():
                OUT.print(f"not looked at: {count} sequences, {reason}", highlight=False)
        if not store.complete:
            problems.append(IncompleteRecordsError(f"{self.records}: its writing has not ended; run its command again"))
        for problem in problems:
            complain(problem)
        return 1 if problems else 0


def _left_out(store: RecordStore) -> collections.Counter[str]:
    """Counts of recordings that the import left out, by reason; empty for records that were not imported."""
    report = store.meta.notes.get("report", {})
    return collections.Counter(skip["reason"] for skip in report.get("skipped", ()))


def _counted(reasons: collections.Counter[str]) -> Table:
    table = Table("left out when imported", "count")
    for reason, count in reasons.most_common(_MOST_REASONS):
        table.add_row(reason, str(count))
    rest = len(reasons) - _MOST_REASONS
    if rest > 0:
        table.add_row(f"{rest} other reasons", str(sum(sorted(reasons.values())[:rest])))
    return table


_MOST_REASONS = 12  # that are listed one by one


class _Eye:
    """Judges pictures of records by the extraction of their fields."""

    def __init__(self, records: pathlib.Path, background: pathlib.Path | None, calibration: pathlib.Path | None):
        self._records = records
        self._given = None if background is None else read_picture(background)
        self._calibration = None if calibration is None else Calibration.load(calibration)
        self._extractors: dict[tuple[str, float], Extractor] = {}

    def cannot_see(self, sequence: Sequence) -> str:
        """Why a sequence cannot be judged; empty if it can."""
        if sequence.frames is None:
            return "they hold no pictures"
        rest = self._at_rest(sequence)
        if rest is None:
            return "no gel at rest was recorded with them: give --background"
        if rest.shape != sequence.frames.shape[1:]:
            return (
                f"their pictures are {sequence.frames.shape[1:3]}, the gel at rest is {rest.shape[:2]}: crop them alike"
            )
        if self._pitch(sequence) is None:
            return "nothing tells their mm per px: give --calibration, or record with the device's --mm-per-px"
        try:
            self._extractor(sequence)
        except (SchemaError, CalibrationError) as error:
            return str(error)
        return ""

    def look(self, sequence: Sequence) -> tuple[Sequence, tuple[Flag, ...]]:
        """The sequence with the flags that its pictures show, in place of its own, and those that they could show."""
        assert sequence.frames is not None
        extractor = self._extractor(sequence)
        fields = extractor.extract(sequence.frames)
        return dataclasses.replace(sequence, flags=fields.flags), extractor.judged

    def _extractor(self, sequence: Sequence) -> Extractor:
        """Made once for each gel at rest."""
        rest, pitch = self._at_rest(sequence), self._pitch(sequence)
        assert pitch is not None
        assert rest is not None
        gel = _background(sequence), pitch
        if gel not in self._extractors:
            self._extractors[gel] = Extractor(rest, pitch, self._calibration)
        return self._extractors[gel]

    def _pitch(self, sequence: Sequence) -> float | None:
        """The one that was recorded, else the calibration's."""
        if sequence.mm_per_px is None and self._calibration is not None:
            return self._calibration.mm_per_px
        return sequence.mm_per_px

    def _at_rest(self, sequence: Sequence) -> np.ndarray | None:
        name = _background(sequence)
        return read_picture(self._records / name) if name else self._given


def _background(sequence: Sequence) -> str:
    """File of the gel at rest that was recorded with a sequence, empty where none was."""
    name: str = sequence.camera.get("recording", {}).get("background") or ""
    return name
