"""How wrong is each field, and what does it cost?

    python -m experiments pareto_fields [--data-dir DIR] [--scale smoke]

Each method of each field, its speed against its error, on one core.  Depth: integrators on analytic slopes; maps from
colour to slope on real ball presses left out of the calibration, whose circles nobody labelled; balls of other
diameters; presses at known depth; pictures without contact.  Motion: markers, dense fields, shear and force.  DIR holds
the public recordings by folder (gelslam, FOTS, gelsight_sim2real, feelanyforce, …); without it only generated input is
measured.

Splits: a press is scored by a map whose circles, degrees and constants come from the other presses alone; balls of
other diameters and presses at known depth were no part of any fit.  The weight of flat pixels was chosen on gelslam's
held-out balls.  The zero level, the degrees' rule and the threshold of a contact were set with the known depths,
feelanyforce, gelslam and FOTS in view: those rows are not blind.

Six minutes on one core with DIR (`smoke` half a minute).  Expected: the polynomial whose constants vary over the
picture is as good as the perceptron and several times as fast; published integrators are off by up to a factor of two.
"""

import dataclasses
import pathlib
from collections.abc import Callable

from experiments.core.context import Context
from experiments.core.results import Results
from experiments.core.runner import Experiment
from experiments.fields import (
    ball_recordings,
    contact_filters,
    dense_accuracy,
    depth_balls,
    depth_known,
    gel_patterns,
    gels_at_rest,
    generated_presses,
    marker_accuracy,
    marker_drift,
    shear_accuracy,
    tracked_gels,
    wrong_layers,
)
from experiments.fields.sections import FieldSection
from sensors_io.fields.sources import read_pictures
from sensors_io.fields.types import Calibration


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldsConfig:
    """What is measured.

    Args:
      data_dir: the recordings; `None` for generated input alone.
      rounds: of timing.
      folds: of the presses.
      generated_presses: of each generated ball.
      strange_lamps: whether balls are also generated under lamps of which the calibration's model knows nothing.
      motion: whether the panels of motion are drawn too.
      markers, drift: settings of the panels of markers and of their drift.
      dense_motions: motions of the dense panel.
      shear: settings of the panel of shear.
      judged: pictures of each folder that the evidence of markers is judged on.
      seed: of folds and generated presses.
    """

    data_dir: pathlib.Path | None = None
    rounds: int = 51
    folds: int = 5
    generated_presses: int = 24
    strange_lamps: bool = True
    motion: bool = True
    markers: marker_accuracy.MarkerConfig = dataclasses.field(default_factory=marker_accuracy.MarkerConfig)
    drift: marker_drift.DriftConfig = dataclasses.field(default_factory=marker_drift.DriftConfig)
    dense_motions: int = 4
    shear: shear_accuracy.ShearConfig = dataclasses.field(default_factory=shear_accuracy.ShearConfig)
    judged: int = 20
    seed: int = 0


def run(config: FieldsConfig, context: Context) -> Results:
    """Measure field by field, gather."""
    panels: list[FieldSection] = []
    for name, make in context.each("panels", panels_of(config, context).items()):
        context.print(name)
        with context.timed(name.replace(", ", "_").replace(" ", "_")):
            panels += make()
    return Results(
        verdict=tuple(sentence for panel in panels for sentence in panel.verdict),
        requirements=tuple(r for panel in panels for r in panel.requirements),
        tables=tuple(t for panel in panels for t in panel.tables),
        pictures=tuple(p for panel in panels for p in panel.pictures),
        settings={"recordings": "none" if config.data_dir is None else "read", "cores": 1},
    )


def panels_of(config: FieldsConfig, context: Context) -> dict[str, Callable[[], list[FieldSection]]]:
    """What is measured, in the order of the report: name → how to make its panels."""
    root = config.data_dir
    makes: dict[str, Callable[[], list[FieldSection]]] = {
        "integrators": lambda: [depth_known.poisson_panel(context.rounds("timing integrators", config.rounds))],
        "generated balls": lambda: generated_panels(config, context),
    }
    if root is not None:
        makes |= {
            "real balls": lambda: real_balls(config, root, context),
            "known depth": lambda: [depth_known.known_panel(root, config.seed, context)],
            "failed contact": lambda: [contact_filters.contact_panel(root, config.seed)],
        }
    return makes | (motion_panels(config, context) if config.motion else {})


