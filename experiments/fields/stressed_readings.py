"""Readings of tracking, shear and depth under stress, from harmless to hopeless.

Tracking sees known motion on one gel, shear generated slides, depth generated presses of a ball: their pictures come
from the optics that calibration assumes, and their depth is known at every pixel.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import cv2
import numpy as np

from experiments.core.context import Context
from experiments.fields.depth_methods import calibrated, depth_by, published_poisson, table_map
from experiments.fields.generated_slides import Slide, cached_slides, pressing
from experiments.fields.known_motion import NOISE_GREY as GEL_NOISE_GREY
from experiments.fields.known_motion import GelCamera, GelMotion, MarkerGel, grey
from experiments.fields.shear_accuracy import BASELINE, MAIN, SUBTRACTED, WITH_GRADIENT, shear_methods
from experiments.fields.stress import StressedField, StressOutcome
from experiments.fields.trackers import FOLLOWERS
from sensors_io.calibration.circles import find_circles
from sensors_io.calibration.generated_presses import (
    AXIS_MM,
    NOISE_GREY,
    WINDOW_MM,
    ball_profiles,
    fitted_optics,
    generated_presses,
    to_bytes,
)
from sensors_io.fields.deformation import LOST_SHARE
from sensors_io.fields.extract import Extractor
from sensors_io.fields.poisson import dirichlet
from sensors_io.fields.slopes import SlopeReader
from sensors_io.quality import QualityConfig, saturated
from sensors_io.scenes.sensors import TAC3D, SensorModel
from sensors_io.schema import Flag

Attempt = tuple[str, str, float, StressOutcome]  # method, stress, level, outcome

TRACKING = StressedField(
    name="tracking",
    stresses={
        "displacement, px": (2, 8, 16, 24, 32, 48),
        "gap: share of 24 px at once": (1 / 6, 1 / 4, 1 / 3, 1 / 2, 1),
        "dots lost, share": (0.02, 0.1, 0.25, 0.5, 0.75, 0.9),
        "noise, grey levels": (2, 5, 10, 20, 40, 80),
        "exposure, down": (0.8, 0.5, 0.25, 0.12, 0.06, 0.03),
        "exposure, up": (1.1, 1.3, 1.6, 2.0, 3.0, 5.0),
        "contact from the border, width": (0.4, 0.2, 0.1, 0.0, -0.1),
    },
    tolerance=1.0,
    unit="px",
    caption="95th percentile of the distance from the truth, the worst of all gels and motions. A method breaks where "
    "more than 5 % of all points are given wrongly; a frame is flagged where the method refuses more than 5 % of them, "
    "or where the package calls the picture saturated.",
    failures=("frames", "frames broken"),
)
_PEAK_PX, _JUMP_PX = 8.0, 24.0  # greatest displacement under other stresses and under gaps, on a picture 320 wide
_STEPS = 6  # pictures in which the motion grows
_ERASED_RADII = 1.6  # radius of what is painted over, in radii of a dot

SHEAR = StressedField(
    name="shear",
    stresses={
        "noise, factor": (1, 2, 4, 8, 16),
        "nodes lost, share": (0.0, 0.04, 0.2, 0.5, 0.8),
        "thickness taken, factor": (0.5, 0.8, 1.0, 1.25, 2.0),
        "Poisson ratio taken": (0.3, 0.4, 0.45, 0.48, 0.495),
    },
    tolerance=0.5,
    unit="relative",
    caption="Error over the true shear, root mean squares over a generated slide.",
)

DEPTH = StressedField(
    name="depth",
    stresses={
        "noise, grey levels": (1, 2, 5, 10, 20, 40),
        "exposure, down": (0.98, 0.95, 0.9, 0.8, 0.6, 0.3),
        "exposure, up": (1.02, 1.05, 1.1, 1.3, 2.0, 4.0),
        "lamps drift, levels over the window": (2, 5, 10, 20, 40),
        "contact from the border, mm": (4.0, 2.0, 1.0, 0.0, -1.0),
        "contact radius, mm, ball of 30 mm": (1, 2, 3, 4, 5.5),
        "contact, radii of a ball of 6.31 mm": (0.3, 0.5, 0.7, 0.8, 0.9),
    },
    tolerance=0.2,
    unit="share of the depth",
    caption="Root mean square error over the contact of a generated press of a ball, as a share of its depth, the "
    "worst of all presses; from 0.2 on it is wrong. Exposure and lamps change after the gel at rest was recorded.",
    failures=("presses", "depth wrong"),
)
_SMALL_MM, _LARGE_MM, _CONTACT_MM = 6.31, 30.0, 1.6  # diameters of the balls; contact radius without stress


def attempt_tracking(gel: MarkerGel, methods: Sequence[str], seed: int) -> Iterator[Attempt]:
    """All methods under all stresses on one gel.

    The error is the 95th percentile of the distance from the truth over the points that a method gives, in pixels;
    wrong is the share of all points that it gives and that are off by more than the tolerance.
    """
    for stress, level in TRACKING.levels:
        camera, pictures, true = _moving_gel(gel, stress, level, seed)
        background = camera.at_rest()
        clipped = bool(saturated(pictures[-1][None], background, QualityConfig())[0])
        still, greys = grey(background), [grey(p) for p in pictures]
        for name in methods:
            follow = FOLLOWERS[name](still, gel.points_px, gel.half_px)
            points = [follow(picture) for picture in greys][-1]
            yield name, stress, level, _tracking_outcome(points, true, gel, clipped and name.startswith("this"))


def _tracking_outcome(points: np.ndarray, true: np.ndarray, gel: MarkerGel, clipped: bool) -> StressOutcome:
    inside = gel.inside(true)
    error = np.hypot(*(points - true).T)[inside]
    given = np.isfinite(error)
    lost = float(np.mean(~np.isfinite(points[:, 0])))
    return StressOutcome(
        error=float(np.quantile(error[given], 0.95)) if given.any() else np.inf,
        wrong=float(np.mean(given & (error > TRACKING.tolerance))) if inside.any() else 0.0,
        flags=(Flag.SATURATED if clipped else Flag.NONE) | (Flag.MARKER_LOSS if lost > LOST_SHARE else Flag.NONE),
    )


def _moving_gel(gel: MarkerGel, stress: str, level: float, seed: int) -> tuple[GelCamera, list[np.ndarray], np.ndarray]:
    """The camera of the gel at rest, pictures under a growing motion, and the true points in the last of them."""
    kind = stress.split(",")[0].split(":")[0]
    noise = level if kind == "noise" else GEL_NOISE_GREY
    camera = GelCamera(gel.picture, noise, seed)
    moving = GelCamera(_erased(gel, level, seed), noise, seed) if kind == "dots lost" else camera
    motion = _stressed_motion(gel, kind, level, seed)
    steps = max(1, round(1 / level)) if kind == "gap" else _STEPS
    exposure = level if kind == "exposure" else 1.0
    pictures = [moving.under(motion.times(i / steps), i / steps, exposure) for i in range(1, steps + 1)]
    return camera, pictures, gel.points_px + motion.forward(gel.points_px)


def _stressed_motion(gel: MarkerGel, kind: str, level: float, seed: int) -> GelMotion:
    motion = gel.motion({"displacement": level, "gap": _JUMP_PX}.get(kind, _PEAK_PX), seed)
    if kind == "contact from the border":
        return dataclasses.replace(motion, centre_px=(level * gel.picture.shape[1], motion.centre_px[1]))
    return motion


def _erased(gel: MarkerGel, share: float, seed: int) -> np.ndarray:
    """The picture of the gel with a share of its dots painted over."""
    rng = np.random.default_rng(seed)
    gone = rng.permutation(len(gel.points_px))[: round(share * len(gel.points_px))]
    mask = np.zeros(gel.picture.shape[:2], np.uint8)
    radius = round(_ERASED_RADII * gel.dot_radius_px)
    for x, y in np.round(gel.points_px[gone]).astype(int):
        cv2.circle(mask, (int(x), int(y)), radius, 255, -1)
    return cv2.inpaint(gel.picture, mask, 3, cv2.INPAINT_TELEA)


def attempt_shear(frames: int, seed: int, context: Context) -> Iterator[Attempt]:
    """All methods under all stresses on one slide.

    The error is relative: root mean squares over the moving frames, error over true shear.
    """
    (slide,) = cached_slides(TAC3D, ("patterned",), ("slide_x",), frames, seed)
    for stress, level in context.each("shear", SHEAR.levels):
        kind = stress.split(",")[0].split(" ")[0]
        stressed, methods = _stressed_slide(slide, kind, level, seed), shear_methods(_assumed_sensor(kind, level))
        moving = [f for f in pressing(stressed) if stressed.moving[f]]
        flagged = float(np.mean(~stressed.valid[moving])) > LOST_SHARE
        for name in (MAIN, WITH_GRADIENT, SUBTRACTED, BASELINE):
            wrong = sum(float(((methods[name](stressed, f) - stressed.shear_mm[f]) ** 2).sum()) for f in moving)
            relative = float(np.sqrt(wrong / (stressed.shear_mm[moving] ** 2).sum()))
            flags = Flag.MARKER_LOSS if flagged and name != BASELINE else Flag.NONE
            yield name, stress, level, StressOutcome(relative, float(relative > SHEAR.tolerance), flags)


def _stressed_slide(slide: Slide, kind: str, level: float, seed: int) -> Slide:
    rng = np.random.default_rng(seed)
    if kind == "noise":
        more = np.sqrt(level**2 - 1)  # the slide has one part of noise already
        noise = lambda like, sigma: sigma * rng.standard_normal(like.shape)
        return dataclasses.replace(
            slide,
            deformation_mm=slide.deformation_mm + more * noise(slide.deformation_mm, TAC3D.lateral_noise_mm),
            depth_mm=slide.depth_mm + more * noise(slide.depth_mm, TAC3D.depth_noise_mm),
        )
    if kind == "nodes":
        return dataclasses.replace(slide, valid=rng.uniform(size=slide.valid.shape) >= level)
    return slide


def _assumed_sensor(kind: str, level: float) -> SensorModel:
    gel = TAC3D.gel
    if kind == "thickness":
        gel = dataclasses.replace(gel, thickness_mm=level * gel.thickness_mm)
    if kind == "Poisson":
        gel = dataclasses.replace(gel, poisson=level)
    return dataclasses.replace(TAC3D, gel=gel)


def attempt_depth(presses: int, seeds: int, seed: int, context: Context) -> Iterator[Attempt]:
    """All methods under all stresses: `seeds` presses under each level, by a calibration made with `presses`."""
    methods = _depth_methods(presses, seed)
    for (stress, level), i in context.each("depth", itertools.product(DEPTH.levels, range(seeds))):
        picture, truth, inside = _press_picture(stressed_press(stress, level, seed + i), seed + 1 + i)
        for name, read in methods.items():
            yield name, stress, level, depth_outcome(*read(picture), truth, inside)


def depth_outcome(depth: np.ndarray, flags: Flag, truth: np.ndarray, inside: np.ndarray) -> StressOutcome:
    """Root mean square error of depth [H, W] inside the contact, bool [H, W], as a share of the press depth."""
    off = float(np.sqrt(np.mean((depth - truth)[inside] ** 2)) / truth.max())
    return StressOutcome(off, float(off > DEPTH.tolerance), flags)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StressedPress:
    """A press: the ball's diameter, touch (x, y, contact radius; mm from the centre), noise, gain, drift in levels."""

    diameter_mm: float = _SMALL_MM
    touch: tuple[float, float, float] = (0.0, 0.0, _CONTACT_MM)
    noise: float = NOISE_GREY
    gain: float = 1.0
    drift: float = 0.0


