"""The depth panel, part three: which pictures are taken for failed contact, and which rows for empty."""

import dataclasses
import pathlib
from collections.abc import Mapping

import numpy as np

from experiments.core.results import Cell, Column, Requirement, Table
from experiments.fields import ball_recordings
from experiments.fields.depth_balls import calibrated
from experiments.fields.sections import FieldSection
from sensors_io import quality
from sensors_io.fields.contact import ContactConfig, changed_contacts, steepest_change
from sensors_io.fields.depth import DepthReader
from sensors_io.fields.types import Calibration

_MINI_MM_PER_PX = 0.0634  # of the pictures without contact


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactRejections:
    """N pictures: steepest change, grey levels/mm; whether rejected by colour, and by depth where it is read; [N]."""

    steepness: np.ndarray
    by_colour: np.ndarray
    by_depth: np.ndarray | None

    @property
    def rejected(self) -> int:
        """Pictures that either takes for failed contact."""
        either = self.by_colour if self.by_depth is None else self.by_colour | self.by_depth
        return int(either.sum())


def contact_panel(root: pathlib.Path, seed: int) -> FieldSection:
    """Which pictures and rows the filters reject, one setting for all recordings."""
    frames, background = ball_recordings.feelanyforce(root)
    presses = {"gelslam": ball_recordings.gelslam(root), "FOTS": ball_recordings.fots(root)}
    seen = {
        "feelanyforce": judged(frames, background, _MINI_MM_PER_PX, None),
        **{n: judged(p.pictures, p.background, p.mm_per_px, calibrated(p, seed)) for n, p in presses.items()},
    }
    passed = len(frames) - seen["feelanyforce"].rejected
    rows = ball_recordings.feelanyforce_rows(root)
    empty, flagged = np.isnan(rows).all(1), quality.incomplete(rows)
    wrong = float(np.count_nonzero(flagged != empty))
    real = sum(seen[name].rejected for name in presses)
    return FieldSection(
        verdict=(
            f"{len(frames) - passed} of {len(frames)} pictures without contact are rejected, {real} of "
            f"{sum(map(len, presses.values()))} real contacts; {int((flagged & empty).sum())} of {int(empty.sum())} "
            "empty rows are flagged.",
        ),
        requirements=(
            _count("pictures without contact that pass", passed),
            _count("real contacts that are rejected, by colour or by depth", real),
            _count("rows flagged wrongly or not", wrong),
        ),
        tables=(_contact_table(seen),),
    )


def judged(frames: np.ndarray, background: np.ndarray, mm_per_px: float, made: Calibration | None) -> ContactRejections:
    """What the extraction takes for failed contact, with and without a calibration."""
    config = ContactConfig()
    steep = np.array([steepest_change(f, background, mm_per_px, config.smoothing_mm) for f in frames])
    alone = np.array([changed_contacts(f, background, mm_per_px, config).count == 0 for f in frames])
    read = None if made is None else DepthReader(made)
    return ContactRejections(
        steepness=steep,
        by_colour=(steep < config.steepness) | alone,
        by_depth=None if read is None else np.array([read(f)[1].count == 0 for f in frames]),
    )


def _contact_table(seen: Mapping[str, ContactRejections]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, j in seen.items():
        by_depth = None if j.by_depth is None else int(j.by_depth.sum())
        steepness = float(j.steepness.min()), float(j.steepness.max())
        rows.append((name, len(j.steepness), int(j.by_colour.sum()), by_depth, *steepness))
    return Table(
        title="Failed contact",
        columns=(
            Column(name="recording"),
            Column(name="pictures", format="d"),
            Column(name="rejected by colour", format="d"),
            Column(name="rejected by depth", format="d", meaning="of the folder's own calibration"),
            Column(name="flattest", unit="levels/mm", format=".1f", meaning="least steepest change"),
            Column(name="steepest", unit="levels/mm", format=".1f"),
        ),
        rows=tuple(rows),
        note=f"A contact changes some channel by {ContactConfig().steepness:g} grey levels/mm somewhere; its depth "
        f"reaches {1e3 * ContactConfig().high_mm:g} µm and a slope of {ContactConfig().rim:g}.",
    )


def _count(name: str, value: float) -> Requirement:
    return Requirement(name=name, measured=float(value), bound=0.0, better="lower")
