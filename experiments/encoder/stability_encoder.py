"""What makes latent prediction collapse, do the alarms detect it, and what prevents it?

    make experiment EXP=stability_encoder [ARGS="--scale smoke"]

A small stage 1: pictures of 28 px of two sensors, an encoder of one layer, ten seeds in one program.  Safeguards are
removed one after the other (variance and covariance terms, moving average, stop-gradient), the learning rate is raised,
then single safeguards are restored.  Three metrics on validation objects are watched: the spread between contacts
relative to the size of the latents, the effective rank, and the skill over copying the last latent.  An alarm fires if
a metric passes its bound twice in a row and none recovers.  A run fails if the final spread between test contacts is
below half of the spread before training.

Cost: 13 minutes in the recorded run on one core, `--scale smoke` under one.

Expected: without any guard all contacts become one point, and the alarm is raised at step 75; the two terms alone
prevent it.  With the stop-gradient but without terms latents stay small but distinguish contacts, and there is no
alarm.  A rate thirty times too high costs skill, and raises some alarms.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.context import Context
from experiments.core.errors import DataError
from experiments.core.look import PALETTE, SHARED
from experiments.core.results import Cell, Picture, Results, Table, at_least, at_most, named_table
from experiments.core.runner import Experiment
from experiments.encoder.pretrain import StageOneDataConfig, open_touch
from experiments.study.dataset import Dataset
from sensors_io.pipeline import clip_batches
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.training.collapse import CollapseRun, CollapseRunner, make_runner
from touchr1_jax.training.dynamics import DynamicsConfig, Guards
from touchr1_jax.training.feeds import touch_batch
from touchr1_jax.training.latent_probes import BOUNDS, collapse_alarms, probe_right
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.types import TouchBatch

SENSORS, FRAMES = 2, 4  # the first sensors of the records
RATE = 1e-3
PREDICTOR = PredictorConfig(width=32, num_layers=1, num_heads=2)
NONE = Guards(variance=0.0, covariance=0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CollapseArm:
    """Guards, learning rate, and the arm whose failure these are meant to cure, if any."""

    name: str
    guards: Guards
    rate: float = RATE
    cures: str = ""


ARMS = (
    CollapseArm(name="all guards", guards=Guards()),
    CollapseArm(name="no terms", guards=NONE),
    CollapseArm(name="no terms, no average", guards=dataclasses.replace(NONE, ema=0.0)),
    CollapseArm(name="no guards", guards=dataclasses.replace(NONE, ema=0.0, leak=1.0)),
    CollapseArm(name="variance alone", guards=dataclasses.replace(NONE, variance=1.0), cures="no terms"),
    CollapseArm(name="terms without average", guards=Guards(ema=0.0), cures="no terms, no average"),
    CollapseArm(name="terms alone", guards=Guards(ema=0.0, leak=1.0), cures="no guards"),
    CollapseArm(name="all guards, rate × 30", guards=Guards(), rate=30 * RATE),
)
"""Guards removed, then restored."""

GRACE = 1
"""Measurements that raise no alarm: the latents of a fresh encoder take some dozen steps to spread."""

FAILED_SHARE = 0.5
"""Share of the untrained encoder's spread that a run must keep."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityEncoderConfig:
    """Data in memory, networks, length."""

    touch: StageOneDataConfig = StageOneDataConfig(scenes=SceneConfig(objects=600, sites=1, image_px=28, seed=1))
    seeds: int = 10
    batch_size: int = 16
    blocks: int = 6
    block_steps: int = 25
    encoder: TactileViTConfig = TactileViTConfig(
        sensors=0, width=32, num_layers=1, num_heads=2, stem_px=2, stem_width=8, tokens_per_step=1, causal=True
    )
    probe: ProbeConfig = ProbeConfig(iterations=30)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CollapseOutcome:
    """One arm: the measurements that raise alarms, by name, [seed, block], and two figures at the end, [seed].

    `kept` is the spread between the test contacts over that before training, `lead` the points of the probes over those
    on the untrained encoder.
    """

    arm: CollapseArm
    measured: dict[str, np.ndarray]
    kept: np.ndarray
    lead: np.ndarray

    @property
    def failed(self) -> np.ndarray:
        """Seeds that keep less than half of the untrained spread, bool [seed]."""
        return self.kept < FAILED_SHARE

    @property
    def alarmed(self) -> np.ndarray:
        """Seeds with an alarm during training, bool [seed]."""
        return np.array([self.first_alarm(seed) is not None for seed in range(len(self.lead))])

    def first_alarm(self, seed: int) -> int | None:
        """The measurement at which a seed raised its first alarm, after the grace period."""
        reading = lambda block: {name: float(x[seed, block]) for name, x in self.measured.items()}
        for block in range(GRACE + 1, next(iter(self.measured.values())).shape[1]):
            if collapse_alarms(reading(block - 1), reading(block)):
                return block
        return None


