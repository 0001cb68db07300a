"""Where depth breaks: generated presses of a ball under seven kinds of stress, each from harmless to hopeless.

The pictures are those of the generator's optics, whose depth is known at every pixel.  A reading is wrong from an error
of `BROKEN_DEPTH` of the press's depth, root mean square over the contact.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable

import numpy as np

from experiments.core.context import Context
from experiments.fields.depth_balls import calibrated
from experiments.fields.depth_methods import published_poisson, table_map
from experiments.fields.generated_presses import GEL, WINDOW_MM, WINDOW_PX, fitted_optics, generated_presses
from experiments.fields.tracking_stress import Stress, StressOutcome
from sensors_io.calibration.circles import find_circles
from sensors_io.fields.depth import ZeroConfig, zero_level
from sensors_io.fields.extract import Extractor
from sensors_io.fields.poisson import dirichlet, neumann
from sensors_io.fields.slopes import SlopeReader
from sensors_io.fields.types import Calibration
from sensors_io.scenes import fitting
from sensors_io.schema import Flag

BROKEN_DEPTH = 0.2
"""Error over the depth of the press from which a reading is wrong."""

DEPTH_STRESSES = (
    Stress(name="noise, grey levels", levels=(1, 2, 5, 10, 20, 40)),
    Stress(name="exposure, down", levels=(0.98, 0.95, 0.9, 0.8, 0.6, 0.3)),
    Stress(name="exposure, up", levels=(1.02, 1.05, 1.1, 1.3, 2.0, 4.0)),
    Stress(name="lamps drift, levels over the window", levels=(2, 5, 10, 20, 40)),
    Stress(name="contact from the border, mm", levels=(4.0, 2.0, 1.0, 0.0, -1.0)),
    Stress(name="contact radius, mm, ball of 30 mm", levels=(1, 2, 3, 4, 5.5)),
    Stress(name="contact, radii of a ball of 6.31 mm", levels=(0.3, 0.5, 0.7, 0.8, 0.9)),
)

_SMALL_MM, _LARGE_MM = 6.31, 30.0  # diameters
_CONTACT_MM, _NOISE = 1.6, 1.2  # of a press without stress: contact radius, grey levels
_ALONE = Flag.REFUSED  # says nothing about depth: the gel is bare

Read = Callable[[np.ndarray], tuple[np.ndarray, Flag]]
"""From a picture to its depth, mm, and the flags that warn of it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StressedPress:
    """A stressed press: diameter, touch (x, y, contact radius, mm from the centre), noise, gain, drift in levels."""

    diameter_mm: float = _SMALL_MM
    touch: tuple[float, float, float] = (0.0, 0.0, _CONTACT_MM)
    noise: float = _NOISE
    gain: float = 1.0
    drift: float = 0.0


def attempt_depth(
    presses: int, seeds: int, seed: int, context: Context
) -> dict[str, dict[tuple[str, float], list[StressOutcome]]]:
    """Outcomes of every way to depth under every stress; `error_px` is relative.

    Args:
      presses: that the calibration is made with.
      seeds: presses under each level.
      seed: of the calibration's presses; places and noise follow it.
      context: shows how far it is.
    """
    methods = _methods(presses, seed)
    outcomes: dict[str, dict[tuple[str, float], list[StressOutcome]]] = {}
    every = [(stress.name, level) for stress in DEPTH_STRESSES for level in stress.levels]
    for (stress, level), i in context.each("depth", itertools.product(every, range(seeds))):
        picture, truth, inside = _shown(_stressed(stress, level, seed + i), seed + 1 + i)
        for name, read in methods.items():
            outcome = _outcome(*read(picture), truth, inside)
            outcomes.setdefault(name, {}).setdefault((stress, level), []).append(outcome)
    return outcomes


def _outcome(depth: np.ndarray, flags: Flag, truth: np.ndarray, inside: np.ndarray) -> StressOutcome:
    off = float(np.sqrt(np.mean((depth - truth)[inside] ** 2)) / truth.max())
    return StressOutcome(error_px=off, wrong=float(off > BROKEN_DEPTH), flags=flags)


def _stressed(stress: str, level: float, seed: int) -> StressedPress:
    """The press of one level of one stress, at a place of its own near the centre."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, 2)
    usual = StressedPress(touch=(x, y, _CONTACT_MM))
    match stress.split(",")[0]:
        case "noise":
            return dataclasses.replace(usual, noise=level)
        case "exposure":
            return dataclasses.replace(usual, gain=level)
        case "lamps drift":
            return dataclasses.replace(usual, drift=level)
        case "contact from the border":
            return dataclasses.replace(usual, touch=(WINDOW_MM / 2 - level, y, _CONTACT_MM))
        case "contact radius":
            return dataclasses.replace(usual, diameter_mm=_LARGE_MM, touch=(x, y, level))
        case _:
            return dataclasses.replace(usual, touch=(x, y, level * _SMALL_MM / 2))


def _shown(press: StressedPress, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Picture uint8 [N, N, 3], its depth and the pixels of the contact, [N, N]."""
    axis = (np.arange(WINDOW_PX) - (WINDOW_PX - 1) / 2) * WINDOW_MM / WINDOW_PX
    touch, profiles = np.array(press.touch), _profiles(press.diameter_mm / 2)
    clean = 255 * press.gain * fitted_optics(profiles, touch, axis)
    clean += press.drift * (axis / WINDOW_MM)[:, None] * np.array([1.0, -0.5, 0.5])  # along x, by colour
    noisy = clean + press.noise * np.random.default_rng(seed).standard_normal(clean.shape)
    truth, _, _ = profiles.field(touch, axis[None, :], axis[:, None])
    inside = np.hypot(axis[None, :] - touch[0], axis[:, None] - touch[1]) < touch[2]
    return np.clip(noisy, 0, 255).round().astype(np.uint8), truth, inside


@functools.lru_cache(maxsize=4)
def _profiles(radius_mm: float) -> fitting.Profiles:
    return fitting.ball_profiles(GEL, radius_mm)


def _methods(presses: int, seed: int) -> dict[str, Read]:
    """The package's way first, with its flags; the others have none."""
    balls = generated_presses(_SMALL_MM, presses, seed, fitted_optics)
    made = calibrated(balls, seed)
    return {
        "this": _package(made),
        "this, Dirichlet": _plain(SlopeReader(made.colours, made.background), made, dirichlet),
        "as gs_sdk: Poisson from 1, median 0": _peer(SlopeReader(made.colours, made.background), made),
        "colour table": _plain(table_map(balls, find_circles(balls).touches, seed), made, neumann),
    }


def _package(made: Calibration) -> Read:
    extractor = Extractor(made.background, made.mm_per_px, made)

    def read(picture: np.ndarray) -> tuple[np.ndarray, Flag]:
        fields = extractor.read(picture)
        assert fields.depth_mm is not None
        return fields.depth_mm[0], Flag(int(fields.flags[0])) & ~_ALONE

    return read


def _plain(slopes: Callable, made: Calibration, integrate: Callable) -> Read:
    def read(picture: np.ndarray) -> tuple[np.ndarray, Flag]:
        x, y = slopes(picture)
        depth = integrate(x, y, made.mm_per_px)
        return depth - zero_level(depth, np.hypot(x, y), made.mm_per_px, ZeroConfig()), Flag.NONE

    return read


def _peer(slopes: Callable, made: Calibration) -> Read:
    def read(picture: np.ndarray) -> tuple[np.ndarray, Flag]:
        x, y = slopes(picture)
        depth = published_poisson(x, y, made.mm_per_px)
        return depth - np.median(depth), Flag.NONE

    return read
