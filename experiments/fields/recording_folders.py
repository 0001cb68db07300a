"""The published recordings of real sensors, by folder: where pictures and background lie, and what pressed them."""

import dataclasses
import pathlib

import cv2
import numpy as np

from sensors_io.fields.sources import read_picture


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordingFolder:
    """One recording.

    Args:
      name: as it is shown.
      path: of its folder.
      pattern: of its pictures.
      background: its picture of the gel at rest.
      mm_per_px: pitch.
      ball_diameter_mm: of the ball that pressed it, `None` where other things did.
      remark: what its pictures show and what is not the gel's doing.
    """

    name: str
    path: str
    pattern: str
    background: str
    mm_per_px: float
    ball_diameter_mm: float | None = None
    remark: str = ""


FOLDERS = (
    RecordingFolder(
        name="gelslam", path="gelslam", pattern="6.310mm/*/gelsight.png", background="background.png",
        mm_per_px=0.0634, ball_diameter_mm=6.31,
    ),
    RecordingFolder(
        name="gelsight sim2real", path="gelsight_sim2real/quantitative_real_gan", pattern="calib_*.png",
        background="background_real.png", mm_per_px=0.0592593, ball_diameter_mm=5.84,
    ),
    RecordingFolder(
        name="FOTS Mini", path="FOTS/mlp_calib", pattern="gelsight/*.png", background="0000.png",
        mm_per_px=1 / 19.58, ball_diameter_mm=4.70,
        remark="The gel slopes over the whole window: no zero level, depth is good up to a tilt and a constant",
    ),
    RecordingFolder(
        name="ShapeMap3D Mini", path="gsmini_shapemap/calib_ball", pattern="frame_*.jpg", background="frame_0.png",
        mm_per_px=0.08, ball_diameter_mm=4.0,
        remark="Lens and light differ from the gel at rest all along the border: no zero level, absolute depth and the "
        "outlines in the corners mean nothing",
    ),
    RecordingFolder(
        name="FOTS DIGIT", path="FOTS", pattern="mlp_calib/digit/*.png", background="assets/gel/digit_bg.png",
        mm_per_px=0.0657,
    ),
    RecordingFolder(
        name="GelSlim", path="gelslim/test_data", pattern="sample_*.jpg", background="ref.jpg",
        mm_per_px=0.10577, ball_diameter_mm=7.6,
        remark="The outlines at the upper and lower border are no contacts: the lamps there have drifted since the "
        "gel at rest was recorded, and no threshold that keeps a light second touch removes them",
    ),
    RecordingFolder(
        name="GelSlim heightmap", path="gelsight_heightmap/test_data", pattern="sample_*.jpg", background="ref.jpg",
        mm_per_px=0.10577, ball_diameter_mm=7.6,
    ),
    RecordingFolder(
        name="wedge", path="wyh5625_wedge/calibration", pattern="ball-*.jpg", background="bg-0.jpg",
        mm_per_px=0.1, ball_diameter_mm=3.96,
    ),
    RecordingFolder(
        name="GelSight bench", path="gelsight_driver/calibration/cali_180110", pattern="Im_*.jpg",
        background="frame0.jpg", mm_per_px=0.0254, ball_diameter_mm=3.96,
    ),
    RecordingFolder(
        name="FeelAnyForce, untouched", path="feelanyforce", pattern="tactile/*.png", background="background.png",
        mm_per_px=0.0634,
    ),
    RecordingFolder(
        name="gs_sdk objects", path="gs_sdk/data", pattern="[bks]e*.png", background="background.png", mm_per_px=0.0634,
    ),
)  # fmt: skip
"""Pitches and diameters as the authors' code states them."""


def read_folder(folder: RecordingFolder, root: pathlib.Path) -> tuple[np.ndarray, tuple[str, ...], np.ndarray]:
    """Pictures uint8 [N, H, W, 3], their names, and the background [H, W, 3] at the size of the pictures.

    Raises:
      FileNotFoundError: no picture of that pattern.
    """
    base = root / folder.path
    paths = sorted(path for path in base.glob(folder.pattern) if path != base / folder.background)
    if not paths:
        raise FileNotFoundError(f"{base} holds no {folder.pattern}: must hold the recording; copy it whole")
    frames = np.stack([read_picture(path) for path in paths])
    background = read_picture(base / folder.background)
    if background.shape != frames.shape[1:]:
        background = cv2.resize(background, frames.shape[2:0:-1], interpolation=cv2.INTER_AREA)
    return frames, tuple(str(path.relative_to(base)) for path in paths), background
