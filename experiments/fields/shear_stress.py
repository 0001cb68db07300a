"""Shear under stress: generated slides with more noise, fewer nodes, or a layer other than the assumed one."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from experiments.core.context import Context
from experiments.fields.generated_slides import Slide, cached_slides, pressing
from experiments.fields.shear_accuracy import BASELINE, MAIN, SUBTRACTED, WITH_GRADIENT, shear_methods
from experiments.fields.stress import Stress, StressOutcome
from sensors_io.fields.deformation import LOST_SHARE
from sensors_io.scenes.sensors import TAC3D, SensorModel
from sensors_io.schema import Flag

BROKEN_SHEAR = 0.5
"""Error over the true shear from which a reading is wrong."""

SHEAR_STRESSES = (
    Stress(name="noise, factor", levels=(1, 2, 4, 8, 16)),
    Stress(name="nodes lost, share", levels=(0.0, 0.04, 0.2, 0.5, 0.8)),
    Stress(name="thickness taken, factor", levels=(0.5, 0.8, 1.0, 1.25, 2.0)),
    Stress(name="Poisson ratio taken", levels=(0.3, 0.4, 0.45, 0.48, 0.495)),
)


def attempt_shear(
    frames: int, seed: int, context: Context, stresses: Sequence[Stress] = SHEAR_STRESSES
) -> Iterator[tuple[str, str, float, StressOutcome]]:
    """Method, stress, level and outcome of one slide, of all methods under all stresses.

    The error is relative: root mean squares over the moving frames, error over true shear; wrong from `BROKEN_SHEAR`.
    """
    (slide,) = cached_slides(TAC3D, ("patterned",), ("slide_x",), frames, seed)
    every = [(stress.name, level) for stress in stresses for level in stress.levels]
    for stress, level in context.each("shear", every):
        kind = stress.split(",")[0].split(" ")[0]
        for name, outcome in _outcomes(_stressed(slide, kind, level, seed), _assumed(kind, level)):
            yield name, stress, level, outcome


def _stressed(slide: Slide, kind: str, level: float, seed: int) -> Slide:
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


def _assumed(kind: str, level: float) -> SensorModel:
    """The sensor that the readings assume."""
    gel = TAC3D.gel
    if kind == "thickness":
        gel = dataclasses.replace(gel, thickness_mm=level * gel.thickness_mm)
    if kind == "Poisson":
        gel = dataclasses.replace(gel, poisson=level)
    return dataclasses.replace(TAC3D, gel=gel)


def _outcomes(slide: Slide, assumed: SensorModel) -> Iterator[tuple[str, StressOutcome]]:
    moving = [f for f in pressing(slide) if slide.moving[f]]
    flagged = float(np.mean(~slide.valid[moving])) > LOST_SHARE
    methods = shear_methods(assumed)
    for name in (MAIN, WITH_GRADIENT, SUBTRACTED, BASELINE):
        wrong = sum(float(((methods[name](slide, f) - slide.shear_mm[f]) ** 2).sum()) for f in moving)
        relative = float(np.sqrt(wrong / (slide.shear_mm[moving] ** 2).sum()))
        flags = Flag.MARKER_LOSS if flagged and name != BASELINE else Flag.NONE
        yield name, StressOutcome(error=relative, wrong=float(relative > BROKEN_SHEAR), flags=flags)
