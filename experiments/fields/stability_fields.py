"""Where does each method of measuring depth and motion of a gel fail, and does a flag report the failure?

    python -m experiments stability_fields --data-dir DIR [--scale smoke]

Known motion on pictures of marker gels, generated ones without `--data-dir`; shear on generated slides; depth on
generated presses of a ball; each under stresses from harmless to hopeless.  A method fails if more than 5 % of its
points are a pixel off, if the error of shear exceeds half of the shear, or that of depth a fifth of the press.  Two
further tables count flags on real pictures, and bare gels taken for marker gels.  None of the tracker's settings was
chosen on these pictures, motions or noise.

Six minutes on one core (`smoke` half a minute).  Expected: the package's tracker fails last and never without a flag;
methods that match from frame to frame or to the nearest dot fail at half a pitch without a flag.
"""

import dataclasses
import itertools
import pathlib

from experiments.core.context import Context
from experiments.core.results import Results, assemble
from experiments.core.runner import Experiment
from experiments.fields.false_alarms import flag_section, pattern_section
from experiments.fields.known_motion import gels
from experiments.fields.stress import OURS, gathered, silent_frames, stress_section
from experiments.fields.stressed_readings import DEPTH, SHEAR, TRACKING, attempt_depth, attempt_shear, attempt_tracking
from touchr1_jax.validation import at_least

METHODS = (OURS, "this, LK alone", "LK to rest", "LK frame to frame", "DIS medium", "dots, nearest", "mean shift")


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldStabilityConfig:
    """Sizes of the measurements."""

    data_dir: pathlib.Path | None = None  # folder of the recordings; `None` for generated gels alone
    gels: int = 3
    seeds: int = 2  # motions of each gel, and presses under each level for depth
    methods: tuple[str, ...] = METHODS  # of tracking
    slide_frames: int = 36  # of the slide that shear is read on
    ball_presses: int = 24  # that the calibration of depth is made with
    pictures: int = 60  # of each folder, for the recognition of marker gels
    seed: int = 900  # the first one

    def __post_init__(self) -> None:
        at_least(self, 1, "gels", "seeds", "pictures")
        if OURS not in self.methods:
            raise ValueError(f"methods is {self.methods}: must hold {OURS!r}, which the rest is compared with; add it")


def run(config: FieldStabilityConfig, context: Context) -> Results:
    """Stress tracking, shear and depth; count false alarms on real pictures."""
    chosen = gels(config.data_dir, config.gels)
    motions = itertools.product(chosen, range(config.seed, config.seed + config.seeds))
    tracking = gathered(
        attempt
        for gel, seed in context.each("motions", motions)
        for attempt in attempt_tracking(gel, config.methods, seed)
    )
    shear = gathered(attempt_shear(config.slide_frames, config.seed, context))
    depth = gathered(attempt_depth(config.ball_presses, config.seeds, config.seed, context))
    mild = [tracking[OURS][stress, levels[0]] for stress, levels in TRACKING.stresses.items()]
    whole = [o for frames in mild for o in frames if not o.broken]
    flagged = sum(bool(o.flags) for o in whole)
    parts = [
        *stress_section(TRACKING, tracking),
        f"{OURS}: {flagged} of {len(whole)} frames under the mildest level of each stress are flagged.",
        *stress_section(SHEAR, shear),
        *stress_section(DEPTH, depth),
    ]
    if config.data_dir is not None:
        parts += flag_section(config.data_dir, context)
        parts += pattern_section(config.data_dir, config.pictures, context)
    settings = {
        "gels": [gel.name for gel in chosen],
        "motions a gel": config.seeds,
        "a point is wrong from": f"{TRACKING.tolerance} px",
    }
    silent = {f"broken without a flag, {name}": silent_frames(by) for name, by in tracking.items()}
    return assemble(parts, settings, silent)


SMOKE = FieldStabilityConfig(
    gels=1, seeds=1, methods=(OURS, "LK to rest", "dots, nearest"), slide_frames=18, ball_presses=10, pictures=4
)

EXPERIMENT = Experiment(name="stability_fields", config=FieldStabilityConfig(), scales={"smoke": SMOKE}, run=run)
