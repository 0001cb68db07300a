"""False alarms on real pictures: flags of tracking on loaded marker gels, and bare gels taken for marker gels."""

import collections
import dataclasses
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

import cv2
import numpy as np

from experiments.core.context import Context
from experiments.core.results import at_most, named_table
from experiments.fields.published import load, reduced
from experiments.fields.sections import FieldSection
from sensors_io.fields.deformation import DeformationReader
from sensors_io.fields.evidence import Pattern, examine
from sensors_io.importers.keep import Keep
from sensors_io.importers.video import read_video
from sensors_io.quality import QualityConfig, saturated
from sensors_io.schema import Flag

Key = TypeVar("Key")

SHOWN = (Flag.MARKER_LOSS, Flag.SATURATED)
"""Flags of tracking."""

LOADED = {
    "GelSight Mini": ("FOTS/marker_calib/data/0.png", "FOTS/marker_calib/data/1.png"),
    "GelSlim": ("gelslim/test_data/ref.jpg", "gelslim/test_data/sample_*.jpg"),
    "GelSlim 2": ("gelsight_heightmap/test_data/ref.jpg", "gelsight_heightmap/test_data/sample_*.jpg"),
    "GelSight bench": ("gelsight_driver/track_markers/video.avi", "gelsight_driver/track_markers/video.avi"),
    **{
        f"gripper, {kind} {trial}": (
            f"letac_mpc/{kind}/tr_{trial}_dp_1_*/*frame000001.jpg",
            f"letac_mpc/{kind}/tr_{trial}_*/*.jpg",
        )
        for kind, trial in (("gel", 216), ("hard_rubber", 20), ("3D_printing_1", 100))
    },
}
"""Recording of a gel under load → pattern of the picture at rest (of a video its first frame), pattern of the pictures.

The limits of the flags were chosen without looking at the flags on these pictures.
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PatternFolder:
    """Pictures of one gel: their pattern, what the gel carries, and the part of the picture that shows it.

    `crop` is left, top, right and bottom, as shares of width and height.
    """

    pattern: str
    truth: Pattern
    crop: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)


PATTERNS = {
    "FOTS, markers": PatternFolder(pattern="FOTS/marker_calib/data/*.png", truth=Pattern.MARKERS),
    "GelSlim": PatternFolder(pattern="gelslim/**/*.jpg", truth=Pattern.MARKERS),
    "GelSlim 2": PatternFolder(pattern="gelsight_heightmap/**/*.jpg", truth=Pattern.MARKERS),
    "gripper": PatternFolder(pattern="letac_mpc/**/*.jpg", truth=Pattern.MARKERS),
    "wedge": PatternFolder(
        pattern="wyh5625_wedge/calibration/*.jpg", truth=Pattern.MARKERS, crop=(0.24, 0.24, 0.78, 0.72)
    ),
    "bench": PatternFolder(pattern="gelsight_driver/**/*.avi", truth=Pattern.MARKERS),
    "GelSLAM": PatternFolder(pattern="gelslam/**/*.png", truth=Pattern.BARE),
    "sim2real": PatternFolder(pattern="gelsight_sim2real/real/**/*.*g", truth=Pattern.BARE),
    "FOTS, Mini": PatternFolder(pattern="FOTS/mlp_calib/gelsight/*.png", truth=Pattern.BARE),
    "FOTS, DIGIT": PatternFolder(pattern="FOTS/mlp_calib/digit/*.png", truth=Pattern.BARE),
    "FeelAnyForce": PatternFolder(pattern="feelanyforce/**/*.png", truth=Pattern.BARE),
    "gs_sdk": PatternFolder(pattern="gs_sdk/data/*.png", truth=Pattern.BARE),
    "NormalFlow": PatternFolder(pattern="normalflow/*.png", truth=Pattern.BARE),
    "ShapeMap3D": PatternFolder(pattern="gsmini_shapemap/**/frame_*.*g", truth=Pattern.BARE),
    "PhysiCLeAR": PatternFolder(pattern="physiclear/videos/*.mov", truth=Pattern.BARE),
    "EstimateModulus": PatternFolder(pattern="EstimateModulus/**/*.avi", truth=Pattern.BARE),
    "9DTact": PatternFolder(pattern="9DTact/**/depth_calibration/rectify_*.png", truth=Pattern.BARE),
}
"""Name → folder that the data directory may hold; the thresholds were set on a tenth of each."""


def flag_section(data_dir: pathlib.Path, context: Context) -> FieldSection:
    """Number of pictures of loaded gels with each flag, by recording.

    Raises:
      FileNotFoundError: none of the recordings is in the directory.
    """
    every = {name: _flag_counts(data_dir, *LOADED[name]) for name in context.each("flags", LOADED)}
    counts = _present(every, data_dir, [pattern for _, pattern in LOADED.values()])
    total, flagged = (sum(count[key] for count in counts.values()) for key in ("frames", "flagged"))
    rows = [
        {"recording": name, "pictures": count["frames"]} | {str(f.name).lower(): count[str(f.name)] for f in SHOWN}
        for name, count in counts.items()
    ]
    table = named_table(
        "Flags on real pictures of marker gels under load",
        rows,
        formats=dict.fromkeys(list(rows[0])[1:], "d"),
        note="Which of them truly lost markers is unknown, so this is an upper bound on the false alarms.",
    )
    sentence = f"Of {total} real pictures of loaded marker gels {flagged} carry a flag of tracking."
    return FieldSection(verdict=(sentence,), tables=(table,))


def pattern_section(data_dir: pathlib.Path, most: int, context: Context) -> FieldSection:
    """Recognition of bare and marker gels on at most `most` pictures of every folder, evenly chosen.

    Raises:
      FileNotFoundError: none of the recordings is in the directory.
    """
    every = {name: _pattern_counts(data_dir, PATTERNS[name], most) for name in context.each("patterns", PATTERNS)}
    counts = _present(every, data_dir, [folder.pattern for folder in PATTERNS.values()])
    verdict, requirements = [], []
    for truth, what in ((Pattern.BARE, "bare gels taken for patterned ones"), (Pattern.MARKERS, "marker gels refused")):
        of = [by for name, by in counts.items() if PATTERNS[name].truth is truth]
        total, bare = sum(sum(by.values()) for by in of), sum(by[Pattern.BARE] for by in of)
        wrong = total - bare if truth is Pattern.BARE else bare
        verdict.append(f"{what}: {wrong} of {total}.")
        if total:
            requirements.append(at_most(what, wrong / total, 0.01, note=f"{wrong} of {total}"))
    rows = [
        {"folder": name, "truth": PATTERNS[name].truth.value} | {p.value: by[p] for p in Pattern}
        for name, by in counts.items()
    ]
    table = named_table(
        "What each gel is taken for",
        rows,
        formats={p.value: "d" for p in Pattern},
        note="Every picture is classified as if it were the one at rest; most are under load, which is harder.",
    )
    return FieldSection(verdict=tuple(verdict), requirements=tuple(requirements), tables=(table,))


def _present(
    counts: Mapping[str, collections.Counter[Key]], data_dir: pathlib.Path, patterns: Sequence[str]
) -> dict[str, collections.Counter[Key]]:
    """The recordings with pictures."""
    present = {name: count for name, count in counts.items() if count.total()}
    if not present:
        raise FileNotFoundError(f"data_dir is {data_dir}: must hold one of {list(patterns)}; correct it")
    return present


def _flag_counts(data_dir: pathlib.Path, at_rest: str, pattern: str) -> collections.Counter[str]:
    """Number of pictures, of flagged pictures and of each flag; empty where there is no picture at rest."""
    counts: collections.Counter[str] = collections.Counter()
    found = sorted(data_dir.glob(at_rest))
    if not found:
        return counts
    rest = load(found[0])
    reader = DeformationReader(rest, mm_per_px=1.0)
    for picture in _pictures(data_dir, pattern):
        flags = reader.read(picture, gap=True).flags
        if saturated(picture[None], rest, QualityConfig())[0]:
            flags |= Flag.SATURATED
        counts.update(["frames", *(["flagged"] if flags else []), *(str(f.name) for f in SHOWN if f & flags)])
    return counts


def _pictures(data_dir: pathlib.Path, pattern: str) -> Iterator[np.ndarray]:
    for path in sorted(data_dir.glob(pattern)):
        if path.suffix == ".avi":
            yield from (reduced(f) for f in read_video(path, Keep(height=0, stride=1, max_frames=0)).frames)
        else:
            yield load(path)


def _pattern_counts(data_dir: pathlib.Path, folder: PatternFolder, most: int) -> collections.Counter[Pattern]:
    paths = sorted(data_dir.glob(folder.pattern))
    counts: collections.Counter[Pattern] = collections.Counter()
    for path in paths[:: max(1, -(-len(paths) // most))]:
        grey = cv2.cvtColor(load(path), cv2.COLOR_RGB2GRAY)
        (height, width), (left, top, right, bottom) = grey.shape, folder.crop
        part = grey[int(top * height) : int(bottom * height), int(left * width) : int(right * width)]
        counts[examine(part).pattern] += 1
    return counts
