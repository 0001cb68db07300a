"""Where shear breaks: generated slides with more noise, fewer nodes, and a layer that is not what it is taken for."""

import dataclasses
import functools
from collections.abc import Callable, Iterator

import numpy as np

from experiments.core.context import Context
from experiments.fields.generated_slides import Slide, cached_slides, node_grid
from experiments.fields.shear_accuracy import BASELINE, MAIN, SUBTRACTED, WITH_GRADIENT, pressing
from experiments.fields.tracking_stress import Stress, StressOutcome
from sensors_io.fields.deformation import LOST_SHARE
from sensors_io.fields.helmholtz import decompose
from sensors_io.fields.inversion import InverseConfig
from sensors_io.fields.shear import ShearReader
from sensors_io.layer import Layer
from sensors_io.scenes.sensors import TAC3D
from sensors_io.schema import Flag

BROKEN = 0.5
"""Error over the true shear from which a reading is wrong."""

SHEAR_STRESSES = (
    Stress(name="noise, factor", levels=(1, 2, 4, 8, 16)),
    Stress(name="nodes lost, share", levels=(0.0, 0.04, 0.2, 0.5, 0.8)),
    Stress(name="thickness taken, factor", levels=(0.5, 0.8, 1.0, 1.25, 2.0)),
    Stress(name="Poisson ratio taken", levels=(0.3, 0.4, 0.45, 0.48, 0.495)),
)

StressOutcomes = dict[str, dict[tuple[str, float], list[StressOutcome]]]
_SENSOR = TAC3D
_SENSOR_NOISE = InverseConfig(lateral_noise_mm=_SENSOR.lateral_noise_mm, depth_noise_mm=_SENSOR.depth_noise_mm)


def attempt_shear(frames: int, seed: int, context: Context) -> StressOutcomes:
    """Outcomes of every reading of shear under every stress, on one slide; `error_px` is then relative."""
    (slide,) = cached_slides(_SENSOR, ("patterned",), ("slide_x",), frames, seed)
    outcomes: StressOutcomes = {}
    every = [(stress.name, level) for stress in SHEAR_STRESSES for level in stress.levels]
    for stress, level in context.each("shear", every):
        kind = stress.split(",")[0].split(" ")[0]
        stressed, layer = _stressed(slide, kind, level, seed), _layer(kind, level)
        for name, outcome in _outcomes(stressed, layer):
            outcomes.setdefault(name, {}).setdefault((stress, level), []).append(outcome)
    return outcomes


def _stressed(slide: Slide, kind: str, level: float, seed: int) -> Slide:
    rng = np.random.default_rng(seed)
    if kind == "noise":
        more = np.sqrt(level**2 - 1)  # the slide has one part of noise already
        return dataclasses.replace(
            slide,
            deformation_mm=slide.deformation_mm + more * _noise(rng, slide.deformation_mm, _SENSOR.lateral_noise_mm),
            depth_mm=slide.depth_mm + more * _noise(rng, slide.depth_mm, _SENSOR.depth_noise_mm),
        )
    if kind == "nodes":
        return dataclasses.replace(slide, valid=rng.uniform(size=slide.valid.shape) >= level)
    return slide


def _noise(rng: np.random.Generator, like: np.ndarray, sigma: float) -> np.ndarray:
    return sigma * rng.standard_normal(like.shape)


def _layer(kind: str, level: float) -> Layer:
    if kind == "thickness":
        return dataclasses.replace(_SENSOR.gel, thickness_mm=level * _SENSOR.gel.thickness_mm)
    if kind == "Poisson":
        return dataclasses.replace(_SENSOR.gel, poisson=level)
    return _SENSOR.gel


@functools.lru_cache(maxsize=32)
def _reader(layer: Layer, gradient_free: bool) -> ShearReader:
    config = dataclasses.replace(_SENSOR_NOISE, gradient_free=gradient_free)
    return ShearReader(layer, node_grid(_SENSOR), config)


def _outcomes(slide: Slide, layer: Layer) -> Iterator[tuple[str, StressOutcome]]:
    grid = node_grid(_SENSOR)
    moving = [f for f in pressing(slide) if slide.moving[f]]
    found, whole = (
        [split.read(slide.deformation_mm[f], slide.depth_mm[f], slide.valid[f]) for f in moving]
        for split in (_reader(layer, gradient_free) for gradient_free in (True, False))
    )
    readings: dict[str, Callable[[int], np.ndarray]] = {
        MAIN: lambda i: found[i].shear_mm,
        WITH_GRADIENT: lambda i: whole[i].shear_mm,
        SUBTRACTED: lambda i: whole[i].subtracted_mm,
        BASELINE: lambda i: decompose(slide.deformation_mm[moving[i]], grid.pitch_mm).shear,
    }
    flagged = float(np.mean(~slide.valid[moving])) > LOST_SHARE
    for name, reading in readings.items():
        wrong = sum(float(((reading(i) - slide.shear_mm[f]) ** 2).sum()) for i, f in enumerate(moving))
        relative = float(np.sqrt(wrong / (slide.shear_mm[moving] ** 2).sum()))
        broken = 1.0 if relative > BROKEN else 0.0
        flags = Flag.MARKER_LOSS if flagged and name != BASELINE else Flag.NONE
        yield name, StressOutcome(error_px=relative, wrong=broken, flags=flags)
