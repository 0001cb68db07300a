"""Tracking under stress: known motion on one gel, under seven kinds of stress from harmless to hopeless."""

import dataclasses
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from experiments.fields.known_motion import NOISE_GREY, GelAtRest, GelCamera, GelMotion, TrackedGel, grey, tracked
from experiments.fields.stress import Stress, StressOutcome
from experiments.fields.trackers import FOLLOWERS
from sensors_io.fields.deformation import LOST_SHARE
from sensors_io.quality import QualityConfig, saturated
from sensors_io.schema import Flag

OFF_PX = 1.0
"""Distance from the truth from which a point is wrong."""

STRESSES = (
    Stress(name="displacement, px", levels=(2, 8, 16, 24, 32, 48)),
    Stress(name="gap: share of 24 px at once", levels=(1 / 6, 1 / 4, 1 / 3, 1 / 2, 1)),
    Stress(name="dots lost, share", levels=(0.02, 0.1, 0.25, 0.5, 0.75, 0.9)),
    Stress(name="noise, grey levels", levels=(2, 5, 10, 20, 40, 80)),
    Stress(name="exposure, down", levels=(0.8, 0.5, 0.25, 0.12, 0.06, 0.03)),
    Stress(name="exposure, up", levels=(1.1, 1.3, 1.6, 2.0, 3.0, 5.0)),
    Stress(name="contact from the border, width", levels=(0.4, 0.2, 0.1, 0.0, -0.1)),
)

_PEAK_PX, _JUMP_PX = 8.0, 24.0  # greatest displacement under other stresses and under gaps, on a picture 320 wide
_STEPS = 6  # pictures in which the motion grows
_ERASED_RADII = 1.6  # radius of what is painted over, in radii of a dot


def attempt_tracking(
    rest: GelAtRest, methods: Sequence[str], seed: int, stresses: Sequence[Stress] = STRESSES
) -> Iterator[tuple[str, str, float, StressOutcome]]:
    """Method, stress, level and outcome, of all methods under all stresses on one gel.

    The error is the 95th percentile of the distance from the truth over the points that a method gives, in pixels;
    wrong is the share of all points that it gives and that are off by more than `OFF_PX`.
    """
    gel = tracked(rest)
    for stress in stresses:
        for level in stress.levels:
            camera, pictures, true = _sequence(gel, stress.name, level, seed)
            background = camera.at_rest()
            clipped = bool(saturated(pictures[-1][None], background, QualityConfig())[0])
            still, greys = grey(background), [grey(p) for p in pictures]
            for name in methods:
                follow = FOLLOWERS[name](still, gel.points_px, gel.half_px)
                for picture in greys:
                    points = follow(picture)
                outcome = _outcome(points, true, gel, clipped and name.startswith("this"))
                yield name, stress.name, level, outcome


def _outcome(points: np.ndarray, true: np.ndarray, gel: TrackedGel, clipped: bool) -> StressOutcome:
    inside = gel.inside(true)
    error = np.hypot(*(points - true).T)[inside]
    given = np.isfinite(error)
    lost = float(np.mean(~np.isfinite(points[:, 0])))
    return StressOutcome(
        error=float(np.quantile(error[given], 0.95)) if given.any() else np.inf,
        wrong=float(np.mean(given & (error > OFF_PX))) if inside.any() else 0.0,
        flags=(Flag.SATURATED if clipped else Flag.NONE) | (Flag.MARKER_LOSS if lost > LOST_SHARE else Flag.NONE),
    )


def _sequence(gel: TrackedGel, stress: str, level: float, seed: int) -> tuple[GelCamera, list[np.ndarray], np.ndarray]:
    """The camera of the gel at rest, pictures under a growing motion, and the true points in the last of them."""
    kind = stress.split(",")[0].split(":")[0]
    noise = level if kind == "noise" else NOISE_GREY
    camera = GelCamera(gel.rest.picture, noise, seed)
    moving = GelCamera(_erased(gel, level, seed), noise, seed) if kind == "dots lost" else camera
    motion = _motion(gel, kind, level, seed)
    steps = max(1, round(1 / level)) if kind == "gap" else _STEPS
    exposure = level if kind == "exposure" else 1.0
    pictures = [moving.under(motion.times(i / steps), i / steps, exposure) for i in range(1, steps + 1)]
    return camera, pictures, gel.points_px + motion.forward(gel.points_px)


def _motion(gel: TrackedGel, kind: str, level: float, seed: int) -> GelMotion:
    match kind:
        case "displacement":
            return gel.motion(level, seed)
        case "gap":
            return gel.motion(_JUMP_PX, seed)
        case "contact from the border":
            usual = gel.motion(_PEAK_PX, seed)
            return dataclasses.replace(usual, centre_px=(level * gel.rest.picture.shape[1], usual.centre_px[1]))
        case _:
            return gel.motion(_PEAK_PX, seed)


def _erased(gel: TrackedGel, share: float, seed: int) -> np.ndarray:
    """The picture of the gel with a share of its dots painted over."""
    rng = np.random.default_rng(seed)
    gone = rng.permutation(len(gel.points_px))[: round(share * len(gel.points_px))]
    mask = np.zeros(gel.rest.picture.shape[:2], np.uint8)
    radius = round(_ERASED_RADII * gel.dot_radius_px)
    for x, y in np.round(gel.points_px[gone]).astype(int):
        cv2.circle(mask, (int(x), int(y)), radius, 255, -1)
    return cv2.inpaint(gel.rest.picture, mask, 3, cv2.INPAINT_TELEA)
