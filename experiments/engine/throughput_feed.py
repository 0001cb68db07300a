"""Can the CPU cores of an accelerator keep it supplied with batches?

    make experiment EXP=throughput_feed [ARGS="--scale smoke"]

Measured are the seconds of a core that a batch of SFT or GRPO takes at `--scale gpu`, one H200, and `--scale paper`,
sixteen, from records and from the memory that the scale keeps clips in; predicted is the shortest step of the devices,
counted from shapes at an assumed share of their peak.  Then the training loop runs with these batches and a simulated
device that computes nothing for as long; the share of the time that it stands still is the result.  A device has 16
cores; where fewer are here, its steps last longer, at most until supply and demand stand to each other as there.  No
accelerator is needed and none is measured; losses by the transfer of a batch do not show.

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
from experiments.core.results import Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.engine import feeding
from experiments.paper import presets
from experiments.study import study as studies
from sensors_io.pipeline import ClipMemory
from touchr1_jax.distributed.work import Machine
from touchr1_jax.models.touch_policy import build_policy
from touchr1_jax.training.feeds import Feed
from touchr1_jax.validation import at_least

MOST_S = 60.0  # seconds after which the loop ends, but for two steps
MOST_IDLE = 0.02  # share of the time that a device may stand still for want of a batch


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeedingConfig:
    """Scales, and how long each feed is watched."""

    scales: Mapping[str, feeding.FeedScale] = dataclasses.field(
        default_factory=lambda: {
            "gpu": feeding.FeedScale(study=presets.GPU, devices=1, contacts=48),
            "paper": feeding.FeedScale(study=presets.PAPER, devices=16, contacts=16),
        }
    )
    cores: int = 16
    """CPU cores of each device."""
    machine: Machine = Machine()
    batches: int = 4
    """Number whose processor time is measured."""
    steps: int = 12
    """Of the loop, at most."""

    def __post_init__(self) -> None:
        at_least(self, 1, "cores", "batches")
        at_least(self, 2, "steps")  # the first is not watched


@dataclasses.dataclass(frozen=True)
class FeedMeasurement:
    """One feed: the cost of a batch, the time of a step, and the share of it that the device stood still.

    `configured`: whether the study would feed it so; else it shows the gain of keeping clips in memory.
    """

    name: str
    made: feeding.BatchCost
    step_s: float
    idle: float
    configured: bool

    @property
    def cores(self) -> float:
        """Cores that a device needs for its batches."""
        return self.made.cpu_s / self.step_s


def run(config: FeedingConfig, context: Context) -> Results:
    """Measure every feed, then run each with a simulated device."""
    fed = [one for name, scale in config.scales.items() for one in feeds_of(config, name, scale, context)]
    return Results(
        verdict=verdict(config, fed),
        requirements=tuple(
            at_most(f"{one.name}: device stands still", one.idle, MOST_IDLE, note="a stand-in")
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


def feeds_of(config: FeedingConfig, name: str, scale: feeding.FeedScale, context: Context) -> Iterator[FeedMeasurement]:
    """The feeds of one scale: SFT from records, SFT with the scale's memory where it has one, and GRPO."""
    study = dataclasses.replace(
        scale.study,
        scenes=dataclasses.replace(scale.study.scenes, objects=scale.contacts, sites=1, sequences=None),
        clip_memory_gib=0.0,
        read_threads=min(scale.study.read_threads, cores_here()),
    )
    data = studies.open_study_data(study, context)
    data = dataclasses.replace(data, parts={**data.parts, "sft": np.arange(len(data.store))})
    policy = build_policy(study.model, data.clip.sensors)
    sft = feeding.answers(policy, data, scale)
    batch = next(feeding.answers(policy, data, scale))
    whole = jax.tree.map(lambda x: jax.ShapeDtypeStruct((study.sft.batch_size, *x.shape[1:]), x.dtype), batch)
    step_s = feeding.sft_seconds(policy, study.sft, whole, scale.devices, config.machine)
    kept = feeding.memory_share(scale.study, data, batch.touch)
    yield watch(config, f"{name}/sft/records", sft, step_s, context, configured=not kept)
    if kept:
        memory = ClipMemory(data.clip, round(kept * len(data.store)) * feeding.clip_bytes(batch.touch))
        remembering = dataclasses.replace(data, memory=memory)
        feed = feeding.answers(policy, remembering, scale)
        yield watch(config, f"{name}/sft/memory", feed, step_s, context, configured=True, warm=len(data.store))
    grpo_s = feeding.grpo_seconds(policy, study.grpo, scale.devices, config.machine)
    asked = feeding.questions(policy, batch.touch, data, scale)
    yield watch(config, f"{name}/grpo/memory", asked, grpo_s, context, configured=True)


