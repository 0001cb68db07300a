"""What makes latent prediction collapse, is it noticed, and what cures it?

    make experiment EXP=stability_encoder [ARGS="--scale smoke"]

Stage 1 in small: pictures of 28 px of two sensors, an encoder of one layer, ten seeds in one program.  One guard after
the other is taken away: stop-gradient, moving average, variance and covariance terms, and the learning rate is raised;
then single guards are given back.  On validation objects every run is measured as it goes: what contacts differ by
relative to the size of the latents, effective rank, skill over copying the last latent.  These are the alarms, and they
strike when a bound is passed twice in a row and nothing recovers.  A run has failed if at its end contacts of the test
objects differ by less than half of what they did before training.  Linear probes see little of it: they scale every
feature to unit spread, however small it is, which a decoder cannot.

Cost: about six minutes on one core, `--scale smoke` under one.

Expected: without any guard all contacts become one point, and the alarm says so at step 75; the two terms alone prevent
it.  With the stop-gradient but without terms latents stay small without losing what tells contacts apart, and no alarm
strikes.  Without the average either, contacts come together for some dozen steps and part again.  A rate thirty times
too high costs skill, and some alarms.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.errors import DataError
from experiments.core.results import Cell, Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.encoder.charts import collapse_curves
from experiments.encoder.collapse import CollapseArm, CollapseRun, Runner, in_memory, make_runner
from experiments.encoder.data import StageOneDataConfig, open_touch, training_rows
from experiments.study.dataset import Dataset
from experiments.study.feeds import touch_batch
from sensors_io.pipeline import clip_batches
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.training.dynamics import DynamicsConfig, Guards
from touchr1_jax.training.evidence import ProbeConfig
from touchr1_jax.training.probes import collapse_alarms, probe_right
from touchr1_jax.types import TouchBatch

RATE = 1e-3
NONE = Guards(variance=0.0, covariance=0.0)
ARMS = (
    CollapseArm(name="all guards", guards=Guards(), rate=RATE),
    CollapseArm(name="no terms", guards=NONE, rate=RATE),
    CollapseArm(name="no terms, no average", guards=dataclasses.replace(NONE, ema=0.0), rate=RATE),
    CollapseArm(name="no guards", guards=dataclasses.replace(NONE, ema=0.0, leak=1.0), rate=RATE),
    CollapseArm(name="variance alone", guards=dataclasses.replace(NONE, variance=1.0), rate=RATE, cures="no terms"),
    CollapseArm(name="terms without average", guards=Guards(ema=0.0), rate=RATE, cures="no terms, no average"),
    CollapseArm(name="terms alone", guards=Guards(ema=0.0, leak=1.0), rate=RATE, cures="no guards"),
    CollapseArm(name="all guards, rate × 30", guards=Guards(), rate=30 * RATE),
)
"""Guards taken away, then given back."""

GRACE = 1
"""Measurements that no alarm looks at: a fresh encoder takes some dozen steps to spread."""

FAILED_SHARE = 0.5
"""Share of the untrained encoder's `telling` that a run must keep."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityEncoderConfig:
    """Data in memory, networks, length."""

    touch: StageOneDataConfig = StageOneDataConfig(scenes=SceneConfig(objects=600, sites=1, image_px=28, seed=1))
    sensors: int = 2
    """The first ones of the records."""
    frames: int = 4
    seeds: int = 10
    batch_size: int = 16
    blocks: int = 6
    block_steps: int = 25
    encoder: TactileViTConfig = TactileViTConfig(
        sensors=0, width=32, num_layers=1, num_heads=2, stem_px=2, stem_width=8, tokens_per_step=1, causal=True
    )
    predictor: PredictorConfig = PredictorConfig(width=32, num_layers=1, num_heads=2)
    probe: ProbeConfig = ProbeConfig(iterations=30)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CollapseOutcome:
    """One arm: what was seen of every seed, [seed, block].

    Args:
      arm: how it was trained.
      looks: the measurements that raise alarms.
      kept: [seed], what test contacts differ by at the end, over what they did before training, `probes.told_apart`.
      lead: [seed], points of the probes over those on the untrained encoder, at the end.
    """

    arm: CollapseArm
    looks: dict[str, np.ndarray]
    kept: np.ndarray
    lead: np.ndarray

    @property
    def failed(self) -> np.ndarray:
        """Which seeds tell contacts apart by less than half of what they did untrained, bool [seed]."""
        return self.kept < FAILED_SHARE

    @property
    def alarmed(self) -> np.ndarray:
        """Which seeds raised an alarm during training, bool [seed]; the probe's alarm comes too late to count."""
        return np.array([self.first_alarm(seed) is not None for seed in range(len(self.lead))])

    def first_alarm(self, seed: int) -> int | None:
        """The measurement at which a seed raised its first alarm, those of the beginning left out."""
        reading = lambda block: {name: float(x[seed, block]) for name, x in self.looks.items()}
        for block in range(GRACE + 1, next(iter(self.looks.values())).shape[1]):
            if collapse_alarms(reading(block - 1), reading(block)):
                return block
        return None


