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
    depth_balls,
    depth_contact,
    depth_data,
    depth_known,
    depth_presses,
    motion_dense,
    motion_drift,
    motion_evidence,
    motion_frames,
    motion_layers,
    motion_markers,
    motion_shear,
    motion_subjects,
)
from experiments.fields.panel import Panel
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
    markers: motion_markers.MarkerConfig = dataclasses.field(default_factory=motion_markers.MarkerConfig)
    drift: motion_drift.DriftConfig = dataclasses.field(default_factory=motion_drift.DriftConfig)
    dense_motions: int = 4
    shear: motion_shear.ShearConfig = dataclasses.field(default_factory=motion_shear.ShearConfig)
    judged: int = 20
    seed: int = 0


def run(config: FieldsConfig, context: Context) -> Results:
    """Measure field by field, gather."""
    panels: list[Panel] = []
    for name, make in context.each("panels", panels_of(config, context).items()):
        context.say(name)
        with context.timed(name.replace(", ", "_").replace(" ", "_")):
            panels += make()
    return Results(
        verdict=tuple(sentence for panel in panels for sentence in panel.verdict),
        requirements=tuple(r for panel in panels for r in panel.requirements),
        tables=tuple(t for panel in panels for t in panel.tables),
        pictures=tuple(p for panel in panels for p in panel.pictures),
        settings={"recordings": "none" if config.data_dir is None else "read", "cores": 1},
    )


def panels_of(config: FieldsConfig, context: Context) -> dict[str, Callable[[], list[Panel]]]:
    """What is measured, in the order of the report: name → how to make its panels."""
    root = config.data_dir
    makes: dict[str, Callable[[], list[Panel]]] = {
        "integrators": lambda: [depth_known.poisson_panel(context.rounds("timing integrators", config.rounds))],
        "generated balls": lambda: generated_panels(config, context),
    }
    if root is not None:
        makes |= {
            "real balls": lambda: real_balls(config, root, context),
            "known depth": lambda: [depth_known.known_panel(root, config.seed, context)],
            "failed contact": lambda: [depth_contact.contact_panel(root, config.seed)],
        }
    return makes | (motion_panels(config, context) if config.motion else {})


def generated_panels(config: FieldsConfig, context: Context) -> list[Panel]:
    """Balls of other diameters on generated pictures, and the speed."""
    made, balls = other_balls(config, depth_presses.fitted_optics, "generated, supposed optics", context)
    strange = (
        [other_balls(config, depth_presses.near_lamps, "generated, near lamps", context)[1]]
        if config.strange_lamps
        else []
    )
    return [balls, *strange, speed_panel(config, made, "generated balls")]


def speed_panel(config: FieldsConfig, made: Calibration, source: str) -> Panel:
    """How fast a map makes depth of a picture of 320 × 240."""
    speed = depth_balls.speed_requirement(made, depth_known.SHAPE, config.rounds, source)
    sentence = (
        f"A picture of 320 × 240 becomes depth and contact at {speed.measured:.0f} Hz on one core, by the map of "
    )
    return Panel(verdict=(f"{sentence}{source}.",), requirements=(speed,))


def other_balls(
    config: FieldsConfig, optics: depth_presses.Optics, source: str, context: Context
) -> tuple[Calibration, Panel]:
    """A calibration with one generated ball, and its errors on others."""
    made = depth_balls.calibrated(
        depth_presses.generated_presses(6.31, config.generated_presses, config.seed, optics), config.seed
    )
    others = {
        f"{diameter:g} mm": depth_presses.generated_presses(
            diameter, max(2, config.generated_presses // 2), config.seed + 1, optics
        )
        for diameter in depth_balls.OTHER_BALLS_MM
    }
    return made, depth_balls.other_ball_panel(made, others, source, context)


def real_balls(config: FieldsConfig, root: pathlib.Path, context: Context) -> list[Panel]:
    """Recorded presses of the calibration's ball, and of another where there are any."""
    gelslam = depth_data.gelslam(root)
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


def motion_panels(config: FieldsConfig, context: Context) -> dict[str, Callable[[], list[Panel]]]:
    """Markers and their drift, dense fields, shear and force, and what tells a marker gel from a bare one."""
    root, rests = config.data_dir, motion_frames.gels(config.data_dir)
    subjects = [motion_subjects.subject(rest) for rest in rests]
    real = [s for s in subjects if s.rest.real] or subjects[:1]
    makes: dict[str, Callable[[], list[Panel]]] = {
        "markers": lambda: [motion_markers.panel(config.markers, subjects, context)],
        "drift": lambda: [motion_drift.panel(config.drift, real)],
        "dense fields": lambda: [motion_dense.panel(config.dense_motions, config.rounds, rests, context)],
        "shear": lambda: [motion_shear.panel(config.shear, root, context)],
        "wrong layers": lambda: [motion_layers.panel(config.shear)],
    }
    if root is not None:
        makes["patterns"] = lambda: [motion_evidence.panel(root, config.judged, context)]
    return makes


EXPERIMENT = Experiment(
    name="pareto_fields",
    config=FieldsConfig(),
    run=run,
    scales={"smoke": FieldsConfig(rounds=5, folds=2, generated_presses=10, strange_lamps=False, motion=False)},
)
