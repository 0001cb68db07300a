"""False alarms on real pictures: flags of tracking on loaded marker gels, and bare gels taken for marker gels."""

import collections
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from experiments.core.context import Context
from experiments.core.results import ReportPart, at_most, named_table
from sensors_io.calibration.published import load, reduced
from sensors_io.fields.deformation import DeformationReader
from sensors_io.fields.evidence import Pattern, examine
from sensors_io.importers.keep import Keep
from sensors_io.importers.video import read_video
from sensors_io.quality import QualityConfig, saturated
from sensors_io.schema import Flag

SHOWN = (Flag.MARKER_LOSS, Flag.SATURATED)  # flags of tracking
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


MARKER_GELS = {
    "FOTS, markers": "FOTS/marker_calib/data/*.png",
    "GelSlim": "gelslim/**/*.jpg",
    "GelSlim 2": "gelsight_heightmap/**/*.jpg",
    "gripper": "letac_mpc/**/*.jpg",
    "wedge": "wyh5625_wedge/calibration/*.jpg",
    "bench": "gelsight_driver/**/*.avi",
}
BARE_GELS = {
    "GelSLAM": "gelslam/**/*.png",
    "sim2real": "gelsight_sim2real/real/**/*.*g",
    "FOTS, Mini": "FOTS/mlp_calib/gelsight/*.png",
    "FOTS, DIGIT": "FOTS/mlp_calib/digit/*.png",
    "FeelAnyForce": "feelanyforce/**/*.png",
    "gs_sdk": "gs_sdk/data/*.png",
    "NormalFlow": "normalflow/*.png",
    "ShapeMap3D": "gsmini_shapemap/**/frame_*.*g",
    "PhysiCLeAR": "physiclear/videos/*.mov",
    "EstimateModulus": "EstimateModulus/**/*.avi",
    "9DTact": "9DTact/**/depth_calibration/rectify_*.png",
}
"""Name → pattern of the pictures in the data directory; the thresholds were set on a tenth of each."""

CROPS = {"wedge": (0.24, 0.24, 0.78, 0.72)}
"""Left, top, right and bottom of the gel, as shares of width and height, where it does not fill the picture."""


def flag_section(data_dir: pathlib.Path, context: Context) -> list[ReportPart]:
    """Number of pictures of loaded gels with each flag, by recording.

    Raises:
      FileNotFoundError: none of the recordings is in the directory.
    """
    every = {name: _flag_counts(data_dir, *LOADED[name]) for name in context.each("flags", LOADED)}
    counts = _present(every, data_dir, [pattern for _, pattern in LOADED.values()])
    total, flagged = (sum(count[key] for count in counts.values()) for key in ("frames", "flagged"))
    flags = [str(f.name) for f in SHOWN]
    table = named_table(
        "Flags on real pictures of marker gels under load",
        [{"recording": n, "pictures": c["frames"]} | {f.lower(): c[f] for f in flags} for n, c in counts.items()],
        formats=dict.fromkeys(("pictures", *map(str.lower, flags)), "d"),
        note="Which of them truly lost markers is unknown, so this is an upper bound on the false alarms.",
    )
    return [f"Of {total} real pictures of loaded marker gels {flagged} carry a flag of tracking.", table]


def pattern_section(data_dir: pathlib.Path, most: int, context: Context) -> list[ReportPart]:
    """Recognition of bare and marker gels on at most `most` pictures of every folder, evenly chosen.

    Raises:
      FileNotFoundError: none of the recordings is in the directory.
    """
    patterns = MARKER_GELS | BARE_GELS
    every = {name: _pattern_counts(data_dir, name, patterns[name], most) for name in context.each("patterns", patterns)}
    counts = _present(every, data_dir, list(patterns.values()))
    parts: list[ReportPart] = []
    for folders, what in (
        (BARE_GELS, "Bare gels classified as patterned"),
        (MARKER_GELS, "Marker gels classified as bare"),
    ):
        of = [by for name, by in counts.items() if name in folders]
        total, bare = sum(by.total() for by in of), sum(by[Pattern.BARE] for by in of)
        wrong = total - bare if folders is BARE_GELS else bare
        parts.append(f"{what}: {wrong} of {total}.")
        if total:
            parts.append(at_most(what, wrong / total, 0.01, note=f"{wrong} of {total}"))
    truth = dict.fromkeys(MARKER_GELS, Pattern.MARKERS) | dict.fromkeys(BARE_GELS, Pattern.BARE)
    table = named_table(
        "Classification of gels",
        [{"folder": n, "truth": truth[n].value} | {p.value: by[p] for p in Pattern} for n, by in counts.items()],
        formats={p.value: "d" for p in Pattern},
        note="Every picture is classified as if it were the one at rest; most are under load, which is harder.",
    )
    return [*parts, table]


def _present(
    counts: Mapping[str, collections.Counter[Any]], data_dir: pathlib.Path, patterns: Sequence[str]
) -> dict[str, collections.Counter[Any]]:
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


def _pattern_counts(data_dir: pathlib.Path, name: str, pattern: str, most: int) -> collections.Counter[Pattern]:
    paths = sorted(data_dir.glob(pattern))
    counts: collections.Counter[Pattern] = collections.Counter()
    for path in paths[:: max(1, -(-len(paths) // most))]:
        grey = cv2.cvtColor(load(path), cv2.COLOR_RGB2GRAY)
        (height, width), (left, top, right, bottom) = grey.shape, CROPS.get(name, (0.0, 0.0, 1.0, 1.0))
        part = grey[int(top * height) : int(bottom * height), int(left * width) : int(right * width)]
        counts[examine(part).pattern] += 1
    return counts
