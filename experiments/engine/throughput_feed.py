"""Can the cores beside an accelerator keep it fed?

    make experiment EXP=throughput_feed [ARGS="--scale smoke"]

Batches of SFT and of GRPO as a study makes them at `--scale gpu`, one H200, and at `--scale paper`, sixteen: what one
takes of a core, from records and from the memory that the scale keeps clips in, against the shortest step that the
devices allow, counted from shapes at an assumed share of their peak.  Then the training loop itself with these
batches, and in the place of the device one that computes nothing for as long: what share of the time it stands still.
A device has `cores` cores; where fewer are here, and the batches need more than half of them, the stand-in's steps last
longer, at most until supply and demand stand to each other as there.  As many threads read as there are cores here: it
is supposed that more of them would not wait for each other.

No accelerator is needed and none is measured: the step's time is a prediction, and what a device loses to the transfer
of a batch does not show.

Cost: about three minutes on two cores, most of it making the records; `--scale smoke` half a minute.

Expected: below 2 % for either stage at either scale; without threads the GPU would wait for records most of the time.
"""

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence

import jax
import numpy as np

from experiments.core.charts import bars
from experiments.core.context import Context
from experiments.core.results import Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.engine.feed_demand import grpo_seconds, sft_seconds
from experiments.engine.feed_scales import FeedScale, answers, clip_bytes, memory_share, questions
from experiments.engine.feed_supply import BatchCost, idle_share, make_seconds
from experiments.paper import presets
from experiments.study.study import SMOKE as TINY_STUDY
from experiments.study.study import open_study_data
from sensors_io.pipeline import ClipMemory
from touchr1_jax.distributed.work import Machine
from touchr1_jax.models.touch_policy import build_policy
from touchr1_jax.training.feeds import Feed

MOST_IDLE = 0.02
"""Share of the time that a device may stand still for want of a batch."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeedingConfig:
    """Scales, and how long each feed is watched."""

    scales: Mapping[str, FeedScale] = dataclasses.field(
        default_factory=lambda: {
            "gpu": FeedScale(study=presets.GPU, devices=1, contacts=48),
            "paper": FeedScale(study=presets.PAPER, devices=16, contacts=16),
        }
    )
    cores: int = 16
    """Beside each device."""
    machine: Machine = Machine()
    batches: int = 4
    """Whose processor time is measured."""
    steps: int = 12
    """Of the loop, at most."""
    most_s: float = 60.0
    """About which the loop ends, but for two steps."""

    def __post_init__(self) -> None:
        for name in ("cores", "batches"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: must be at least 1; raise it")
        if self.steps < 2:
            raise ValueError(f"steps is {self.steps}: must be at least 2, the first is not watched; raise it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeedMeasurement:
    """One feed: what a batch takes, how long a step lasts, and how long the device stood still.

    `configured`: whether the study would feed it so; else it shows what memory is good for.
    """

    scale: str
    stage: str
    source: str
    made: BatchCost
    step_s: float
    idle: float
    configured: bool

    @property
    def cores(self) -> float:
        """That a device needs for its batches."""
        return self.made.cpu_s / self.step_s

    @property
    def name(self) -> str:
        """Such as `gpu, SFT, from records`."""
        return f"{self.scale}, {self.stage}, {self.source}"


def run(config: FeedingConfig, context: Context) -> Results:
    """Measure every feed, then run each beside a device that stands in."""
    fed = [one for name, scale in config.scales.items() for one in feeds_of(config, name, scale, context)]
    return Results(
        verdict=verdict(config, fed),
        requirements=tuple(
            Requirement(
                name=f"{one.name}: device stands still",
                measured=one.idle,
                bound=MOST_IDLE,
                better="lower",
                note="a stand-in",
            )
            for one in fed
            if one.configured
        ),
        tables=(feed_table(config, fed),),
        pictures=(
            Picture(
                name="cores",
                title="Cores that a device needs for its batches",
                caption="Processor time of a batch over the predicted time of a step; the dotted line is what it has.",
                content=bars({one.name: one.cores for one in fed}, "cores", bounds=(config.cores,), logarithmic=True),
            ),
        ),
        settings={"cores here": cores_here(), "cores beside a device": config.cores},
    )


def cores_here() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def feeds_of(config: FeedingConfig, name: str, scale: FeedScale, context: Context) -> Iterator[FeedMeasurement]:
    """The feeds of one scale: SFT from records, SFT with the scale's memory where it has one, and GRPO."""
    study = dataclasses.replace(
        scale.study,
        scenes=dataclasses.replace(scale.study.scenes, objects=scale.contacts, sites=1, sequences=None),
        clip_memory_gib=0.0,
        read_threads=min(scale.study.read_threads, cores_here()),
    )
    data = open_study_data(study, context)
    data = dataclasses.replace(data, parts={**data.parts, "sft": np.arange(len(data.store))})
    policy = build_policy(study.model, data.clip.sensors)
    sft = answers(policy, data, scale)
    batch = next(answers(policy, data, scale))
    whole = jax.tree.map(lambda x: jax.ShapeDtypeStruct((study.sft.batch_size, *x.shape[1:]), x.dtype), batch)
    step_s = sft_seconds(policy, study.sft, whole, scale.devices, config.machine)
    kept = memory_share(scale.study, data, batch.touch)
    yield watch(config, f"{name}/sft/records", sft, step_s, context, configured=not kept)
    if kept:
        memory = ClipMemory(data.clip, round(kept * len(data.store)) * clip_bytes(batch.touch))
        remembering = dataclasses.replace(data, memory=memory)
        feed = answers(policy, remembering, scale)
        yield watch(config, f"{name}/sft/memory", feed, step_s, context, configured=True, warm=len(data.store))
    grpo_s = grpo_seconds(policy, study.grpo, scale.devices, config.machine)
    asked = questions(policy, batch.touch, data, scale)
    yield watch(config, f"{name}/grpo/memory", asked, grpo_s, context, configured=True)