def stressed_press(stress: str, level: float, seed: int) -> StressedPress:
    """The press of one level of one stress, by default at a place near the centre that the seed draws."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, 2)
    changes: dict[str, dict[str, Any]] = {
        "noise": {"noise": level},
        "exposure": {"gain": level},
        "lamps drift": {"drift": level},
        "contact from the border": {"touch": (WINDOW_MM / 2 - level, y, _CONTACT_MM)},
        "contact radius": {"diameter_mm": _LARGE_MM, "touch": (x, y, level)},
        "contact": {"touch": (x, y, level * _SMALL_MM / 2)},
    }
    return StressedPress(**{"touch": (x, y, _CONTACT_MM)} | changes[stress.split(",")[0]])


def _press_picture(press: StressedPress, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Picture uint8 [N, N, 3], its depth and the pixels of the contact, [N, N]."""
    touch, profiles = np.array(press.touch), ball_profiles(press.diameter_mm)
    clean = 255 * press.gain * fitted_optics(profiles, touch, AXIS_MM)
    clean += press.drift * (AXIS_MM / WINDOW_MM)[:, None] * np.array([1.0, -0.5, 0.5])  # along x, by colour
    noisy = clean + press.noise * np.random.default_rng(seed).standard_normal(clean.shape)
    truth, _, _ = profiles.field(touch, AXIS_MM[None, :], AXIS_MM[:, None])
    inside = np.hypot(AXIS_MM[None, :] - touch[0], AXIS_MM[:, None] - touch[1]) < touch[2]
    return to_bytes(noisy), truth, inside