def run(config: StabilityEncoderConfig, context: Context) -> Results:
    """Every arm, all seeds at once.

    Raises:
      DataError: fewer than two contacts to watch.
    """
    data = open_touch(config.touch, FRAMES, config.touch.scenes.image_px, context)
    if len(data.parts["val"]) < 2:
        raise DataError("part 'val' holds 1 contact: must hold two, or nothing can differ; use more objects")
    fit, test = data.training, data.parts["test"]
    rows = np.concatenate([fit, test])
    label = data.label[rows][:, [ATTRIBUTES.index(name) for name in ORDINAL]]
    train = np.arange(len(rows)) < len(fit)
    runner = make_runner(
        DynamicsConfig(encoder=dataclasses.replace(config.encoder, sensors=SENSORS), predictor=PREDICTOR),
        batch_of(data, rows, context),
        train,
        batch_of(data, data.parts["val"], context),
        batch_size=config.batch_size,
        blocks=config.blocks,
        block_steps=config.block_steps,
    )
    keys = jax.random.split(jax.random.key(0), config.seeds)
    outcomes = [run_arm(runner, arm, keys, label, train, config.probe) for arm in context.each("arms", ARMS)]
    return report(config, outcomes)


def batch_of(data: Dataset, rows: np.ndarray, context: Context) -> TouchBatch:
    """Some contacts as one batch, without the pictures of the objects."""
    clip = dataclasses.replace(data.clip, sensors=data.clip.sensors[:SENSORS], view_px=1)
    clips = clip_batches(data.store, rows, clip, batch_size=64, seed=0, shuffle=False, repeat=False)
    found = []
    with context.progress("reading clips", len(rows)) as advance:
        for one in clips:
            found.append(touch_batch(one))
            advance(len(one["contact"]))
    joined: TouchBatch = jax.tree.map(lambda *x: jnp.concatenate(x), *found)
    return dataclasses.replace(joined, view=joined.view[:, :1, :1])


def run_arm(
    runner: CollapseRunner, arm: CollapseArm, keys: jax.Array, label: np.ndarray, train: np.ndarray, probe: ProbeConfig
) -> CollapseOutcome:
    """Train all seeds of an arm and probe them."""
    found: CollapseRun = jax.device_get(runner(arm.guards, jnp.float32(arm.rate), keys))
    lead = [
        100.0 * (probe_right(after, label, train, probe).mean() - probe_right(before, label, train, probe).mean())
        for before, after in zip(found.before, found.after, strict=True)
    ]
    measured = {
        "kept": np.asarray(found.blocks.told_apart / found.untrained.told_apart[:, None]),
        "rank_share": np.asarray(found.blocks.rank_share),
        "skill": np.asarray(found.blocks.skill),
    }
    kept = np.asarray(found.end.told_apart / found.start.told_apart)
    return CollapseOutcome(arm=arm, measured=measured, kept=kept, lead=np.array(lead))