def watch(
    config: FeedingConfig, stage: str, feed: Feed, step_s: float, context: Context, *, configured: bool, warm: int = 1
) -> FeedMeasurement:
    """Time some batches of a feed, then run it with a simulated device; `warm` batches are drawn first.

    `stage` is scale, stage and source, by slashes; `configured` tells if the scale's study would feed it so.
    """
    if not context.done(stage):
        ahead = context.each(f"{stage}, ahead", range(warm))
        made = feeding.make_seconds(feed, context.rounds(f"{stage}, timing batches", config.batches), ahead)
        lasts_s = step_s * stretch(made.cpu_s / step_s, here=cores_here(), there=config.cores)
        idle = feeding.idle_share(feed, lasts_s, min(config.steps, max(2, round(MOST_S / lasts_s))), context, stage)
        context.save_stage(stage, {"made": made._asdict(), "idle": idle})
    saved = context.load_stage(stage)
    name = stage.replace("/", ", ")
    return FeedMeasurement(name, feeding.BatchCost(**saved["made"]), step_s, saved["idle"], configured)


def stretch(needed: float, *, here: int, there: int) -> float:
    """Factor by which simulated steps are longer, so that half of the cores here suffice; at most `there` / `here`.

    Args:
      needed: cores that the batches of a device need.
      here, there: cores of this machine, and those of a device.
    """
    return min(max(1.0, 2 * needed / here), max(1.0, there / here))


def feed_table(config: FeedingConfig, fed: Sequence[FeedMeasurement]) -> Table:
    """Cost of the batches of every feed, and the rate at which the device needs them."""
    return named_table(
        "What a batch takes, and what a device asks",
        [
            {
                "feed": one.name,
                "batch": one.made.size_bytes / 1e6,
                "made in": one.made.cpu_s,
                "step": one.step_s,
                "cores needed": one.cores,
                "device stands still": 100 * one.idle,
            }
            for one in fed
        ],
        formats={"cores needed": ".2g", "device stands still": ".2f"},
        units={"batch": "MB", "made in": "core s", "step": "s", "device stands still": "%"},
        meanings={
            "feed": "scale, stage, where clips or features lie",
            "made in": "processor time, all threads",
            "step": "predicted",
            "cores needed": f"of {config.cores} beside a device",
        },
        note=f"Steps are as short as {config.machine.flops_share:.0%} of {config.machine.flops / 1e12:.0f} TFLOP/s "
        "make them.",
    )


def verdict(config: FeedingConfig, fed: Sequence[FeedMeasurement]) -> tuple[str, ...]:
    """Name the feed that needs the most cores, and the idle share of devices; no device is measured."""
    used = [one for one in fed if one.configured]
    worst, hardest = max(used, key=lambda one: one.idle), max(used, key=lambda one: one.cores)
    return (
        "No accelerator was at work: what its steps take is predicted, and a stand-in waited for the batches.",
        f"It stands still for at most {worst.idle:.2%} of the time ({worst.name}); the hardest to feed asks for "
        f"{hardest.cores:.2g} of {config.cores} cores ({hardest.name}).",
    )


DEFAULT = FeedingConfig()
TINY_STUDY = dataclasses.replace(studies.SMOKE, clip_memory_gib=0.002)
SMOKE = FeedingConfig(
    scales={"smoke": feeding.FeedScale(study=TINY_STUDY, devices=2, contacts=24)},
    machine=Machine(flops=2e10),
    batches=1,
    steps=3,
)

EXPERIMENT = Experiment(name="throughput_feed", config=DEFAULT, scales={"smoke": SMOKE}, run=run, quick=("smoke",))
