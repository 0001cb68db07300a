"""The published recordings that depth is measured on, read from a folder of folders, and their truths."""

import pathlib
import re

import cv2
import numpy as np

from sensors_io.calibration.presses import BallPresses
from sensors_io.fields.sources import read_picture, read_pictures

SIM2REAL_MM = 0.0592593
"""Pitch of gelsight_sim2real, mm/px, as its code states it."""

_SPHERE_MM, _SPHERE_PX, _KEPT = 2.92, (208, 166), 0.85  # radius, centre, share of the contact radius that is scored
_PRISM_PX = ((172, 114), (242, 220))
_TRIANGLE_PX = ((161, 137), (212, 132), (250, 193))


def gelslam(root: pathlib.Path) -> BallPresses:
    """44 presses of a ball of 6.31 mm into a GelSight Mini, 320 × 240 px."""
    folder = root / "gelslam"
    pictures = read_pictures([folder / "6.310mm"], "gelsight_mini").frames
    background = read_picture(folder / "background.png")
    return BallPresses(pictures=pictures, background=background, radius_mm=6.31 / 2, mm_per_px=0.0634)


def sim2real(root: pathlib.Path) -> BallPresses:
    """22 presses of a ball of 5.84 mm into a GelSight of Tsinghua's, 320 × 320 px, without those at known depth."""
    folder = root / "gelsight_sim2real" / "quantitative_real_gan"
    pictures = np.stack([read_picture(path) for path in sorted(folder.glob("calib_*_real.png"))])
    background = read_picture(folder / "background_real.png")
    return BallPresses(pictures=pictures, background=background, radius_mm=_SPHERE_MM, mm_per_px=SIM2REAL_MM)


def fots(root: pathlib.Path) -> BallPresses:
    """42 presses of a ball of 4.70 mm into another GelSight Mini, 240 × 320 px."""
    folder = root / "FOTS" / "mlp_calib"
    pictures = read_pictures([folder / "gelsight"], "gelsight_mini").frames
    background = read_picture(folder / "0000.png")
    return BallPresses(pictures=pictures, background=background, radius_mm=4.70 / 2, mm_per_px=1 / 19.58)


def feelanyforce(root: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """25 pictures of a GelSight Mini that nothing touches, and its background."""
    folder = root / "feelanyforce"
    return read_pictures([folder / "tactile"], "gelsight_mini").frames, read_picture(folder / "background.png")


def feelanyforce_rows(root: pathlib.Path) -> np.ndarray:
    """Force and torque of the rows of its table, float64 [N, 6], NaN where a row holds none."""
    (table,) = (root / "feelanyforce").glob("*.csv")
    cells = [line.rstrip("\n").split(",")[-1].split() for line in table.read_text().splitlines()[1:]]
    return np.array([[float(c) for c in row] if len(row) == 6 else [np.nan] * 6 for row in cells])


def known_depths(root: pathlib.Path) -> dict[tuple[str, float], np.ndarray]:
    """(shape, depth in mm) → picture of the presses at known depth."""
    found = {}
    for path in sorted((root / "gelsight_sim2real" / "quantitative_real_gan").glob("*_real.png")):
        name = re.fullmatch(r"(sphere|prism|triangle)_([\d.]+)_real", path.stem)
        if name:
            found[name[1], float(name[2])] = read_picture(path)
    return found


def known_truth(shape: str, depth_mm: float, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the rigid indenter, mm, and the pixels that are scored, as the authors' evaluation has them."""
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
