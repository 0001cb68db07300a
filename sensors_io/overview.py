"""Tables of what a data set holds, for the command line."""

import collections
import dataclasses
from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Seq

import numpy as np
from rich.table import Column, Table

from sensors_io.importers.catalogue import ImportReport
from sensors_io.importers.keep import Skip
from sensors_io.records import RecordStore
from sensors_io.schema import ATTRIBUTES, MATERIALS, SPLITS, UNKNOWN, Flag, Sequence

MEASURED: Mapping[str, str] = {
    "depth_mm": "",
    "deformation_mm": "xy",
    "shear_mm": "xy",
    "force_n": "xyz",
    "moment_nmm": "xyz",
}
"""Array of measured values → its components, none for a scalar."""

SKIPS_BY_NAME = 5
"""Up to so many things left out for one reason are named each."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlagCounts:
    """Frames that carry each quality flag, those that were judged for it, and all frames, by sensor."""

    flags: collections.Counter[tuple[str, Flag]] = dataclasses.field(default_factory=collections.Counter)
    judged: collections.Counter[tuple[str, Flag]] = dataclasses.field(default_factory=collections.Counter)
    frames: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)

    def add(self, sequence: Sequence, judged: Iterable[Flag] = tuple(Flag)) -> None:
        """Count the frames of a sequence; a frame without a flag counts under `Flag.NONE`.

        Args:
          sequence: with its flags.
          judged: the flags that it could have been given.
        """
        self.frames[sequence.sensor] += len(sequence)
        for flag in (Flag.NONE, *judged):
            self.judged[sequence.sensor, flag] += len(sequence)
        self.flags[sequence.sensor, Flag.NONE] += int(np.count_nonzero(sequence.flags == 0))
        for flag in Flag:
            self.flags[sequence.sensor, flag] += int(np.count_nonzero(sequence.flags & np.uint32(flag)))

    def cell(self, sensor: str, flag: Flag) -> str:
        """Number of frames with a flag, of the number judged if that is not all; a dot if none was judged."""
        count, judged = self.flags[sensor, flag], self.judged[sensor, flag]
        if judged == self.frames[sensor]:
            return str(count)
        return f"{count} of {judged}" if judged else "·"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ValueRanges:
    """Least and greatest finite value of each measured array and component, by sensor."""

    found: dict[tuple[str, str], tuple[float, float]] = dataclasses.field(default_factory=dict)

    def add(self, sequence: Sequence) -> None:
        """Take the values of a sequence into account."""
        for name, axes in MEASURED.items():
            values = getattr(sequence, name)
            if values is None:
                continue
            columns = values.reshape(-1, max(len(axes), 1)).T
            for array, column in zip([f"{name} {axis}" for axis in axes] or [name], columns, strict=True):
                low, high = self.found.get((sequence.sensor, array), (np.inf, -np.inf))
                finite = column[np.isfinite(column)]
                self.found[sequence.sensor, array] = finite.min(initial=low), finite.max(initial=high)


def range_table(ranges: ValueRanges) -> Table:
    """Least and greatest value of every array: they show a wrong unit or sign."""
    table = Table("sensor", "array", "least", "greatest", title="values")
    for (sensor, name), (low, high) in sorted(ranges.found.items()):
        table.add_row(sensor, name, f"{low:.3g}", f"{high:.3g}")
    return table


def summary_table(store: RecordStore) -> Table:
    """Source, counts by sensor and by split."""
    table = Table(title=str(store.path), show_header=False)
    state = "complete" if store.complete else "incomplete"
    rows: list[tuple[str, str]] = [
        ("source", f"{store.meta.source} ({store.meta.licence}), config {store.meta.config_hash}, {state}"),
        ("objects, contacts", f"{len(store.objects)}, {len(store)}"),
    ]
    seen = collections.Counter(sensor for i in range(len(store)) for sensor in store.sensors_of(i))
    rows += [(s, f"{seen[s]} sequences, {store.frames.get(s, 0)} frames") for s in store.meta.sensors]
    for split in SPLITS:
        objects = sum(card.split == split for card in store.objects.values())
        rows.append((split, f"{objects} objects, {len(store.contacts_of_split(split))} contacts"))
    for row in rows:
        table.add_row(*row)
    return table


def object_table(store: RecordStore) -> Table:
    """One row per object: split, labels, contacts."""
    table = Table(Column("object", overflow="fold"), "split", *ATTRIBUTES, "contacts")  # names that end alike differ
    contacts = collections.Counter(key.object_id for key in store.contacts)
    for name, card in store.objects.items():
        levels = [card.labels.get(attribute, UNKNOWN) for attribute in ATTRIBUTES]
        words = ["·" if level == UNKNOWN else str(level) for level in levels]
        if levels[-1] != UNKNOWN:
            words[-1] = MATERIALS[levels[-1]]
        table.add_row(name, card.split, *words, str(contacts[name]))
    return table


def flag_table(counts: FlagCounts, title: str = "flags") -> Table:
    """Frames by quality flag and sensor; a frame may carry several, and a dot means that it could not be checked."""
    sensors = list(counts.frames)
    table = Table("frames", *sensors, title=title)
    table.add_row("all", *(str(counts.frames[sensor]) for sensor in sensors), end_section=True)
    for flag in (Flag.NONE, *Flag):
        table.add_row(str(flag.name).lower(), *(counts.cell(sensor, flag) for sensor in sensors))
    return table


def import_table(report: ImportReport) -> Table:
    """Table of imported recordings, then of those left out: by name, or one row for many with one reason."""
    table = Table("what", "count or reason", title="import")
    table.add_row("contacts imported", str(report.contacts))
    for split, count in report.objects.items():
        table.add_row(f"objects in {split}", str(count))
    table.add_row("skipped", str(len(report.skipped)))
    table.add_row("labels missing", str(len(report.unlabelled)))
    table.add_row("nobody annotated", ", ".join(report.unannotated) or "·")
    _add_skips(table, (*report.skipped, *report.unlabelled))
    return table


def skip_table(skipped: Seq[Skip], title: str) -> Table:
    """Table of what was left out, as in `import_table`."""
    table = Table("what", "count or reason", title=title)
    table.add_row("skipped", str(len(skipped)))
    _add_skips(table, skipped)
    return table


def _add_skips(table: Table, skipped: Seq[Skip]) -> None:
    by_reason: dict[str, list[Skip]] = {}
    for skip in skipped:
        by_reason.setdefault(skip.reason, []).append(skip)
    for reason, skips in by_reason.items():
        if len(skips) > SKIPS_BY_NAME:
            table.add_row(f"{len(skips)}: {skips[0].name} … {skips[-1].name}", reason)
        else:
            for skip in skips:
                table.add_row(skip.name, reason)