def watch(
    config: FeedingConfig, stage: str, feed: Feed, step_s: float, context: Context, *, configured: bool, warm: int = 1
) -> FeedMeasurement:
    """Time some batches of a feed, then run it beside a stand-in.

    Args:
      config: how many batches and steps.
      stage: scale, stage and source, by slashes.
      feed: of the stage.
      step_s: that a step takes there.
      context: the run.
      configured: whether the scale's study would feed it so.
      warm: batches that are drawn first.
    """
    if not context.done(stage):
        ahead = context.each(f"{stage}, ahead", range(warm))
        made = make_seconds(feed, context.rounds(f"{stage}, timing batches", config.batches), ahead)
        lasts_s = step_s * stretch(config, made.cpu_s / step_s)
        steps = min(config.steps, max(2, round(config.most_s / lasts_s)))
        idle = idle_share(feed, lasts_s, steps, context, stage)
        context.save_stage(stage, {"made": made._asdict(), "idle": idle})
    saved = context.load_stage(stage)
    scale, name, source = stage.split("/")
    return FeedMeasurement(
        scale=scale,
        stage=name,
        source=source,
        made=BatchCost(**saved["made"]),
        step_s=step_s,
        idle=saved["idle"],
        configured=configured,
    )


def stretch(config: FeedingConfig, needed: float) -> float:
    """Factor that slows the stand-in's steps until half of the cores here suffice, if so many are there."""
    return min(max(1.0, 2 * needed / cores_here()), max(1.0, config.cores / cores_here()))


def feed_table(config: FeedingConfig, fed: Sequence[FeedMeasurement]) -> Table:
    """Rates that every feed delivers, and rates that the device needs."""
    return Table(
        title="What a batch takes, and what a device asks",
        columns=(
            Column(name="feed", meaning="scale, stage, where clips or features lie"),
            Column(name="batch", unit="MB", meaning="what one device gets"),
            Column(name="made in", unit="core s", meaning="processor time, all threads"),
            Column(name="step", unit="s", meaning="predicted"),
            Column(name="cores needed", format=".2g", meaning=f"of {config.cores} beside a device"),
            Column(name="device stands still", unit="%", format=".2f", meaning="a stand-in, in the loop that trains"),
        ),
        rows=tuple(
            (
                one.name,
                one.made.size_bytes / 1e6,
                one.made.cpu_s,
                one.step_s,
                one.cores,
                100 * one.idle,
            )
            for one in fed
        ),
        note=f"Steps are as short as {config.machine.flops_share:.0%} of {config.machine.flops / 1e12:.0f} TFLOP/s "
        "make them.",
    )


def verdict(config: FeedingConfig, fed: Sequence[FeedMeasurement]) -> tuple[str, ...]:
    """Which feed is the hardest, how long devices stand still, and that it is no measurement of one."""
    used = [one for one in fed if one.configured]
    worst, hardest = max(used, key=lambda one: one.idle), max(used, key=lambda one: one.cores)
    said = [
        "No accelerator was at work: what its steps take is predicted, and a stand-in waited for the batches.",
        f"It stands still for at most {worst.idle:.2%} of the time ({worst.name}); the hardest to feed asks for "
        f"{hardest.cores:.2g} of {config.cores} cores ({hardest.name}).",
    ]
    said += [
        f"Without the memory {one.name} would ask for {one.cores:.2g}, and stand still for {one.idle:.1%}."
        for one in fed
        if not one.configured
    ]
    return tuple(said)


DEFAULT = FeedingConfig()
SMOKE = FeedingConfig(
    scales={"smoke": FeedScale(study=dataclasses.replace(TINY_STUDY, clip_memory_gib=0.002), devices=2, contacts=24)},
    machine=Machine(flops=2e10),
    batches=1,
    steps=3,
)

EXPERIMENT = Experiment(name="throughput_feed", config=DEFAULT, scales={"smoke": SMOKE}, run=run, quick=("smoke",))
