"""Times on an accelerator as a table."""

import statistics
from collections.abc import Mapping
from typing import NamedTuple

from experiments.core.results import Cell, Column, Table
from experiments.engine.gpu_device import DataSheet


class TimedWorkload(NamedTuple):
    """A piece that was timed: seconds of every round, its work, what it makes."""

    seconds: tuple[float, ...]
    flops: float
    read_bytes: float | None
    made: float
    unit: str

    @property
    def median_s(self) -> float:
        """Median of the rounds."""
        return statistics.median(self.seconds)

    def share(self, peak_flops: float) -> float:
        """Share of a device's operations."""
        return self.flops / self.median_s / peak_flops

    def read_share(self, sheet: DataSheet | None) -> float | None:
        """Share of what the memory's data sheet promises, where both are known."""
        if sheet is None or self.read_bytes is None:
            return None
        return self.read_bytes / self.median_s / sheet.read_bytes


def time_table(timed: Mapping[str, TimedWorkload], sheet: DataSheet | None, peak_flops: float) -> Table:
    """Every piece against the peak."""
    rows: list[tuple[Cell, ...]] = []
    for name, t in timed.items():
        read = t.read_share(sheet)
        rows.append(
            (
                name,
                1e3 * t.median_s,
                1e3 * (max(t.seconds) - min(t.seconds)),
                f"{t.made / t.median_s:,.0f} {t.unit}/s",
                t.flops / t.median_s / 1e12,
                100 * t.share(peak_flops),
                None if read is None else 100 * read,
            )
        )
    peak = "the data sheet" if sheet is not None else "the plain product, for the device's data sheet is not known here"
    return Table(
        title="Time and share of the peak",
        columns=(
            Column(name="piece"),
            Column(name="median", unit="ms"),
            Column(name="spread", unit="ms", meaning="slowest less fastest round"),
            Column(name="makes"),
            Column(
                name="work", unit="TFLOP/s", format=".3g", meaning="operations that no program can avoid, over time"
            ),
            Column(name="of peak", unit="%"),
            Column(name="of memory", unit="%", meaning="bytes that must be read, over what the memory delivers"),
        ),
        rows=tuple(rows),
        note=f"The peak is that of {peak}: {peak_flops / 1e12:.4g} TFLOP/s.",
    )
