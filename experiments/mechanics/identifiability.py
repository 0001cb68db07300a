"""Which properties does touch identify, and what does a cheaper contact cost?

    python -m experiments identifiability [--scale smoke]

All four sensors press generated objects once, 0.3 to 5 N in four frames.  A linear probe on fixed features of pictures,
fields and force predicts hardness, roughness and protrusion of unseen objects at several multiples of the sensors'
noise, next to probes that know the true shape or the force alone; its accuracy is a lower bound of the information in
touch.  Then the probe is trained on the same presses with the same noise from cheaper contact solvers, and tested on
the exact ones.  Friction and elasticity are predicted from a slide and from a press that is released.

Cost: about seven minutes on two cores (`smoke` two minutes on one).

Expected: touch predicts hardness far better than shape or force alone, which stay near guessing; roughness by the
camera of the GelSight Mini alone; protrusion by all sensors.  The generator's grid of 64² costs a probe less than a
point, 24² several, a bed of springs ten.
"""

import dataclasses
import functools
from collections.abc import Sequence as Seq

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Requirement, Results, at_least, at_most
from experiments.core.runner import Experiment
from experiments.mechanics import identify_motions
from experiments.mechanics import identify_report as report
from experiments.mechanics.identify_features import ContactData
from experiments.mechanics.identify_motions import MOTIONS, MotionData
from experiments.mechanics.identify_presses import ContactTier, PressData, press
from experiments.mechanics.identify_probes import DYNAMIC, FORCE, FUSED, SHAPE, STATIC, answers
from experiments.mechanics.identify_report import CHANCE, MAY_LOSE, StudyPredictions
from sensors_io.live import LiveScenes
from sensors_io.scenes.config import SceneConfig, require
from sensors_io.scenes.validity import STRAIN_LIMIT
from sensors_io.schema import SENSORS
from touchr1_jax.training.linear_probe import ProbeConfig

