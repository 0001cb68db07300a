"""How often the package takes a bare gel for one with markers, or the other way round, on real pictures."""

import collections
import dataclasses
import pathlib
from collections.abc import Sequence

import cv2

from experiments.core.context import Context
from experiments.core.results import Column, Requirement, Table
from experiments.fields.gels_at_rest import load
from experiments.fields.sections import FieldSection
from sensors_io.fields.evidence import Pattern, examine

Crop = tuple[float, float, float, float]
"""Left, top, right, bottom, as shares of width and height."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PatternFolder:
    """Pictures of one kind of gel: what lies in it, and the part of the picture that shows it."""

    name: str
    pattern: str
    truth: Pattern
    crop: Crop = (0.0, 0.0, 1.0, 1.0)


FOLDERS = (
    PatternFolder(name="FOTS, markers", pattern="FOTS/marker_calib/data/*.png", truth=Pattern.MARKERS),
    PatternFolder(name="GelSlim", pattern="gelslim/**/*.jpg", truth=Pattern.MARKERS),
    PatternFolder(name="GelSlim 2", pattern="gelsight_heightmap/**/*.jpg", truth=Pattern.MARKERS),
    PatternFolder(name="gripper", pattern="letac_mpc/**/*.jpg", truth=Pattern.MARKERS),
    PatternFolder(
        name="wedge", pattern="wyh5625_wedge/calibration/*.jpg", truth=Pattern.MARKERS, crop=(0.24, 0.24, 0.78, 0.72)
    ),
    PatternFolder(name="bench", pattern="gelsight_driver/**/*.avi", truth=Pattern.MARKERS),
    PatternFolder(name="GelSLAM", pattern="gelslam/**/*.png", truth=Pattern.BARE),
    PatternFolder(name="sim2real", pattern="gelsight_sim2real/real/**/*.*g", truth=Pattern.BARE),
    PatternFolder(name="FOTS, Mini", pattern="FOTS/mlp_calib/gelsight/*.png", truth=Pattern.BARE),
    PatternFolder(name="FOTS, DIGIT", pattern="FOTS/mlp_calib/digit/*.png", truth=Pattern.BARE),
    PatternFolder(name="FeelAnyForce", pattern="feelanyforce/**/*.png", truth=Pattern.BARE),
    PatternFolder(name="gs_sdk", pattern="gs_sdk/data/*.png", truth=Pattern.BARE),
    PatternFolder(name="NormalFlow", pattern="normalflow/*.png", truth=Pattern.BARE),
    PatternFolder(name="ShapeMap3D", pattern="gsmini_shapemap/**/frame_*.*g", truth=Pattern.BARE),
    PatternFolder(name="PhysiCLeAR", pattern="physiclear/videos/*.mov", truth=Pattern.BARE),
    PatternFolder(name="EstimateModulus", pattern="EstimateModulus/**/*.avi", truth=Pattern.BARE),
    PatternFolder(name="9DTact", pattern="9DTact/**/depth_calibration/rectify_*.png", truth=Pattern.BARE),
)
"""What the data directory may hold; the thresholds were set on a tenth of each."""


def panel(data_dir: pathlib.Path, most: int, context: Context) -> FieldSection:
    """Judge at most `most` pictures of every folder, evenly chosen."""
    rows = [(folder, _judged(folder, data_dir, most)) for folder in context.each("patterns", FOLDERS)]
    present = [(folder, judged) for folder, judged in rows if sum(judged.values())]
    if not present:
        raise FileNotFoundError(f"data_dir is {data_dir}: must hold one of {[f.pattern for f in FOLDERS]}; correct it")
    rates = {truth: _rate(present, truth) for truth in (Pattern.BARE, Pattern.MARKERS)}
    names = {Pattern.BARE: "bare gels taken for patterned ones", Pattern.MARKERS: "marker gels refused"}
    return FieldSection(
        verdict=tuple(f"{names[t]}: {wrong} of {count}." for t, (wrong, count) in rates.items()),
        requirements=tuple(
            Requirement(name=names[t], measured=wrong / count, bound=0.01, better="lower", note=f"{wrong} of {count}")
            for t, (wrong, count) in rates.items()
            if count
        ),
        tables=(
            Table(
                title="What each gel is taken for",
                columns=(
                    Column(name="folder"),
                    Column(name="truth"),
                    *(Column(name=p.value, format="d") for p in Pattern),
                ),
                rows=tuple((f.name, f.truth.value, *(judged[p] for p in Pattern)) for f, judged in present),
                note="Every picture is judged as if it were the one at rest; most are under load, which is harder.",
            ),
        ),
    )


def _judged(folder: PatternFolder, data_dir: pathlib.Path, most: int) -> collections.Counter[Pattern]:
    paths = sorted(data_dir.glob(folder.pattern))
    chosen = paths[:: max(1, -(-len(paths) // most))]
    return collections.Counter(_pattern(path, folder.crop) for path in chosen)


def _pattern(path: pathlib.Path, crop: Crop) -> Pattern:
    grey = cv2.cvtColor(load(path), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    left, top, right, bottom = crop
    return examine(grey[int(top * height) : int(bottom * height), int(left * width) : int(right * width)]).pattern


def _rate(present: Sequence[tuple[PatternFolder, collections.Counter[Pattern]]], truth: Pattern) -> tuple[int, int]:
    """Pictures of a kind that are wrongly refused or wrongly let pass, and all of that kind."""
    of = [judged for folder, judged in present if folder.truth is truth]
    total, refused = sum(sum(j.values()) for j in of), sum(j[Pattern.BARE] for j in of)
    return total - refused if truth is Pattern.BARE else refused, total
