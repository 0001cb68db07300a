"""Can the CPU cores of an accelerator keep it supplied with batches?

    make experiment EXP=throughput_feed [ARGS="--scale smoke"]

The experiment measures the CPU time of a batch of SFT or GRPO at `--scale gpu` (one H200) and `--scale paper`
(sixteen), read from records and from clips in memory.  It predicts the shortest step of the devices from shapes and an
assumed share of their peak.  The training loop then runs with these batches and a simulated device that waits for the
predicted time; the result is the share of time in which the device is idle.  A device has 16 cores; on a machine
with fewer cores, its steps are lengthened, at most until the ratio of supply and demand is the same.  The experiment
needs and measures no accelerator; it does not include the transfer of batches.

Cost: about three minutes on two cores, most of it making the records; `--scale smoke` half a minute.

Expected: below 2 % for both stages at both scales; without reading threads, the GPU would wait most of the time.
"""

import dataclasses
import math
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.charts import bars
from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.core.results import Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.core.text import plain
from experiments.engine.matrix_floor import count_flops
from experiments.paper import presets
from experiments.study import study as studies
from experiments.study.dataset import Dataset
from experiments.study.stages import StudySFT, answer_feed
from sensors_io.pipeline import ClipMemory
from touchr1_jax.distributed.memory import GRPOShape
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.work import Machine, seconds
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy, build_policy
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.training.encoding import encode_program
from touchr1_jax.training.feeds import AnswerFeed, Feed
from touchr1_jax.training.loop import Batches, LoopConfig
from touchr1_jax.training.questions import QuestionFeed
from touchr1_jax.training.sft import SFTBatch, SFTState
from touchr1_jax.training.train_sft import sft_program
from touchr1_jax.types import TouchBatch
from touchr1_jax.validation import at_least

MOST_S = 60.0  # seconds after which the loop ends, but for two steps
MOST_IDLE = 0.02  # share of the time that a device may stand still for want of a batch


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeedScale:
    """A study, its devices, and how many contacts its feed is tried on."""

    study: studies.StudyConfig
    devices: int
    contacts: int

    def __post_init__(self) -> None:
        for name, size in (("sft.batch_size", self.study.sft.batch_size), ("grpo.drawn", self.study.grpo.drawn)):
            if size % self.devices:
                raise ValueError(f"devices is {self.devices}: must divide {name} = {size}; change either")


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
    """CPU cores of each device."""
    machine: Machine = Machine()
    batches: int = 4
    """Number whose processor time is measured."""
    steps: int = 12
    """Of the loop, at most."""

    def __post_init__(self) -> None:
        at_least(self, 1, "cores", "batches")
        at_least(self, 2, "steps")  # the first is not watched


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeedMeasurement:
    """One feed: seconds of a core and bytes of a batch, seconds of a step, and the share that the device stood still.

    `configured`: whether the study would feed it so; else it shows the gain of keeping clips in memory.
    """

    name: str
    cpu_s: float
    size_bytes: int
    step_s: float
    idle: float
    configured: bool

    @property
    def cores(self) -> float:
        """Cores that a device needs for its batches."""
        return self.cpu_s / self.step_s


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
                caption="Processor time of a batch over the predicted time of a step; dotted: cores next to a device.",
                content=bars({one.name: one.cores for one in fed}, "cores", bounds=(config.cores,), logarithmic=True),
            ),
        ),
        settings={"cores here": cores_here(), "cores next to a device": config.cores},
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
    data = studies.open_study_data(study, context)
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
    """Time some batches of a feed, then run it with a simulated device; `warm` batches are drawn first.

    `stage` is scale, stage and source, by slashes; `configured` says if the scale's study would feed it so.
    """

    def measure() -> dict[str, float]:
        ahead = context.each(f"{stage}, ahead", range(warm))
        cpu_s, size = batch_cost(feed, context.rounds(f"{stage}, timing batches", config.batches), ahead)
        lasts_s = step_s * stretch(cpu_s / step_s, here=cores_here(), there=config.cores)
        idle = idle_share(feed, lasts_s, min(config.steps, max(2, round(MOST_S / lasts_s))), context, stage)
        return {"cpu_s": cpu_s, "size_bytes": size, "idle": idle}

    saved, name = context.once(stage, measure), stage.replace("/", ", ")
    return FeedMeasurement(name=name, step_s=step_s, configured=configured, **saved)