def _depth_methods(presses: int, seed: int) -> dict[str, Callable[[np.ndarray], tuple[np.ndarray, Flag]]]:
    """Method → from a picture to its depth, mm, and the flags that warn of it; only the package has flags."""
    balls = generated_presses(_SMALL_MM, presses, seed, fitted_optics)
    made = calibrated(balls, seed)
    slopes, extractor = SlopeReader(made.colours, made.background), Extractor(made.background, made.mm_per_px, made)
    colours = table_map(balls, find_circles(balls).touches, seed)

    def package(picture: np.ndarray) -> tuple[np.ndarray, Flag]:
        fields = extractor.read(picture)
        assert fields.depth_mm is not None
        bare = Flag.REFUSED  # only says that the gel has no markers
        return fields.depth_mm[0], Flag(int(fields.flags[0])) & ~bare

    def published(picture: np.ndarray) -> np.ndarray:
        depth = published_poisson(*slopes(picture), made.mm_per_px)
        return depth - np.median(depth)

    without_flags: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "this, Dirichlet": lambda picture: depth_by(slopes, picture, made.mm_per_px, dirichlet),
        "as gs_sdk: Poisson from 1, median 0": published,
        "colour table": lambda picture: depth_by(colours, picture, made.mm_per_px),
    }
    plain = lambda read, picture: (read(picture), Flag.NONE)
    return {"this": package, **{name: functools.partial(plain, read) for name, read in without_flags.items()}}
