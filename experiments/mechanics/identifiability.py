"""What can be told from touch, and what does a cheaper contact cost?

    python -m experiments identifiability [--scale smoke]

Generated objects are pressed once, 0.3 to 5 N in four frames, by all four sensors.  A linear probe on fixed features of
a sensor's pictures, fields and force predicts hardness, roughness and protrusion of unseen objects, at several
multiples of the sensors' noise; it is compared with probes that know the true shape alone, or the measured force alone.
The accuracy of such a probe is a lower bound of what touch can tell.  Then the probe is trained at other tiers of the
contact ladder, on the same presses with the same noise, and tested on the exact ones.  Friction and elasticity, which a
press cannot tell, are predicted from a slide and from a press that is released, both from the protocol.  Intervals are
over objects.

Cost: about seven minutes on two cores (`smoke` two minutes on one).

Expected: touch tells hardness far better than shape or force alone, which stay near guessing; roughness is told by the
camera of the GelSight Mini alone; protrusion by all sensors, less well than by its shape.  The generator's grid of 64²
costs a probe less than a point, 24² several, a bed of springs ten.
"""

import dataclasses
from collections.abc import Mapping
from collections.abc import Sequence as Seq

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Requirement, Results
from experiments.core.runner import Experiment
from experiments.mechanics import identify_motions, identify_report
from experiments.mechanics.identify_motions import MOTIONS, MotionData
from experiments.mechanics.identify_presses import ContactTier, PressData, press
from experiments.mechanics.identify_probes import (
    DYNAMIC,
    FORCE,
    FUSED,
    SHAPE,
    STATIC,
    by_motion,
    from_tiers,
    over_noise,
    without_touch,
)
from experiments.mechanics.identify_report import CHANCE, MAY_LOSE, ProbeFigures, StudyPredictions, figures
from sensors_io.live import LiveScenes
from sensors_io.scenes.config import SceneConfig, require
from sensors_io.scenes.validity import STRAIN_LIMIT
from sensors_io.schema import SENSORS
from touchr1_jax.training.linear_probe import ProbeConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class IdentifiabilityConfig:
    """Scenes, contact tiers, noise and probes of the study.

    Args:
      presses: objects that are pressed, without `sequences`; the tiers replace its grid and tolerance.
      grids: sides of the contact grids to train at, at the generator's tolerance.
      coarsest_used: the coarsest grid that training data come from; of coarser ones nothing is required.
      usual_grid: the one that is also solved loosely, and by springs.
      loose_tolerance: of the loosest tier.
      exact_grid, exact_tolerance: of what stands for the exact solution.
      noise: multiples of the sensors' noise, 1 among them.
      motions: the protocol that slides and held presses are taken from.
      moments: frames of a motion that are looked at.
      probe: folds and fit.
      batch: presses in one call of a compiled program.
    """

    presses: SceneConfig = SceneConfig(objects=600, sites=1, frames=4, min_force_n=0.3, max_force_n=5.0)
    grids: tuple[int, ...] = (24, 32, 48, 64, 96)
    coarsest_used: int = 64
    usual_grid: int = 64
    loose_tolerance: float = 1e-2
    exact_grid: int = 128
    exact_tolerance: float = 1e-4
    noise: tuple[float, ...] = (0.0, 1.0, 2.0, 4.0)
    motions: SceneConfig = SceneConfig(objects=300, sequences=4 * 2100, frames=24, image_px=56, contact_grid=32)
    moments: int = 8
    probe: ProbeConfig = ProbeConfig()
    batch: int = 50

    def __post_init__(self) -> None:
        require(1.0 in self.noise, "noise", self.noise, "must hold 1.0, the sensors' own")
        require(self.presses.sequences is None, "presses.sequences", self.presses.sequences, "must be None")
        require(self.motions.sequences is not None, "motions.sequences", None, "must be a number: the protocol's")
        require(self.exact_grid > max(self.grids), "exact_grid", self.exact_grid, "must be finer than all of grids")

    @property
    def exact(self) -> ContactTier:
        """The tier that stands for the exact solution."""
        return ContactTier(name=f"exact, {self.exact_grid}²", grid=self.exact_grid, tolerance=self.exact_tolerance)

    @property
    def solved(self) -> tuple[ContactTier, ...]:
        """Tiers that solve the contact."""
        usual = self.usual_grid
        loose = ContactTier(name=f"{usual}², {self.loose_tolerance:g}", grid=usual, tolerance=self.loose_tolerance)
        return (*(ContactTier(name=f"{n}²", grid=n) for n in self.grids), loose)

    @property
    def springs(self) -> ContactTier:
        """The negative control."""
        return ContactTier(name=f"springs, {self.usual_grid}²", grid=self.usual_grid, springs=True)