LOOSE_TOLERANCE, EXACT_TOLERANCE = 1e-2, 1e-4
"""Tolerances of the loosest tier and of the one that stands for the exact solution."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class IdentifiabilityConfig:
    """Scenes, contact tiers, noise and probes of the study.

    Args:
      presses: objects that are pressed, without `sequences`; the tiers replace its grid and tolerance.
      grids: sides of the contact grids to train at, at the generator's tolerance.
      coarsest_used: the coarsest grid that training data come from; of coarser ones nothing is required.
      usual_grid: the one that is also solved loosely, and by springs.
      exact_grid: that of the tier that stands for the exact solution.
      noise: multiples of the sensors' noise, 1 among them.
      motions: the protocol that slides and held presses are taken from.
      moments: frames of a motion that are used.
      probe: folds and fit.
      batch: presses in one call of a compiled program.
    """

    presses: SceneConfig = SceneConfig(objects=600, sites=1, frames=4, min_force_n=0.3, max_force_n=5.0)
    grids: tuple[int, ...] = (24, 32, 48, 64, 96)
    coarsest_used: int = 64
    usual_grid: int = 64
    exact_grid: int = 128
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
        return ContactTier(name=f"exact, {self.exact_grid}²", grid=self.exact_grid, tolerance=EXACT_TOLERANCE)

    @property
    def solved(self) -> tuple[ContactTier, ...]:
        """Tiers that solve the contact."""
        name = f"{self.usual_grid}², {LOOSE_TOLERANCE:g}"
        loose = ContactTier(name=name, grid=self.usual_grid, tolerance=LOOSE_TOLERANCE)
        return (*(ContactTier(name=f"{n}²", grid=n) for n in self.grids), loose)

    @property
    def springs(self) -> ContactTier:
        """The negative control."""
        return ContactTier(name=f"springs, {self.usual_grid}²", grid=self.usual_grid, springs=True)


def run(config: IdentifiabilityConfig, context: Context) -> Results:
    """Press, move, train probes, compare."""
    tiers = (*config.solved, config.springs)
    with context.timed("presses"), context.progress("presses", len(SENSORS) * (1 + len(tiers))) as advance:
        at_own_noise = [(tier, (1.0,)) for tier in tiers]
        pressed = press(config.presses, [(config.exact, config.noise), *at_own_noise], config.batch, advance)
    moved = {}
    with context.timed("motions"):
        for motion in context.each("motions", MOTIONS):
            count = len(identify_motions.contacts_of(LiveScenes(config.motions), motion))
            with context.progress(motion, count) as advance:
                moved[motion] = identify_motions.motion_data(config.motions, motion, config.moments, advance)
    with context.timed("probes"):
        studied = _predict(config, pressed, moved, context)
    return findings(config, studied)


def _predict(
    config: IdentifiabilityConfig, pressed: PressData, moved: dict[str, MotionData], context: Context
) -> StudyPredictions:
    tiers, own = (*config.solved, config.springs), config.noise.index(1.0)
    at_rest = [np.asarray(pressed.by_tier[config.exact.name, order].features)[:, own] for order in range(len(SENSORS))]
    dynamic: dict[str, tuple[Seq[np.ndarray], ContactData]] = {"press": (at_rest, pressed)}
    dynamic |= {motion: (m.touch, m) for motion, m in moved.items()}
    per_sensor = len(STATIC) * (len(config.noise) + len(tiers)) + len(DYNAMIC) * len(dynamic)
    without = 2 * (len(STATIC) + len(DYNAMIC) * len(dynamic))
    touched = lambda tier, level: {s: pressed.features(tier, order, level) for order, s in enumerate(SENSORS)}
    blind = lambda data: {SHAPE: data.shape, FORCE: data.force.reshape(len(data.force), -1)}
    with context.progress("probes", len(SENSORS) * per_sensor + without) as advance:
        ask = functools.partial(answers, config=config.probe, advance=advance)
        exact = [touched(config.exact, level) for level in range(len(config.noise))]
        return StudyPredictions(
            noise=config.noise,
            exact=config.exact.name,
            solved=tuple(tier.name for tier in config.solved),
            springs=config.springs.name,
            touch=[ask([records], STATIC, pressed)[0] for records in exact],
            blind=ask([blind(pressed)], STATIC, pressed)[0],
            tiers={tier.name: ask([touched(tier, 0), exact[own]], STATIC, pressed) for tier in tiers},
            motion={n: ask([dict(zip(SENSORS, t, strict=True))], DYNAMIC, m)[0] for n, (t, m) in dynamic.items()},
            still={name: ask([blind(m)], DYNAMIC, m)[0] for name, (_, m) in dynamic.items()},
            pressed=pressed,
            moved=moved,
        )


def findings(config: IdentifiabilityConfig, studied: StudyPredictions) -> Results:
    """The report."""
    scenes, by_tier = config.presses, studied.pressed.by_tier
    strain = by_tier[studied.exact, 0].strain
    return Results(
        verdict=_verdict(config, studied),
        requirements=_requirements(config, studied),
        tables=(
            report.touch_table(studied),
            report.blind_table(studied),
            report.tier_table(studied),
            report.motion_table(studied),
        ),
        pictures=(report.noise_picture(studied), report.tier_picture(studied)),
        settings={
            "presses": f"{len(studied.pressed.objects)} objects, {scenes.frame_count} frames of {scenes.min_force_n:g} "
            f"to {scenes.max_force_n:g} N, pictures of {scenes.image_px} px",
            "frames past the strain limit": f"{100 * float(np.mean(strain > STRAIN_LIMIT)):.1f} % on {SENSORS[0]}, "
            "kept: without them the remaining frames would show hardness",
            "motions": ", ".join(f"{len(m.objects)} × {name}" for name, m in studied.moved.items()),
        },
        data={
            "frames not converged": {
                f"{tier}, {SENSORS[order]}": int(np.sum(~found.converged))
                for (tier, order), found in by_tier.items()
                if tier != studied.springs
            }
        },
    )


def _requirements(config: IdentifiabilityConfig, studied: StudyPredictions) -> tuple[Requirement, ...]:
    """Loss of every tier in use, by its worst property.

    Springs, whose pressure is known to be wrong, must lose significantly more than that, or the comparison is blind.
    """
    kept = []
    for tier in (t.name for t in config.solved if t.grid >= config.coarsest_used):
        name = max(STATIC, key=lambda name: studied.lost[tier, name].mean)
        worst = studied.lost[tier, name]
        note = f"{name}, mean over sensors, 95 % from {worst.low:.1f} to {worst.high:.1f}"
        title = f"trained at {tier}, tested on exact records: lost at worst"
        kept.append(at_most(title, worst.mean, MAY_LOSE, "points", note))
    control = studied.lost[studied.springs, STATIC[0]]
    note = f"lower end of the 95 % interval about {control.mean:.1f}"
    title = f"control: {STATIC[0]} lost by {studied.springs}, at least"
    return (*kept, at_least(title, control.low, MAY_LOSE, "points", note))


def _verdict(config: IdentifiabilityConfig, studied: StudyPredictions) -> tuple[str, ...]:
    hardness, moved = STATIC[0], studied.moved_accuracy
    fused = ", ".join(f"{name} {studied.accuracy[name, FUSED, studied.own].mean:.0f} %" for name in STATIC)
    used = [t.name for t in config.solved if t.grid >= config.coarsest_used]
    lost = max(studied.lost[tier, name].mean for tier in used for name in STATIC)
    return (
        f"Right answers of all four sensors together about unseen objects: {fused}; guessing {CHANCE:.0f} %. For "
        f"{hardness}, true shape alone gives {studied.blind_accuracy[hardness, SHAPE].mean:.0f} %, force alone "
        f"{studied.blind_accuracy[hardness, FORCE].mean:.0f} %.",
        f"A tier in use costs a probe at most {lost:.1f} points, springs cost "
        f"{studied.lost[studied.springs, hardness].mean:.0f} of {hardness}.",
        f"A slide gives friction in {moved['friction', 'slide_x'].mean:.0f} %, a press that is released elasticity in "
        f"{moved['elasticity', 'hold'].mean:.0f} %.",
    )


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
