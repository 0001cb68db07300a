"""Shear where the gel is not what it is taken for: other thickness, other Poisson ratio."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from experiments.core.results import Cell, Column, Requirement, Table
from experiments.fields.generated_slides import Slide, make_slides
from experiments.fields.sections import FieldSection
from experiments.fields.shear_accuracy import BASELINE, MAIN, ShearConfig, methods, pressing, reader, shear_errors
from sensors_io.scenes.sensors import TAC3D, SensorModel

LAYERS = ((1.0, 0.48), (1.0, 0.45), (0.7, 0.48), (0.7, 0.45), (1.3, 0.48), (1.3, 0.45))
"""True thickness over the one it is taken for, and true Poisson ratio; the gel is taken for (1, 0.48)."""

FIRST_SEED = 600
"""Of objects and noise: the gradient-free reading was designed on seeds 700 and 800."""


def panel(config: ShearConfig) -> FieldSection:
    """Errors of every reading on every layer, all read as if the layer were the nominal one."""
    slides = {layer: _slides(TAC3D, layer, config) for layer in LAYERS}
    errors = {layer: shear_errors(TAC3D, of, config.stride) for layer, of in slides.items()}
    means = {layer: {name: float(np.mean(list(by.values()))) for name, by in e.items()} for layer, e in errors.items()}
    left = {layer: unexplained(TAC3D, of, config.stride) for layer, of in slides.items()}
    worst, baseline = (max(by[name] for by in means.values()) for name in (MAIN, BASELINE))
    return FieldSection(
        verdict=(
            "With a gel up to 30 % thicker or thinner than it is taken for, and a Poisson ratio of 0.45 for 0.48, "
            f"shear is off by {worst:.1f} µm at worst, by Helmholtz–Hodge {baseline:.1f}.",
        ),
        requirements=(
            Requirement(
                name="shear error over Helmholtz–Hodge's, worst wrong layer",
                measured=max(by[MAIN] / by[BASELINE] for by in means.values()),
                bound=1.0,
                better="lower",
            ),
        ),
        tables=(_table(means, left),),
    )


def unexplained(sensor: SensorModel, slides: Sequence[Slide], stride: int) -> float:
    """What no load on the nominal layer explains of the motion, root mean square over the noise's."""
    whole = reader(sensor, gradient_free=False)
    squares = []
    for slide in slides:
        for f in pressing(slide)[::stride]:
            found = whole.read(slide.deformation_mm[f], slide.depth_mm[f], slide.valid[f])
            squares.append(((found.subtracted_mm - found.shear_mm)[slide.valid[f]] ** 2).mean())
    return float(np.sqrt(np.mean(squares)) / sensor.lateral_noise_mm)


def _slides(sensor: SensorModel, layer: tuple[float, float], config: ShearConfig) -> list[Slide]:
    gel = dataclasses.replace(sensor.gel, thickness_mm=layer[0] * sensor.gel.thickness_mm, poisson=layer[1])
    true = dataclasses.replace(sensor, gel=gel)
    return make_slides(true, config.kinds, config.motions, config.frames, FIRST_SEED)


def _table(means: dict[tuple[float, float], dict[str, float]], left: dict[tuple[float, float], float]) -> Table:
    columns = [Column(name=f"{factor:g} × thick, ν {nu:g}", unit="µm", format=".1f") for factor, nu in means]
    rows: list[tuple[Cell, ...]] = [(name, *(by[name] for by in means.values())) for name in methods(TAC3D)]
    return Table(
        title="Shear with a gel that is not what it is taken for (Tac3D's, generated)",
        columns=(Column(name="method"), *columns),
        rows=(*rows, ("unexplained over noise, layer model with all of the motion", *left.values())),
        note="Root mean square distance from the truth, mean over motions. The last row is a ratio: a wrong layer "
        "leaves hardly more unexplained than the right one, so it cannot be noticed there.",
    )
