"""Error of a calibration on unseen presses: depth and radius of the reconstructed ball."""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy import optimize

from sensors_io.calibration.circles import align_circles, find_circles
from sensors_io.calibration.fit import fit_map
from sensors_io.calibration.presses import BallPresses
from sensors_io.fields.depth import DepthReader
from sensors_io.fields.types import Calibration, CalibrationError

INNER = 0.7
"""Contact radii from the centre, within which a reconstruction is scored: safely on the ball."""

LEAST_SHARE = 0.12
"""Of that disc, which must lie in the picture: less of a ball does not tell its radius."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BallErrors:
    """Of each press, [P]; NaN where less than `LEAST_SHARE` of the scored disc is in the picture.

    Args:
      depth_um: rms of depth against a sphere of the true radius, centre and offset fitted.
      radius_share: relative error of the radius, fitted with the rest.
      tip_mm: absolute depth at its greatest, against untouched gel.
    """

    depth_um: np.ndarray
    radius_share: np.ndarray
    tip_mm: np.ndarray

    def figures(self) -> dict[str, float]:
        """Medians and 90th percentiles over the presses.

        Raises:
          CalibrationError: no press could be scored.
        """
        depth, radius = self.depth_um[np.isfinite(self.depth_um)], self.radius_share[np.isfinite(self.radius_share)]
        if not len(depth):
            raise CalibrationError("no ball lies far enough in the picture to be scored; press nearer to the middle")
        return {
            "presses": float(len(depth)),
            "depth rmse median, um": float(np.median(depth)),
            "depth rmse p90, um": float(np.quantile(depth, 0.9)),
            "radius error median, %": 100 * float(np.median(np.abs(radius))),
            "radius error p90, %": 100 * float(np.quantile(np.abs(radius), 0.9)),
            "radius error of the median, %": 100 * float(np.median(radius)),
            "tip depth median, mm": float(np.nanmedian(self.tip_mm)),
        }


def score_ball(depth_mm: np.ndarray, touch: np.ndarray, radius_mm: float, mm_per_px: float) -> tuple[float, float]:
    """Depth rmse in µm with centre and offset fitted, and relative error of the radius with all four fitted.

        u(x, y) = c + √(R² − (x − x_0)² − (y − y_0)²)   within `INNER` contact radii

    Args:
      depth_mm: float [H, W].
      touch: x, y, contact radius, px.
      radius_mm: true radius.
      mm_per_px: pitch.

    Returns:
      NaN, NaN where too little of the ball is in the picture.
    """
    y, x = np.mgrid[: depth_mm.shape[0], : depth_mm.shape[1]]
    inner = np.hypot(x - touch[0], y - touch[1]) < INNER * touch[2]
    if inner.sum() < LEAST_SHARE * np.pi * (INNER * touch[2]) ** 2:
        return float("nan"), float("nan")
    x_mm, y_mm, depth = x[inner] * mm_per_px, y[inner] * mm_per_px, depth_mm[inner].astype(np.float64)

    def misfit(p: np.ndarray) -> np.ndarray:
        radius = p[3] if len(p) == 4 else radius_mm
        return p[2] + np.sqrt(np.maximum(radius**2 - (x_mm - p[0]) ** 2 - (y_mm - p[1]) ** 2, 1e-6)) - depth

    start = [touch[0] * mm_per_px, touch[1] * mm_per_px, depth.max() - radius_mm]
    placed = optimize.least_squares(misfit, start)
    free = optimize.least_squares(misfit, [*placed.x, radius_mm])
    return 1e3 * float(np.sqrt(np.mean(placed.fun**2))), float(free.x[3] / radius_mm - 1)


def score_presses(calibration: Calibration, presses: BallPresses, touches: np.ndarray) -> BallErrors:
    """Errors of every press, touches [P, 3] in px."""
    read = DepthReader(calibration)
    rows = []
    for picture, touch in zip(presses.pictures, touches, strict=True):
        depth, _ = read(picture)
        rows.append((*score_ball(depth, touch, presses.radius_mm, presses.mm_per_px), float(depth.max())))
    depth_um, radius, tip = np.array(rows).T
    return BallErrors(depth_um=depth_um, radius_share=radius, tip_mm=tip)


def cross_validate(
    presses: BallPresses,
    sensor: str,
    *,
    folds: int = 5,
    seed: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> BallErrors:
    """Errors of every press under a calibration made without it: circles, degrees and map from the other folds alone.

    The circle of a left-out press is found with the optics of the others; it says which pixels are scored, no more.
    `progress` is called with the number of folds that are done.
    """
    order = np.random.default_rng(seed).permutation(len(presses))
    rows = np.full((3, len(presses)), np.nan)
    for k in range(folds):
        out = order[k::folds]
        train = presses.chosen(np.setdiff1d(order, out))
        circles = find_circles(train)
        colours, _, _ = fit_map(train, circles.touches, seed=seed)
        made = Calibration(
            sensor=sensor, background=presses.background, mm_per_px=presses.mm_per_px, colours=colours, made_from={}
        )
        rest = presses.chosen(out)
        errors = score_presses(made, rest, align_circles(rest, circles.optics).touches.stacked())
        rows[:, out] = errors.depth_um, errors.radius_share, errors.tip_mm
        progress(k + 1)
    return BallErrors(depth_um=rows[0], radius_share=rows[1], tip_mm=rows[2])