def generated_panels(config: FieldsConfig, context: Context) -> list[FieldSection]:
    """Balls of other diameters on generated pictures, and the speed."""
    made, balls = other_balls(config, generated_presses.fitted_optics, "generated, supposed optics", context)
    strange = (
        [other_balls(config, generated_presses.near_lamps, "generated, near lamps", context)[1]]
        if config.strange_lamps
        else []
    )
    return [balls, *strange, speed_panel(config, made, "generated balls")]


def speed_panel(config: FieldsConfig, made: Calibration, source: str) -> FieldSection:
    """How fast a map makes depth of a picture of 320 × 240."""
    speed = depth_balls.speed_requirement(made, depth_known.SHAPE, config.rounds, source)
    sentence = (
        f"A picture of 320 × 240 becomes depth and contact at {speed.measured:.0f} Hz on one core, by the map of "
    )
    return FieldSection(verdict=(f"{sentence}{source}.",), requirements=(speed,))


def other_balls(
    config: FieldsConfig, optics: generated_presses.Optics, source: str, context: Context
) -> tuple[Calibration, FieldSection]:
    """A calibration with one generated ball, and its errors on others."""
    made = depth_balls.calibrated(
        generated_presses.generated_presses(6.31, config.generated_presses, config.seed, optics), config.seed
    )
    others = {
        f"{diameter:g} mm": generated_presses.generated_presses(
            diameter, max(2, config.generated_presses // 2), config.seed + 1, optics
        )
        for diameter in depth_balls.OTHER_BALLS_MM
    }
    return made, depth_balls.other_ball_panel(made, others, source, context)


def real_balls(config: FieldsConfig, root: pathlib.Path, context: Context) -> list[FieldSection]:
    """Recorded presses of the calibration's ball, and of another where there are any."""
    gelslam = ball_recordings.gelslam(root)
    made = depth_balls.calibrated(gelslam, config.seed)
    panels = [
        depth_balls.real_panel(gelslam, "gelslam", config.folds, config.rounds, config.seed, context),
        speed_panel(config, made, "gelslam"),
    ]
    other = root / "gelslam" / "9.500mm"
    if other.is_dir():
        bigger = dataclasses.replace(
            gelslam, pictures=read_pictures([other], "gelsight_mini").frames, radius_mm=9.5 / 2
        )
        panels.append(depth_balls.other_ball_panel(made, {"9.5 mm": bigger}, "gelslam", context))
    return panels


def motion_panels(config: FieldsConfig, context: Context) -> dict[str, Callable[[], list[FieldSection]]]:
    """Markers and their drift, dense fields, shear and force, and what tells a marker gel from a bare one."""
    root, rests = config.data_dir, gels_at_rest.gels(config.data_dir)
    subjects = [tracked_gels.subject(rest) for rest in rests]
    real = [s for s in subjects if s.rest.real] or subjects[:1]
    makes: dict[str, Callable[[], list[FieldSection]]] = {
        "markers": lambda: [marker_accuracy.panel(config.markers, subjects, context)],
        "drift": lambda: [marker_drift.panel(config.drift, real)],
        "dense fields": lambda: [dense_accuracy.panel(config.dense_motions, config.rounds, rests, context)],
        "shear": lambda: [shear_accuracy.panel(config.shear, root, context)],
        "wrong layers": lambda: [wrong_layers.panel(config.shear)],
    }
    if root is not None:
        makes["patterns"] = lambda: [gel_patterns.panel(root, config.judged, context)]
    return makes


EXPERIMENT = Experiment(
    name="pareto_fields",
    config=FieldsConfig(),
    run=run,
    scales={"smoke": FieldsConfig(rounds=5, folds=2, generated_presses=10, strange_lamps=False, motion=False)},
)
