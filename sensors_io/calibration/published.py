"""The published recordings of real sensors: paths in a data directory, pitches, balls, and known depths."""

import pathlib
import re
from typing import NamedTuple

import cv2
import numpy as np

from sensors_io.calibration.presses import BallPresses
from sensors_io.errors import path_text
from sensors_io.fields.sources import read_picture, read_pictures

SIM2REAL = "gelsight_sim2real/quantitative_real_gan"
SIM2REAL_MM = 0.0592593  # pitch of gelsight_sim2real, mm/px, as its code gives it
_SPHERE_MM, _SPHERE_PX, _KEPT = 2.92, (208, 166), 0.85  # radius, centre, share of the contact radius that is scored
_PRISM_PX = ((172, 114), (242, 220))
_TRIANGLE_PX = ((161, 137), (212, 132), (250, 193))
_WIDEST_PX = 480  # wider pictures are reduced: their pixels are finer than their optics


class RecordingFolder(NamedTuple):
    """Pictures of one sensor in one folder of the data directory.

    Args:
      path, pattern, background: of the folder, of its pictures, and of the picture of the gel at rest.
      mm_per_px: pitch.
      ball_diameter_mm: of the ball that pressed the gel, `None` where other objects did.
      remark: limits of its fields.
    """

    path: str
    pattern: str
    background: str
    mm_per_px: float
    ball_diameter_mm: float | None = None
    remark: str = ""


FOLDERS = {
    "gelslam": RecordingFolder("gelslam", "6.310mm/*/gelsight.png", "background.png", 0.0634, 6.31),
    "gelsight sim2real": RecordingFolder(
        SIM2REAL, "calib_*.png", "background_real.png", SIM2REAL_MM, 2 * _SPHERE_MM
    ),
    "FOTS Mini": RecordingFolder(
        "FOTS/mlp_calib", "gelsight/*.png", "0000.png", 1 / 19.58, 4.70,
        "The gel slopes over the whole window, so there is no zero level: depth is known up to a tilt and a constant",
    ),
    "ShapeMap3D Mini": RecordingFolder(
        "gsmini_shapemap/calib_ball", "frame_*.jpg", "frame_0.png", 0.08, 4.0,
        "Lens and light differ from the gel at rest along the whole border, so there is no zero level: absolute depth "
        "and the outlines in the corners mean nothing",
    ),
    "FOTS DIGIT": RecordingFolder("FOTS", "mlp_calib/digit/*.png", "assets/gel/digit_bg.png", 0.0657),
    "GelSlim": RecordingFolder(
        "gelslim/test_data", "sample_*.jpg", "ref.jpg", 0.10577, 7.6,
        "The outlines at the upper and lower border are not contacts: the lamps there have drifted since the gel at "
        "rest was recorded, and no threshold that keeps a light second touch removes them",
    ),
    "GelSlim heightmap": RecordingFolder("gelsight_heightmap/test_data", "sample_*.jpg", "ref.jpg", 0.10577, 7.6),
    "wedge": RecordingFolder("wyh5625_wedge/calibration", "ball-*.jpg", "bg-0.jpg", 0.1, 3.96),
    "GelSight bench": RecordingFolder(
        "gelsight_driver/calibration/cali_180110", "Im_*.jpg", "frame0.jpg", 0.0254, 3.96
    ),
    "FeelAnyForce, untouched": RecordingFolder("feelanyforce", "tactile/*.png", "background.png", 0.0634),
    "gs_sdk objects": RecordingFolder("gs_sdk/data", "[bks]e*.png", "background.png", 0.0634),
}  # fmt: skip
"""Name → folder; pitches and diameters as the authors' code gives them."""


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