def run(config: StabilityEncoderConfig, context: Context) -> Results:
    """Every arm, all seeds at once.

    Raises:
      DataError: a single contact to watch.
    """
    data = open_touch(config.touch, config.frames, config.touch.scenes.image_px, context)
    if len(data.parts["val"]) < 2:
        raise DataError("part 'val' holds 1 contact: must hold two, or nothing can differ; use more objects")
    contacts, label, train = load(data, config, context)
    watched = batch_of(data, config, data.parts["val"], context)
    encoder = dataclasses.replace(config.encoder, sensors=config.sensors)
    networks = DynamicsConfig(encoder=encoder, predictor=config.predictor)
    runner = make_runner(
        networks,
        contacts,
        train,
        watched,
        batch_size=config.batch_size,
        blocks=config.blocks,
        block_steps=config.block_steps,
    )
    keys = jax.random.split(jax.random.key(0), config.seeds)
    outcomes = []
    with context.progress("arms", len(ARMS)) as advance:
        for arm in ARMS:
            outcomes.append(drive(runner, arm, keys, label, train, config.probe))
            advance()
    return findings(config, outcomes)


def load(data: Dataset, config: StabilityEncoderConfig, context: Context) -> tuple[TouchBatch, np.ndarray, np.ndarray]:
    """All contacts of training and test objects, their ordinal labels, and which are for training."""
    fit, read = training_rows(data), data.parts["test"]
    rows = np.concatenate([fit, read])
    label = data.label[rows][:, [ATTRIBUTES.index(name) for name in ORDINAL]]
    return batch_of(data, config, rows, context), label, np.arange(len(rows)) < len(fit)


def batch_of(data: Dataset, config: StabilityEncoderConfig, rows: np.ndarray, context: Context) -> TouchBatch:
    """Some contacts as one batch."""
    clip = dataclasses.replace(data.clip, sensors=data.clip.sensors[: config.sensors], view_px=1)
    clips = clip_batches(data.store, rows, clip, batch_size=64, seed=0, shuffle=False, repeat=False)
    found = []
    with context.progress("reading clips", len(rows)) as advance:
        for one in clips:
            found.append(touch_batch(one))
            advance(len(one["contact"]))
    return in_memory(found)


def drive(
    runner: Runner, arm: CollapseArm, keys: jax.Array, label: np.ndarray, train: np.ndarray, probe: ProbeConfig
) -> CollapseOutcome:
    """Train all seeds of an arm and probe them."""
    course: CollapseRun = jax.device_get(runner(arm.guards, jnp.float32(arm.rate), keys))
    lead = [
        100.0 * (probe_right(after, label, train, probe).mean() - probe_right(before, label, train, probe).mean())
        for before, after in zip(course.before, course.after, strict=True)
    ]
    kept = course.end.telling / course.start.telling
    looks = {
        "kept": np.asarray(course.looks.telling / course.untrained.telling[:, None]),
        "rank_share": np.asarray(course.looks.rank_share),
        "skill": np.asarray(course.looks.skill),
    }
    return CollapseOutcome(arm=arm, looks=looks, kept=np.asarray(kept), lead=np.array(lead))


