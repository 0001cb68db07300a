"""Depth under stress: generated presses of a ball, under seven kinds of stress from harmless to hopeless.

The pictures come from the optics that calibration assumes, and their depth is known at every pixel.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from experiments.core.context import Context
from experiments.fields.depth_methods import calibrated, depth_by, published_poisson, table_map
from experiments.fields.generated_presses import (
    AXIS_MM,
    NOISE_GREY,
    WINDOW_MM,
    ball_profiles,
    fitted_optics,
    generated_presses,
    to_bytes,
)
from experiments.fields.stress import Stress, StressOutcome
from sensors_io.calibration.circles import find_circles
from sensors_io.fields.extract import Extractor
from sensors_io.fields.poisson import dirichlet
from sensors_io.fields.slopes import SlopeReader
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

_SMALL_MM, _LARGE_MM, _CONTACT_MM = 6.31, 30.0, 1.6  # diameters of the balls; contact radius without stress


@dataclasses.dataclass(frozen=True, kw_only=True)
class StressedPress:
    """A press: the ball's diameter, touch (x, y, contact radius; mm from the centre), noise, gain, drift in levels."""

    diameter_mm: float = _SMALL_MM
    touch: tuple[float, float, float] = (0.0, 0.0, _CONTACT_MM)
    noise: float = NOISE_GREY
    gain: float = 1.0
    drift: float = 0.0


def attempt_depth(
    presses: int, seeds: int, seed: int, context: Context, stresses: Sequence[Stress] = DEPTH_STRESSES
) -> Iterator[tuple[str, str, float, StressOutcome]]:
    """Method, stress, level and outcome, of all methods under all stresses.

    Args:
      presses: that the calibration is made with.
      seeds: presses under each level.
      seed: of the calibration's presses; places and noise follow it.
      context: shows progress.
      stresses: kinds and levels.
    """
    methods = _methods(presses, seed)
    every = [(stress.name, level) for stress in stresses for level in stress.levels]
    for (stress, level), i in context.each("depth", itertools.product(every, range(seeds))):
        picture, truth, inside = _shown(stressed_press(stress, level, seed + i), seed + 1 + i)
        for name, read in methods.items():
            depth, flags = read(picture)
            yield name, stress, level, depth_outcome(depth, flags, truth, inside)


def depth_outcome(depth: np.ndarray, flags: Flag, truth: np.ndarray, inside: np.ndarray) -> StressOutcome:
    """Root mean square error over the contact as a share of the press depth; wrong from `BROKEN_DEPTH` on.

    Args:
      depth, truth: [H, W], in the same unit.
      flags: of the reading.
      inside: bool [H, W], pixels of the contact.
    """
    off = float(np.sqrt(np.mean((depth - truth)[inside] ** 2)) / truth.max())
    return StressOutcome(error=off, wrong=float(off > BROKEN_DEPTH), flags=flags)


def stressed_press(stress: str, level: float, seed: int) -> StressedPress:
    """The press of one level of one stress, by default at a place near the centre that the seed draws."""
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
    touch, profiles = np.array(press.touch), ball_profiles(press.diameter_mm)
    clean = 255 * press.gain * fitted_optics(profiles, touch, AXIS_MM)
    clean += press.drift * (AXIS_MM / WINDOW_MM)[:, None] * np.array([1.0, -0.5, 0.5])  # along x, by colour
    noisy = clean + press.noise * np.random.default_rng(seed).standard_normal(clean.shape)
    truth, _, _ = profiles.field(touch, AXIS_MM[None, :], AXIS_MM[:, None])
    inside = np.hypot(AXIS_MM[None, :] - touch[0], AXIS_MM[:, None] - touch[1]) < touch[2]
    return to_bytes(noisy), truth, inside


def _methods(presses: int, seed: int) -> dict[str, Callable[[np.ndarray], tuple[np.ndarray, Flag]]]:
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
