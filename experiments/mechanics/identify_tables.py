"""Tables and pictures of `identifiability`."""

import numpy as np

from experiments.core.results import Cell, Column, Picture, Table
from experiments.mechanics import identify_charts
from experiments.mechanics.identify_figures import ProbeFigures, StudyPredictions
from experiments.mechanics.identify_probes import LEVELS
from experiments.mechanics.identify_studies import DYNAMIC, FORCE, FUSED, SHAPE, SOURCES, STATIC
from sensors_io.schema import SENSORS

MAY_LOSE = 2.0
"""Points that a tier may lose."""

CHANCE = 100 / LEVELS


def touch_table(studied: StudyPredictions, figures: ProbeFigures) -> Table:
    """Accuracy of every property by every source over the noise."""
    rows: list[tuple[Cell, ...]] = []
    for name in STATIC:
        for source in SOURCES:
            told = [figures.told[name, source, level] for level in range(len(studied.noise))]
            own = told[studied.own]
            far = studied.touch[name, source, studied.own].far_off
            rows.append((f"{name}, {source}", *(t.mean for t in told), own.low, own.high, far))
    return Table(
        title="What touch and force tell of unseen objects",
        columns=(
            Column(name="property, sensor"),
            *(_percent(f"noise ×{f:g}", "right answers") for f in studied.noise),
            _percent("×1 from", "lower end of the 95 % interval over objects"),
            _percent("×1 to", "upper end"),
            _percent("two levels off", "at the sensors' own noise"),
        ),
        rows=tuple(rows),
        note=f"Probes are trained and asked at the same noise, on {studied.exact}; guessing gives {CHANCE:.0f} %. "
        "Multiplied is the noise of fields and cameras; units, mountings and the force sensor differ as ever.",
    )


def blind_table(studied: StudyPredictions, figures: ProbeFigures) -> Table:
    """The lines that touch has to pass."""
    rows: list[tuple[Cell, ...]] = []
    for name in STATIC:
        shape, force = figures.blind[name, SHAPE], figures.blind[name, FORCE]
        commonest = 100 * float(np.bincount(studied.pressed.levels[name]).max()) / len(studied.pressed.objects)
        rows.append((name, shape.mean, shape.low, shape.high, force.mean, force.low, force.high, commonest))
    interval = [_percent(end, "end of the 95 % interval over objects") for end in ("from", "to")]
    return Table(
        title="What is told without touch",
        columns=(
            Column(name="property"),
            _percent(SHAPE, "statistics of the true gap, noiseless"),
            *interval,
            _percent(FORCE, "the forces measured by all four sensors"),
            *interval,
            _percent("commonest level", "its share of the objects"),
        ),
        rows=tuple(rows),
        note="Roughness and protrusion are shape: their line of shape is a ceiling. Materials tie hardness to shape.",
    )


def tier_table(studied: StudyPredictions, figures: ProbeFigures) -> Table:
    """The matrix of transfer."""
    rows: list[tuple[Cell, ...]] = []
    for (tier, name), lost in figures.lost.items():
        found = [studied.tiers[tier, name, sensor] for sensor in SENSORS]
        own = 100 * float(np.mean([f.own.right for f in found]))
        exact = 100 * float(np.mean([f.exact.right for f in found]))
        each = [figures.lost_by[tier, name, source] for source in SOURCES]
        rows.append((f"{tier}: {name}", own, exact, lost.mean, lost.low, lost.high, *each))
    return Table(
        title="Trained at a tier, asked about exact records",
        columns=(
            Column(name="tier: property"),
            _percent("own records", "right about unseen objects at the same tier"),
            _percent("exact records", f"right about them at {studied.exact}"),
            _points("lost", "against training on exact records, mean over sensors"),
            _points("from", "lower end of the 95 % interval over objects"),
            _points("to", "upper end"),
            *(_points(source, "lost by it") for source in SOURCES),
        ),
        rows=tuple(rows),
        note="The same presses with the same noise at every tier; a coarse grid leaves out short waves of the skin.",
    )


def motion_table(studied: StudyPredictions, figures: ProbeFigures) -> Table:
    """Friction and elasticity by motion, by touch without force and without touch."""
    rows: list[tuple[Cell, ...]] = []
    for (name, motion), fused in figures.moved.items():
        each = [100 * float(studied.motion[motion][name, sensor].right.mean()) for sensor in SENSORS]
        still = [100 * float(studied.still[motion][name, source].right.mean()) for source in (SHAPE, FORCE)]
        rows.append((f"{name} by {motion}", *each, fused.mean, fused.low, fused.high, *still))
    order = {name: place for place, name in enumerate(DYNAMIC)}
    return Table(
        title="Elasticity and friction by motion",
        columns=(
            Column(name="property by motion"),
            *(_percent(sensor, "right answers of touch without force") for sensor in SENSORS),
            _percent(FUSED, "their product"),
            _percent("from", "lower end of the 95 % interval over objects"),
            _percent("to", "upper end"),
            _percent(SHAPE, "statistics of the true gap"),
            _percent(FORCE, "forces along three axes: in a slide they are friction itself"),
        ),
        rows=tuple(sorted(rows, key=lambda row: order[str(row[0]).split()[0]])),
        note="A press neither slides nor unloads: what it tells of the two, the material tells.",
    )


def noise_picture(studied: StudyPredictions, figures: ProbeFigures) -> Picture:
    """Accuracy over noise."""
    levels = range(len(studied.noise))
    panels = {n: {s: [figures.told[n, s, level] for level in levels] for s in SOURCES} for n in STATIC}
    lines = {n: {source: figures.blind[n, source].mean for source in (SHAPE, FORCE)} for n in STATIC}
    return Picture(
        name="identifiability",
        title="What touch tells, over noise",
        caption="Right answers about unseen objects, with 95 % intervals over objects. The lines take no touch; shape "
        "is the ceiling for roughness and protrusion.",
        content=identify_charts.over_noise(panels, studied.noise, lines, CHANCE),
    )


def tier_picture(figures: ProbeFigures) -> Picture:
    """Points lost by tier."""
    panels: dict[str, identify_charts.Bars] = {name: {} for name in STATIC}
    for (tier, name), lost in figures.lost.items():
        panels[name] = {**panels[name], tier: (lost, [figures.lost_by[tier, name, s] for s in SENSORS])}
    return Picture(
        name="label_transfer",
        title="What a cheaper contact costs",
        caption="Points lost about exact records by training at a tier, mean over sensors with 95 % interval; dots are "
        f"single sensors, the dotted line is what may be lost, {MAY_LOSE:g} points.",
        content=identify_charts.lost_points(panels, MAY_LOSE),
    )


def _percent(name: str, meaning: str) -> Column:
    return Column(name=name, unit="%", format=".1f", meaning=meaning)


def _points(name: str, meaning: str) -> Column:
    return Column(name=name, unit="points", format=".1f", meaning=meaning)
