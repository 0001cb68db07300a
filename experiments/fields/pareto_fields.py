"""How wrong is each field, and what does it cost?

    python -m experiments pareto_fields [--data-dir DIR] [--scale smoke]

Speed against error of each method of each field, on one core.  Depth: integrators on analytic slopes; maps from colour
to slope on real ball presses left out of the calibration, with circles found without labels; balls of other diameters;
presses at known depth; pictures without contact.  Motion: markers, dense fields, shear and force.  DIR holds the public
recordings by folder (gelslam, FOTS, gelsight_sim2real, feelanyforce, …); without it only generated input is measured.

Splits: each press is scored by a map whose circles, degrees and constants come from the other presses alone; balls of
other diameters and presses at known depth took no part in any fit.  The weight of flat pixels was chosen on gelslam's
held-out balls.  The zero level, the rule for the degrees and the threshold of a contact were set with the known depths,
feelanyforce, gelslam and FOTS in view: those rows are not blind.

Six minutes on one core with DIR (`smoke` half a minute).  Expected: the polynomial whose constants vary over the
picture is as good as the perceptron and several times as fast; published integrators are off by up to a factor of two.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable

from experiments.core.context import Context
from experiments.core.results import Results
from experiments.core.runner import Experiment
from experiments.fields.depth_accuracy import generated_sections, recorded_sections
from experiments.fields.depth_checks import contact_section, integrator_section, known_depth_section
from experiments.fields.false_alarms import pattern_section
from experiments.fields.known_motion import gels, tracked
from experiments.fields.marker_drift import DriftConfig, drift_section
from experiments.fields.sections import FieldSection, joined
from experiments.fields.shear_accuracy import ShearConfig, layer_section, shear_section
from experiments.fields.tracking_accuracy import MarkerConfig, dense_section, marker_section


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldsConfig:
    """Sizes of the measurements.

    Args:
      data_dir: folder of the recordings; `None` for generated input alone.
      rounds: of timing.
      folds: of the presses.
      generated_presses: of each generated ball.
      strange_lamps: whether balls are also generated under lamps that the calibration's model does not cover.
      motion: whether the fields of motion are measured too.
      markers, drift: settings of the sections on markers and on their drift.
      dense_motions: motions of the dense fields.
      shear: settings of the sections on shear.
      judged: pictures of each folder for the recognition of marker gels.
      seed: of folds and generated presses.
    """

    data_dir: pathlib.Path | None = None
    rounds: int = 51
    folds: int = 5
    generated_presses: int = 24
    strange_lamps: bool = True
    motion: bool = True
    markers: MarkerConfig = MarkerConfig()
    drift: DriftConfig = DriftConfig()
    dense_motions: int = 4
    shear: ShearConfig = ShearConfig()
    judged: int = 20
    seed: int = 0


Sections = dict[str, Callable[[], list[FieldSection]]]
"""Name → function that measures sections of the report, in their order."""


def run(config: FieldsConfig, context: Context) -> Results:
    """Measure section by section."""
    sections: list[FieldSection] = []
    measured = depth_sections(config, context) | (motion_sections(config, context) if config.motion else {})
    for name, measure in context.each("sections", measured.items()):
        context.print(name)
        with context.timed(name.replace(", ", "_").replace(" ", "_")):
            sections += measure()
    return joined(sections, {"recordings": "none" if config.data_dir is None else "read", "cores": 1})


def depth_sections(config: FieldsConfig, context: Context) -> Sections:
    """Integrators, generated and recorded balls, known depth, failed contact."""
    root, seed = config.data_dir, config.seed
    generated = functools.partial(generated_sections, config.generated_presses, config.strange_lamps)
    sections: Sections = {
        "integrators": lambda: [integrator_section(context.rounds("timing integrators", config.rounds))],
        "generated balls": lambda: generated(config.rounds, seed, context),
    }
    if root is not None:
        sections |= {
            "real balls": lambda: recorded_sections(root, config.folds, config.rounds, seed, context),
            "known depth": lambda: [known_depth_section(root, seed, context)],
            "failed contact": lambda: [contact_section(root, seed)],
        }
    return sections


def motion_sections(config: FieldsConfig, context: Context) -> Sections:
    """Markers and their drift, dense fields, shear and force, recognition of marker gels."""
    root, subjects = config.data_dir, [tracked(rest) for rest in gels(config.data_dir)]
    real = [gel for gel in subjects if gel.rest.real] or subjects[:1]
    sections: Sections = {
        "markers": lambda: [marker_section(config.markers, subjects, context)],
        "drift": lambda: [drift_section(config.drift, real)],
        "dense fields": lambda: [dense_section(config.dense_motions, config.rounds, subjects, context)],
        "shear": lambda: [shear_section(config.shear, root, context)],
        "wrong layers": lambda: [layer_section(config.shear)],
    }
    if root is not None:
        sections["patterns"] = lambda: [pattern_section(root, config.judged, context)]
    return sections


EXPERIMENT = Experiment(
    name="pareto_fields",
    config=FieldsConfig(),
    run=run,
    scales={"smoke": FieldsConfig(rounds=5, folds=2, generated_presses=10, strange_lamps=False, motion=False)},
)
