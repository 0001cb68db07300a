"""How often the flags of tracking fire on real pictures of marker gels under ordinary load."""

import collections
import dataclasses
import pathlib
from collections.abc import Iterator

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Column, Table
from experiments.fields.gels_at_rest import load, reduced
from experiments.fields.sections import FieldSection
from sensors_io.fields.deformation import DeformationReader
from sensors_io.importers.keep import Keep
from sensors_io.importers.video import read_video
from sensors_io.quality import QualityConfig, saturated
from sensors_io.schema import Flag

SHOWN = (Flag.MARKER_LOSS, Flag.SATURATED)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoadedGelFolder:
    """Pictures of one gel under load, and of the same gel at rest.

    Args:
      name: as it is shown.
      rest: pattern of the picture at rest, the first that matches; of a video its first frame.
      pattern: of the pictures, in the order of time where there is one.
    """

    name: str
    rest: str
    pattern: str


FOLDERS = (
    LoadedGelFolder(name="GelSight Mini", rest="FOTS/marker_calib/data/0.png", pattern="FOTS/marker_calib/data/1.png"),
    LoadedGelFolder(name="GelSlim", rest="gelslim/test_data/ref.jpg", pattern="gelslim/test_data/sample_*.jpg"),
    LoadedGelFolder(
        name="GelSlim 2",
        rest="gelsight_heightmap/test_data/ref.jpg",
        pattern="gelsight_heightmap/test_data/sample_*.jpg",
    ),
    LoadedGelFolder(
        name="GelSight bench",
        rest="gelsight_driver/track_markers/video.avi",
        pattern="gelsight_driver/track_markers/video.avi",
    ),
    *(
        LoadedGelFolder(
            name=f"gripper, {kind} {trial}",
            rest=f"letac_mpc/{kind}/tr_{trial}_dp_1_*/*frame000001.jpg",
            pattern=f"letac_mpc/{kind}/tr_{trial}_*/*.jpg",
        )
        for kind, trial in (("gel", 216), ("hard_rubber", 20), ("3D_printing_1", 100))
    ),
)
"""No limit of the two flags was set with the flags on these pictures in view."""


def panel(data_dir: pathlib.Path, context: Context) -> FieldSection:
    """Counts of each flag by recording.

    Raises:
      FileNotFoundError: none of the recordings lies in the directory.
    """
    counts = {folder.name: _counted(folder, data_dir) for folder in context.each("flags", FOLDERS)}
    present = {name: count for name, count in counts.items() if count["frames"]}
    if not present:
        raise FileNotFoundError(f"data_dir is {data_dir}: must hold one of {[f.pattern for f in FOLDERS]}; correct it")
    total = sum(count["frames"] for count in present.values())
    flagged = sum(count["flagged"] for count in present.values())
    return FieldSection(
        verdict=(f"On {total} real pictures of loaded marker gels {flagged} carry a flag of tracking.",),
        tables=(
            Table(
                title="Flags on real pictures of marker gels under load",
                columns=(
                    Column(name="recording"),
                    Column(name="pictures", format="d"),
                    *(Column(name=str(flag.name).lower(), format="d") for flag in SHOWN),
                ),
                rows=tuple(
                    (name, count["frames"], *(count[str(flag.name)] for flag in SHOWN))
                    for name, count in present.items()
                ),
                note="Which of them truly lost markers is not known, so this bounds the false alarms from above.",
            ),
        ),
    )


def _counted(folder: LoadedGelFolder, data_dir: pathlib.Path) -> collections.Counter[str]:
    counts: collections.Counter[str] = collections.Counter()
    at_rest = sorted(data_dir.glob(folder.rest))
    if not at_rest:
        return counts
    rest = load(at_rest[0])
    reader = DeformationReader(rest, mm_per_px=1.0)
    for picture in _pictures(folder, data_dir):
        flags = reader.read(picture, gap=True).flags
        if saturated(picture[None], rest, QualityConfig())[0]:
            flags |= Flag.SATURATED
        counts.update(["frames", *(["flagged"] if flags else []), *(str(f.name) for f in SHOWN if f & flags)])
    return counts


def _pictures(folder: LoadedGelFolder, data_dir: pathlib.Path) -> Iterator[np.ndarray]:
    for path in sorted(data_dir.glob(folder.pattern)):
        if path.suffix == ".avi":
            yield from (reduced(f) for f in read_video(path, Keep(height=0, stride=1, max_frames=0)).frames)
        else:
            yield load(path)
