"""Where tracking breaks: one gel under seven kinds of stress, each from harmless to hopeless."""

import dataclasses
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from experiments.fields.gels_at_rest import GelAtRest
from experiments.fields.known_motion import GelCamera, GelMotion
from experiments.fields.tracked_gels import NOISE_GREY, TrackedGel, grey, subject
from experiments.fields.trackers import FOLLOWERS
from sensors_io.fields.deformation import LOST_SHARE
from sensors_io.quality import QualityConfig, saturated
from sensors_io.schema import Flag

OFF_PX = 1.0
"""A point further from the truth is wrong."""

PEAK_PX = 8.0
"""On a picture 320 wide, where the stress is another one."""

_STEPS = 6
_ERASED_RADII = 1.6  # radius of what is painted over, in those of a dot


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stress:
    """One kind of stress: its name with the unit, and its levels, mild to severe."""

    name: str
    levels: tuple[float, ...]


STRESSES = (
    Stress(name="displacement, px", levels=(2, 8, 16, 24, 32, 48)),
    Stress(name="gap: share of 24 px at once", levels=(1 / 6, 1 / 4, 1 / 3, 1 / 2, 1)),
    Stress(name="dots lost, share", levels=(0.02, 0.1, 0.25, 0.5, 0.75, 0.9)),
    Stress(name="noise, grey levels", levels=(2, 5, 10, 20, 40, 80)),
    Stress(name="exposure, down", levels=(0.8, 0.5, 0.25, 0.12, 0.06, 0.03)),
    Stress(name="exposure, up", levels=(1.1, 1.3, 1.6, 2.0, 3.0, 5.0)),
    Stress(name="contact from the border, width", levels=(0.4, 0.2, 0.1, 0.0, -0.1)),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StressOutcome:
    """One method under one level of one stress.

    Args:
      error_px: 95th percentile of the distance from the truth, over the points that the method gives.
      wrong: share of all points that it gives and that are off by more than `OFF_PX`.
      flags: by which the frame is marked as not to be trusted.
    """

    error_px: float
    wrong: float
    flags: Flag

    @property
    def flagged(self) -> bool:
        """Whether anything says that the frame must not be trusted."""
        return self.flags != Flag.NONE

    @property
    def broken(self) -> bool:
        """Whether more points are wrong than a frame may lose."""
        return self.wrong > LOST_SHARE

    @property
    def silent(self) -> bool:
        """Broken, and nobody says so."""
        return self.broken and not self.flagged


def attempt(rest: GelAtRest, methods: tuple[str, ...], seed: int) -> Iterator[tuple[str, str, float, StressOutcome]]:
    """Method, stress, level and outcome, of all methods under all stresses on one gel."""
    of = subject(rest)
    for stress in STRESSES:
        for level in stress.levels:
            film, pictures, true = _sequence(of, stress.name, level, seed)
            still = film.at_rest()
            clipped, still = _saturated(pictures[-1], still), grey(still)
            seen = [grey(p) for p in pictures]
            for name in methods:
                follow = FOLLOWERS[name](still, of.points_px, of.half_px)
                for picture in seen:
                    points = follow(picture)
                yield name, stress.name, level, _outcome(points, true, of, clipped and name.startswith("this"))


def _outcome(points: np.ndarray, true: np.ndarray, of: TrackedGel, clipped: bool) -> StressOutcome:
    inside = of.inside(true)
    error = np.hypot(*(points - true).T)[inside]
    given = np.isfinite(error)
    lost = float(np.mean(~np.isfinite(points[:, 0])))
    return StressOutcome(
        error_px=float(np.quantile(error[given], 0.95)) if given.any() else np.inf,
        wrong=float(np.mean(given & (error > OFF_PX))) if inside.any() else 0.0,
        flags=(Flag.SATURATED if clipped else Flag.NONE) | (Flag.MARKER_LOSS if lost > LOST_SHARE else Flag.NONE),
    )


def _sequence(of: TrackedGel, stress: str, level: float, seed: int) -> tuple[GelCamera, list[np.ndarray], np.ndarray]:
    """The film, its pictures under a growing motion, and the true points in the last."""
    kind = stress.split(",")[0].split(":")[0]
    noise = level if kind == "noise" else NOISE_GREY
    rest_film = GelCamera(of.rest.picture, noise, seed)
    moving = GelCamera(_erased(of, level, seed), noise, seed) if kind == "dots lost" else rest_film
    motion = _MOTIONS.get(kind, _usual)(of, level, seed)
    steps = max(1, round(1 / level)) if kind == "gap" else _STEPS
    exposure = level if kind == "exposure" else 1.0
    pictures = [moving.under(motion.times(i / steps), i / steps, exposure) for i in range(1, steps + 1)]
    return rest_film, pictures, of.points_px + motion.forward(of.points_px)


def _saturated(picture: np.ndarray, rest: np.ndarray) -> bool:
    return bool(saturated(picture[None], rest, QualityConfig())[0])


def _usual(of: TrackedGel, level: float, seed: int) -> GelMotion:
    del level
    return of.motion(PEAK_PX, seed)


def _large(of: TrackedGel, level: float, seed: int) -> GelMotion:
    return of.motion(level, seed)


def _jump(of: TrackedGel, level: float, seed: int) -> GelMotion:
    del level
    return of.motion(24.0, seed)


def _at_border(of: TrackedGel, level: float, seed: int) -> GelMotion:
    motion = of.motion(PEAK_PX, seed)
    width = of.rest.picture.shape[1]
    return dataclasses.replace(motion, centre_px=(level * width, motion.centre_px[1]))


_MOTIONS: dict[str, Callable[[TrackedGel, float, int], GelMotion]] = {
    "displacement": _large,
    "gap": _jump,
    "contact from the border": _at_border,
}


def _erased(of: TrackedGel, share: float, seed: int) -> np.ndarray:
    """The gel with a share of its dots painted over."""
    rng = np.random.default_rng(seed)
    gone = rng.permutation(len(of.points_px))[: round(share * len(of.points_px))]
    mask = np.zeros(of.rest.picture.shape[:2], np.uint8)
    radius = round(_ERASED_RADII * of.dot_radius_px)
    for x, y in np.round(of.points_px[gone]).astype(int):
        cv2.circle(mask, (int(x), int(y)), radius, 255, -1)
    return cv2.inpaint(of.rest.picture, mask, 3, cv2.INPAINT_TELEA)