def run(config: IdentifiabilityConfig, context: Context) -> Results:
    """Press, move, ask."""
    tiers = (*config.solved, config.springs)
    with context.timed("presses"), context.progress("presses", len(SENSORS) * (1 + len(tiers))) as advance:
        at_own_noise = [(tier, (1.0,)) for tier in tiers]
        pressed = press(config.presses, [(config.exact, config.noise), *at_own_noise], config.batch, advance)
    with context.timed("motions"):
        moved = {motion: _move(config, motion, context) for motion in context.each("motions", MOTIONS)}
    with context.timed("probes"):
        studied = _ask(config, pressed, moved, context)
    return findings(config, studied)


def _move(config: IdentifiabilityConfig, motion: str, context: Context) -> MotionData:
    count = len(identify_motions.contacts_of(LiveScenes(config.motions), motion))
    with context.progress(motion, count) as advance:
        return identify_motions.motion_data(config.motions, motion, config.moments, advance)


def _ask(
    config: IdentifiabilityConfig, pressed: PressData, moved: dict[str, MotionData], context: Context
) -> StudyPredictions:
    """Every probe."""
    tiers, own = (*config.solved, config.springs), config.noise.index(1.0)
    held = [np.asarray(pressed.by_tier[config.exact.name, order].features)[:, own] for order in range(len(SENSORS))]
    dynamic: dict[str, tuple[Seq[np.ndarray], PressData | MotionData]] = {"press": (held, pressed)}
    dynamic |= {motion: (m.touch, m) for motion, m in moved.items()}
    per_sensor = len(STATIC) * (len(config.noise) + len(tiers)) + len(DYNAMIC) * len(dynamic)
    blind = 2 * (len(STATIC) + len(DYNAMIC) * len(dynamic))
    with context.progress("probes", len(SENSORS) * per_sensor + blind) as advance:
        return StudyPredictions(
            noise=config.noise,
            exact=config.exact.name,
            solved=tuple(tier.name for tier in config.solved),
            springs=config.springs.name,
            touch=over_noise(pressed, config.exact, len(config.noise), config.probe, advance),
            blind=without_touch(pressed, STATIC, config.probe, advance),
            tiers=from_tiers(pressed, tiers, config.exact, own, config.probe, advance),
            motion={name: by_motion(touch, m, config.probe, advance) for name, (touch, m) in dynamic.items()},
            still={name: without_touch(m, DYNAMIC, config.probe, advance) for name, (_, m) in dynamic.items()},
            pressed=pressed,
            moved=moved,
        )


def findings(config: IdentifiabilityConfig, studied: StudyPredictions) -> Results:
    """Everything that is reported."""
    made, scenes = figures(studied), config.presses
    strain = studied.pressed.by_tier[studied.exact, 0].strain
    return Results(
        verdict=verdict(config, studied, made),
        requirements=requirements(config, studied, made),
        tables=(
            identify_report.touch_table(studied, made),
            identify_report.blind_table(studied, made),
            identify_report.tier_table(studied, made),
            identify_report.motion_table(studied, made),
        ),
        pictures=(identify_report.noise_picture(studied, made), identify_report.tier_picture(made)),
        settings={
            "presses": f"{len(studied.pressed.objects)} objects, {scenes.frame_count} frames of {scenes.min_force_n:g} "
            f"to {scenes.max_force_n:g} N, pictures of {scenes.image_px} px",
            "frames past the strain limit": f"{100 * float(np.mean(strain > STRAIN_LIMIT)):.1f} % on {SENSORS[0]}, "
            "kept: leaving them out would tell hardness",
            "motions": ", ".join(f"{len(m.objects)} × {name}" for name, m in studied.moved.items()),
        },
        data={
            "frames not converged": {
                f"{tier}, {SENSORS[order]}": int(np.sum(~found.converged))
                for (tier, order), found in studied.pressed.by_tier.items()
                if tier != studied.springs
            }
        },
    )