def stretch(needed: float, *, here: int, there: int) -> float:
    """Factor by which simulated steps are longer, so that half of the cores here suffice for the cores needed.

    It is at most the ratio of a device's cores, `there`, to those of this machine.
    """
    return min(max(1.0, 2 * needed / here), max(1.0, there / here))


def clip_bytes(touch: TouchBatch) -> int:
    """Bytes of each clip of a batch."""
    return sum(x.nbytes for x in jax.tree.leaves(touch)) // len(touch.stream_mask)


def memory_share(study: studies.StudyConfig, data: Dataset, touch: TouchBatch) -> float:
    """Share of the study's clips that its memory holds."""
    scenes = study.scenes
    contacts = scenes.objects * scenes.sites if scenes.sequences is None else scenes.sequences // len(data.clip.sensors)
    return min(1.0, study.clip_memory_gib * 2**30 / (contacts * clip_bytes(touch)))


def answers(policy: TouchPolicy, data: Dataset, scale: FeedScale) -> AnswerFeed:
    """Batches of SFT, those rows that the first device reads; the evidence is equal for all levels."""
    config = scale.study.sft
    shape = (len(data.store), len(data.clip.sensors), len(policy.levels), max(policy.levels))
    own = np.arange(config.batch_size // scale.devices)
    return answer_feed(policy, data, np.zeros(shape, np.float32), config, seed=0, own=own)


def questions(policy: TouchPolicy, touch: TouchBatch, data: Dataset, scale: FeedScale) -> QuestionFeed:
    """Batches of GRPO, those rows that the first device reads, about encoded touch that is all zeros."""
    params = jax.eval_shape(lambda touch: policy.init(0, touch), touch)
    one = jax.eval_shape(encode_program(policy.fns, False), params, touch)
    n = len(data.store)
    zeros: Features = jax.tree.map(lambda x: np.zeros((n, *x.shape[1:]), x.dtype), one)
    there: Any = np.ones(zeros.stream_mask.shape, bool)
    features = dataclasses.replace(zeros, stream_mask=there)
    drawn = scale.study.grpo.drawn
    return QuestionFeed(policy, features, data.label, batch_size=drawn, seed=0, own=np.arange(drawn // scale.devices))


def sft_seconds(policy: TouchPolicy, config: StudySFT, batch: SFTBatch, devices: int, machine: Machine) -> float:
    """Least seconds of a step of SFT, W / (devices · peak · share), where W are the step's operations.

    Exchange between devices is not counted: it could only make the step longer, and so easier to feed.
    """
    optimizer, step = sft_program(policy.fns, config, False)

    def start(touch: TouchBatch) -> SFTState:
        params = policy.init(0, touch)
        return SFTState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))

    state = jax.eval_shape(start, batch.touch)
    return count_flops(step, state, batch, {}) / (devices * machine.flops * machine.flops_share)


def grpo_seconds(policy: TouchPolicy, config: GRPOConfig, devices: int, machine: Machine) -> float:
    """Seconds of a step of GRPO as `touchr1_jax.distributed.work` predicts them, weights split over all devices."""
    shape = GRPOShape(
        decoder=policy.fns.module.config.decoder,
        grpo=config,
        mesh=MeshConfig(fsdp=devices),
        prompt_tokens=policy.layout.ids.shape[1],
    )
    return math.fsum(seconds(shape, machine).values())


class SimulatedDevice:
    """A device that computes nothing for as long as a step would take, and measures its idle time.

    Like a real one it accepts the next step during a step, and reading the metrics of a step waits for its end.
    """

    def __init__(self, step_s: float) -> None:
        self._step_s, self._free_at = step_s, 0.0
        self.idle_s, self.steps = 0.0, 0

    def step(self, state: Any, batch: Any) -> tuple[Any, dict[str, Any]]:
        """Begin a step as soon as the one before has ended."""
        del batch
        now = time.perf_counter()
        if self._free_at:  # the first step waits for nothing
            self.idle_s += max(0.0, now - self._free_at)
            self.steps += 1
        self._free_at = max(now, self._free_at) + self._step_s
        return state, {"idle_s": _PendingMetric(self._free_at, self.idle_s)}

    @property
    def idle_share(self) -> float:
        """Share of the time from the first step's end to the last one's in which it stood still."""
        return self.idle_s / (self.idle_s + self.steps * self._step_s)


class _PendingMetric:
    """A number that is available when a step ends, with the interface of an array on a device."""

    def __init__(self, at: float, value: float) -> None:
        self._at, self._value = at, value

    def is_ready(self) -> bool:
        return time.perf_counter() >= self._at

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        time.sleep(max(0.0, self._at - time.perf_counter()))
        return np.array(self._value, dtype)


def batch_cost(batches: Iterator[Any], rounds: Iterable[object], ahead: Iterable[object]) -> tuple[float, int]:
    """Mean processor time of a batch over the rounds, by all threads of this process, and its bytes.

    A batch is drawn first for each item of `ahead`: so many may have been made before the first was asked for.
    """
    for _ in ahead:
        next(batches)
    spent = []
    for _ in rounds:
        began = time.process_time()
        batch = next(batches)
        spent.append(time.process_time() - began)
    return float(np.mean(spent)), sum(np.asarray(x).nbytes for x in jax.tree.leaves(batch))


def idle_share(batches: Batches, step_s: float, steps: int, context: Context, stage: str) -> float:
    """Share of the time that a device stands still in the loop that trains, fed by these batches."""
    device = SimulatedDevice(step_s)
    run_loop(
        device.step, {"nothing": jnp.zeros(())}, batches, LoopConfig(steps=steps, save_every=steps), context, stage
    )
    return device.idle_share


def feed_table(config: FeedingConfig, fed: Sequence[FeedMeasurement]) -> Table:
    """Cost of the batches of every feed, and the rate at which the device needs them."""
    return named_table(
        "Cost of a batch, and demand of a device",
        [
            {
                "feed": one.name,
                "batch": one.size_bytes / 1e6,
                "made in": one.cpu_s,
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
            "cores needed": f"of {config.cores} next to a device",
        },
        note=f"A step takes the time of its arithmetic at {100 * config.machine.flops_share:.0f} % of "
        f"{plain(config.machine.flops / 1e12)} TFLOP/s.",
    )


def verdict(config: FeedingConfig, fed: Sequence[FeedMeasurement]) -> tuple[str, ...]:
    """Name the feed that needs the most cores, and the idle share of devices; no device is measured."""
    used = [one for one in fed if one.configured]
    worst, hardest = max(used, key=lambda one: one.idle), max(used, key=lambda one: one.cores)
    return (
        "No accelerator was used: the time of its steps is predicted, and a simulated device waited for the batches.",
        f"The device is idle for at most {worst.idle:.2%} of the time ({worst.name}); feeding needs at most "
        f"{hardest.cores:.2g} of {config.cores} cores ({hardest.name}).",
    )


TINY_STUDY = dataclasses.replace(studies.SMOKE, clip_memory_gib=0.002)
SMOKE = FeedingConfig(
    scales={"smoke": FeedScale(study=TINY_STUDY, devices=2, contacts=24)},
    machine=Machine(flops=2e10),
    batches=1,
    steps=3,
)

EXPERIMENT = Experiment(
    name="throughput_feed", config=FeedingConfig(), scales={"smoke": SMOKE}, run=run, quick=("smoke",)
)
