"""How accurate is each method for depth, motion, shear and force, and how fast?

    python -m experiments pareto_fields [--data-dir DIR] [--scale smoke]

Speed against error of each method of each field, on one core.  Depth: integrators on analytic slopes; maps from colour
to slope on real ball presses left out of the calibration, with circles found without labels; balls of other diameters;
presses at known depth; pictures without contact.  Motion: markers, dense fields, shear and force.  DIR holds the public
recordings by folder (gelslam, FOTS, gelsight_sim2real, feelanyforce, …); without it only generated input is measured.

Splits: each press is scored by a map whose circles, degrees and constants come from the other presses alone; balls of
other diameters and presses at known depth took no part in any fit. The weight of flat pixels was chosen on gelslam's
held-out balls, that of rims on those of gelslam and gelsight_sim2real. The zero level, the rule for the degrees and
the threshold of a contact were chosen on the known depths, feelanyforce, gelslam and FOTS: those rows are not blind.

Six minutes on one core with DIR (`smoke` half a minute).  Expected: the polynomial whose constants vary over the
picture is as good as the perceptron and several times as fast; published integrators are off by up to a factor of two.
"""

import dataclasses
import pathlib
from collections.abc import Callable

from experiments.core.context import Context
from experiments.core.results import ReportPart, Results, assemble
from experiments.core.runner import Experiment
from experiments.fields.depth_accuracy import (
    contact_section,
    generated_sections,
    integrator_section,
    known_depth_section,
    recorded_sections,
)
from experiments.fields.false_alarms import pattern_section
from experiments.fields.known_motion import gels
from experiments.fields.marker_drift import drift_section
from experiments.fields.shear_accuracy import layer_section, shear_section
from experiments.fields.tracking_accuracy import dense_section, marker_section

PICTURES = 20  # pictures of each folder for the recognition of marker gels


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldsConfig:
    """Sizes of the measurements."""

    data_dir: pathlib.Path | None = None  # folder of the recordings; `None` for generated input alone
    rounds: int = 51  # of timing
    folds: int = 5  # of the presses
    generated_presses: int = 24  # of each generated ball
    strange_lamps: bool = True  # measure balls under lamps that the calibration's model does not cover, too
    motion: bool = True  # measure the fields of motion, too
    seed: int = 0  # of folds and generated presses


def run(config: FieldsConfig, context: Context) -> Results:
    """Measure section by section."""
    root, rounds, seed = config.data_dir, config.rounds, config.seed
    balls = config.generated_presses, config.strange_lamps, rounds, seed
    measured: dict[str, Callable[[], list[ReportPart]]] = {
        "integrators": lambda: integrator_section(context.rounds("timing integrators", rounds)),
        "generated balls": lambda: generated_sections(*balls, context),
    }
    if root is not None:
        measured["real balls"] = lambda: recorded_sections(root, config.folds, rounds, seed, context)
        measured["known depth"] = lambda: known_depth_section(root, seed, context)
        measured["failed contact"] = lambda: contact_section(root, seed)
    if config.motion:
        subjects = gels(root)
        real = [gel for gel in subjects if gel.real] or subjects[:1]
        measured["markers"] = lambda: marker_section(subjects, context)
        measured["drift"] = lambda: drift_section(real)
        measured["dense fields"] = lambda: dense_section(rounds, subjects, context)
        measured["shear"] = lambda: shear_section(root, context)
        measured["wrong layers"] = layer_section
    if config.motion and root is not None:
        measured["patterns"] = lambda: pattern_section(root, PICTURES, context)
    parts: list[ReportPart] = []
    for name, measure in context.each("sections", measured.items()):
        context.print(name)
        with context.timed(name):
            parts += measure()
    return assemble(parts, {"recordings": "none" if root is None else "read", "cores": 1})


EXPERIMENT = Experiment(
    name="pareto_fields",
    config=FieldsConfig(),
    run=run,
    scales={"smoke": FieldsConfig(rounds=5, folds=2, generated_presses=10, strange_lamps=False, motion=False)},
)