def ball_presses(name: str, root: pathlib.Path) -> BallPresses:
    """Presses of the ball of one of `FOLDERS`.

    Raises:
      ValueError: the folder's objects are not balls of one diameter.
      FileNotFoundError: as `read_folder`.
    """
    folder = FOLDERS[name]
    if folder.ball_diameter_mm is None:
        raise ValueError(f"{name} has no ball_diameter_mm: must be pressed by one ball; choose another folder")
    frames, _, background = read_folder(folder, root)
    return BallPresses(
        pictures=frames, background=background, radius_mm=folder.ball_diameter_mm / 2, mm_per_px=folder.mm_per_px
    )


def gelslam(root: pathlib.Path) -> BallPresses:
    """44 presses of a ball of 6.31 mm into a GelSight Mini, by number: published figures have folds in this order."""
    pictures = read_pictures([root / "gelslam" / "6.310mm"], "gelsight_mini").frames
    background = read_picture(root / "gelslam" / "background.png")
    return BallPresses(pictures=pictures, background=background, radius_mm=6.31 / 2, mm_per_px=0.0634)


def feelanyforce_rows(root: pathlib.Path) -> np.ndarray:
    """Force and torque in the rows of FeelAnyForce's table, float64 [N, 6], NaN where a row is empty."""
    (table,) = (root / "feelanyforce").glob("*.csv")
    cells = [line.rstrip("\n").split(",")[-1].split() for line in table.read_text(encoding="utf-8").splitlines()[1:]]
    return np.array([[float(c) for c in row] if len(row) == 6 else [np.nan] * 6 for row in cells])


def known_depths(root: pathlib.Path) -> dict[tuple[str, float], np.ndarray]:
    """(Shape, depth in mm) → picture, of the presses of gelsight_sim2real at known depth."""
    paths = {path.stem: path for path in sorted((root / SIM2REAL).glob("*_real.png"))}
    names = [re.fullmatch(r"(sphere|prism|triangle)_([\d.]+)_real", stem) for stem in paths]
    return {(name[1], float(name[2])): read_picture(paths[name[0]]) for name in names if name}


def known_truth(shape: str, depth_mm: float, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the rigid indenter, mm [H, W], and the pixels that the authors' evaluation scores, bool [H, W]."""
    mask = np.zeros(size, np.uint8)
    truth = np.full(size, depth_mm)
    if shape == "sphere":
        y, x = np.mgrid[: size[0], : size[1]]
        square = ((x - _SPHERE_PX[0]) ** 2 + (y - _SPHERE_PX[1]) ** 2) * SIM2REAL_MM**2
        edge = _SPHERE_MM**2 - (_SPHERE_MM - depth_mm) ** 2
        cv2.circle(mask, _SPHERE_PX, int(_KEPT * np.sqrt(edge) / SIM2REAL_MM), 1, -1)
        cap = np.sqrt(np.maximum(_SPHERE_MM**2 - square, 0)) - (_SPHERE_MM - depth_mm)
        truth = np.where(square < edge, cap, 0)
    elif shape == "prism":
        cv2.rectangle(mask, *_PRISM_PX, 1, -1)
    else:
        cv2.fillPoly(mask, [np.array(_TRIANGLE_PX, np.int32)], 1)
    return truth, mask.astype(bool)


def load(path: pathlib.Path, frame: int = 0) -> np.ndarray:
    """A picture, or one frame of a video, RGB uint8, at most 480 pixels wide by averaging.

    Raises:
      ValueError: a file that OpenCV cannot read.
    """
    picture = cv2.imread(path_text(path))
    if picture is None:
        reader = cv2.VideoCapture(path_text(path))
        for _ in range(frame + 1):
            _, picture = reader.read()
        reader.release()
        if picture is None:
            raise ValueError(f"{path} is no picture and no video of {frame + 1} frames that OpenCV reads; replace it")
    return cv2.cvtColor(reduced(picture), cv2.COLOR_BGR2RGB)


def reduced(picture: np.ndarray) -> np.ndarray:
    """A picture [H, W, 3] at most 480 pixels wide, by averaging over whole pixels."""
    factor = -(-picture.shape[1] // _WIDEST_PX)
    if factor == 1:
        return picture
    size = (picture.shape[1] // factor, picture.shape[0] // factor)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