def requirements(
    config: IdentifiabilityConfig, studied: StudyPredictions, made: ProbeFigures
) -> tuple[Requirement, ...]:
    """Every tier in use against what it may lose, by its worst property.

    Springs, whose pressure is known to be wrong, must lose more than that beyond doubt, or the comparison is blind.
    """
    kept = []
    for tier in (t.name for t in config.solved if t.grid >= config.coarsest_used):
        name = max(STATIC, key=lambda name: made.lost[tier, name].mean)
        worst = made.lost[tier, name]
        kept.append(
            Requirement(
                name=f"trained at {tier}, asked about exact records: lost at worst",
                measured=worst.mean,
                bound=MAY_LOSE,
                better="lower",
                unit="points",
                note=f"{name}, mean over sensors, 95 % from {worst.low:.1f} to {worst.high:.1f}",
            )
        )
    control = made.lost[studied.springs, STATIC[0]]
    kept.append(
        Requirement(
            name=f"control: {STATIC[0]} lost by {studied.springs}, at least",
            measured=control.low,
            bound=MAY_LOSE,
            better="higher",
            unit="points",
            note=f"lower end of the 95 % interval about {control.mean:.1f}",
        )
    )
    return tuple(kept)


def verdict(config: IdentifiabilityConfig, studied: StudyPredictions, made: ProbeFigures) -> tuple[str, ...]:
    """The answer in sentences."""
    own, last, hardness = studied.own, len(studied.noise) - 1, STATIC[0]
    fused = {name: made.told[name, FUSED, own].mean for name in STATIC}
    fall = {
        name: float(np.mean([made.told[name, s, own].mean - made.told[name, s, last].mean for s in SENSORS]))
        for name in STATIC
    }
    used = [t.name for t in config.solved if t.grid >= config.coarsest_used]
    tier, name = max(((t, n) for t in used for n in STATIC), key=lambda key: made.lost[key].mean)
    return (
        f"All four sensors together tell of unseen objects {_listed(fused, '%')}. For {hardness}, true shape alone "
        f"gives {made.blind[hardness, SHAPE].mean:.0f} %, force alone {made.blind[hardness, FORCE].mean:.0f} %, "
        f"guessing {CHANCE:.0f} %.",
        f"Noise ×{studied.noise[last]:g} instead of ×1 costs a sensor {_listed(fall, 'points')}.",
        "Trained at a tier in use and asked about exact records, a probe loses at most "
        f"{made.lost[tier, name].mean:.1f} points ({name}, {tier}); trained on springs, "
        f"{made.lost[studied.springs, hardness].mean:.0f} of {hardness}.",
        f"Touch without force tells friction {made.moved['friction', 'slide_x'].mean:.0f} % from a slide and "
        f"{made.moved['friction', 'press'].mean:.0f} % from a press, elasticity "
        f"{made.moved['elasticity', 'hold'].mean:.0f} % from a press that is released and "
        f"{made.moved['elasticity', 'press'].mean:.0f} % from one that is not.",
    )


def _listed(named: Mapping[str, float], unit: str) -> str:
    return ", ".join(f"{name} {value:.0f} {unit}" for name, value in named.items())


DEFAULT = IdentifiabilityConfig()
SMOKE = dataclasses.replace(
    DEFAULT,
    presses=dataclasses.replace(DEFAULT.presses, objects=40, image_px=56),
    grids=(24,),
    coarsest_used=24,
    usual_grid=24,
    exact_grid=48,
    noise=(1.0, 4.0),
    motions=SceneConfig(objects=12, sequences=4 * 84, frames=20, image_px=28, contact_grid=24),
    moments=6,
    probe=ProbeConfig(iterations=20),
    batch=20,
)

EXPERIMENT = Experiment(name="identifiability", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