def findings(config: StabilityEncoderConfig, outcomes: list[CollapseOutcome]) -> Results:
    """Who failed, who was noticed, what cured it."""
    failed = np.concatenate([o.failed for o in outcomes])
    alarmed = np.concatenate([o.alarmed for o in outcomes])
    by = {o.arm.name: o for o in outcomes}
    noticed = float(alarmed[failed].mean()) if failed.any() else 1.0
    false = float(alarmed[~failed].mean()) if (~failed).any() else 0.0
    cures = [o for o in outcomes if o.arm.cures and by[o.arm.cures].failed.any()]
    return Results(
        verdict=(
            f"{failed.sum()} of {len(failed)} runs collapsed; alarms during training noticed "
            f"{noticed:.0%} of them and struck in {false:.0%} of the others.",
            *(
                f"{o.arm.name}: {o.failed.mean():.0%} of the seeds fail where {by[o.arm.cures].failed.mean():.0%} of "
                f"'{o.arm.cures}' do; contacts differ {np.median(o.kept):.2g} times as much as untrained, there "
                f"{np.median(by[o.arm.cures].kept):.2g}."
                for o in cures
            ),
        ),
        requirements=(
            Requirement(
                name="failed runs that were noticed",
                measured=100 * noticed,
                bound=90.0,
                better="higher",
                unit="%",
                note=f"{(alarmed & failed).sum()} of {failed.sum()}",
            ),
            Requirement(
                name="sound runs with an alarm",
                measured=100 * false,
                bound=10.0,
                better="lower",
                unit="%",
                note=f"{(alarmed & ~failed).sum()} of {(~failed).sum()}",
            ),
            Requirement(
                name="failures with all guards",
                measured=100 * float(by["all guards"].failed.mean()),
                bound=10.0,
                better="lower",
                unit="%",
                note=f"{config.seeds} seeds",
            ),
        ),
        tables=(_table(config, outcomes),),
        pictures=(
            Picture(
                name="stability_encoder",
                title="Courses of collapse",
                caption="Held-out measurements, a thin line for each seed, a bold one for their median; dotted: the "
                "bound of the alarm.",
                content=collapse_curves({o.arm.name: o.looks for o in outcomes}, config.block_steps),
            ),
        ),
        settings={"seeds": config.seeds, "steps": config.blocks * config.block_steps, "learning rate": RATE},
    )


def _table(config: StabilityEncoderConfig, outcomes: list[CollapseOutcome]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for o in outcomes:
        first = [b for seed in range(config.seeds) if (b := o.first_alarm(seed)) is not None]
        when = config.block_steps * (1 + float(np.median(first))) if first else None
        ends = [float(np.median(o.looks[name][:, -1])) for name in ("rank_share", "skill")]
        rows.append(
            (
                o.arm.name,
                float(np.median(o.kept)),
                *ends,
                float(o.lead.mean()),
                100 * o.failed.mean(),
                100 * o.alarmed.mean(),
                when,
            )
        )
    return Table(
        title=f"Ends of {config.seeds} seeds",
        columns=(
            Column(name="arm"),
            Column(name="kept", format=".2f", meaning="what contacts differ by, over what they did untrained, median"),
            Column(name="rank", format=".2f", meaning="effective rank over width, median over seeds"),
            Column(name="skill", format=".2f", meaning="over copying the last latent, median over seeds"),
            Column(name="probes", unit="pts", format="+.1f", meaning="over the untrained encoder, mean over seeds"),
            Column(name="failed", unit="%", format=".0f", meaning="seeds that keep less than half"),
            Column(name="alarm", unit="%", format=".0f", meaning="seeds with an alarm for what is kept, rank or skill"),
            Column(name="at", unit="step", format=".0f", meaning="of the first alarm, median over seeds"),
        ),
        rows=tuple(rows),
    )


DEFAULT = StabilityEncoderConfig()
SMOKE = StabilityEncoderConfig(
    touch=StageOneDataConfig(scenes=SceneConfig(objects=60, sites=1, image_px=28, seed=1)),
    seeds=2,
    batch_size=8,
    blocks=2,
    block_steps=2,
)

EXPERIMENT = Experiment(name="stability_encoder", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