def report(config: StabilityEncoderConfig, outcomes: list[CollapseOutcome]) -> Results:
    """Failures, alarms and cures."""
    failed, alarmed = (np.concatenate([getattr(o, name) for o in outcomes]) for name in ("failed", "alarmed"))
    by = {o.arm.name: o for o in outcomes}
    noticed = float(alarmed[failed].mean()) if failed.any() else 1.0
    false = float(alarmed[~failed].mean()) if (~failed).any() else 0.0
    guarded, of = float(by["all guards"].failed.mean()), lambda some, all_: f"{some.sum()} of {all_.sum()}"
    cures = [(o, by[o.arm.cures]) for o in outcomes if o.arm.cures and by[o.arm.cures].failed.any()]
    return Results(
        verdict=(
            f"{failed.sum()} of {len(failed)} runs collapsed; alarms during training detected {noticed:.0%} of them "
            f"and were raised in {false:.0%} of the others.",
            *(
                f"Of '{o.arm.name}' {o.failed.mean():.0%} of the seeds collapse, of '{ill.arm.name}' "
                f"{ill.failed.mean():.0%}."
                for o, ill in cures
            ),
        ),
        requirements=(
            at_least("failed runs that were detected", 100 * noticed, 90.0, "%", of(alarmed & failed, failed)),
            at_most("sound runs with an alarm", 100 * false, 10.0, "%", of(alarmed & ~failed, ~failed)),
            at_most("failures with all guards", 100 * guarded, 10.0, "%", f"{config.seeds} seeds"),
        ),
        tables=(arm_table(config, outcomes),),
        pictures=(
            Picture(
                name="stability_encoder",
                title="Runs into collapse",
                caption="Held-out measurements, a thin line for each seed, a bold one for their median; dotted: the "
                "bound of the alarm; dashed: arms that add a guard against a collapse.",
                content=collapse_chart(outcomes, config.block_steps),
            ),
        ),
        settings={"seeds": config.seeds, "steps": config.blocks * config.block_steps, "learning rate": RATE},
    )


def arm_table(config: StabilityEncoderConfig, outcomes: list[CollapseOutcome]) -> Table:
    """All arms at the end of training."""
    rows: list[dict[str, Cell]] = []
    for o in outcomes:
        first = [block for seed in range(config.seeds) if (block := o.first_alarm(seed)) is not None]
        rows.append(
            {
                "arm": o.arm.name,
                "kept": float(np.median(o.kept)),
                "rank": float(np.median(o.measured["rank_share"][:, -1])),
                "skill": float(np.median(o.measured["skill"][:, -1])),
                "probes": float(o.lead.mean()),
                "failed": 100 * o.failed.mean(),
                "alarm": 100 * o.alarmed.mean(),
                "at": config.block_steps * (1 + float(np.median(first))) if first else None,
            }
        )
    return named_table(
        f"Ends of {config.seeds} seeds",
        rows,
        formats={"kept": ".2f", "rank": ".2f", "skill": ".2f", "probes": "+.1f"}
        | dict.fromkeys(("failed", "alarm", "at"), ".0f"),
        units={"probes": "points", "failed": "%", "alarm": "%", "at": "step"},
        meanings={
            "kept": "spread between contacts over that before training, median",
            "rank": "effective rank over width, median over seeds",
            "skill": "over copying the last latent, median over seeds",
            "probes": "over the untrained encoder, mean over seeds",
            "failed": "seeds that keep less than half",
            "alarm": "seeds with an alarm for spread, rank or skill",
            "at": "of the first alarm, median over seeds",
        },
    )


def collapse_chart(outcomes: list[CollapseOutcome], block_steps: int) -> bytes:
    """One panel per alarm: the measurements of every arm over steps, and the alarm's bound."""
    colours = dict(zip((o.arm.name for o in outcomes), (*PALETTE, SHARED, "#8c564b"), strict=False))

    def series(o: CollapseOutcome, name: str) -> list[Series]:
        values, colour = o.measured[name], colours[o.arm.name]
        steps = block_steps * np.arange(1, values.shape[1] + 1)
        thin = [Series(x=steps, y=seed, marker="", colour=colour, width=0.5, alpha=0.25) for seed in values]
        line, median = "--" if o.arm.cures else "-", np.median(values, 0)
        return [*thin, Series(o.arm.name, x=steps, y=median, marker="", colour=colour, line=line, width=1.7)]

    def panel(name: str, title: str, **axes: Any) -> Panel:
        every = [one for o in outcomes for one in series(o, name)]
        return Panel(every, title=title, x_label="step", rules=[Rule(y=BOUNDS[name][0], width=0.9)], **axes)

    panels = [
        panel("kept", "spread between contacts, over untrained", y_scale="log"),
        panel("rank_share", "effective rank, share of width", y_limits=(0, 1)),
        panel("skill", "skill", y_limits=(-1, 1)),
    ]
    return draw(panels, size=(10.2, 3.9))


SMOKE = StabilityEncoderConfig(
    touch=StageOneDataConfig(scenes=SceneConfig(objects=60, sites=1, image_px=28, seed=1)),
    seeds=2,
    batch_size=8,
    blocks=2,
    block_steps=2,
)

EXPERIMENT = Experiment(name="stability_encoder", config=StabilityEncoderConfig(), scales={"smoke": SMOKE}, run=run)
