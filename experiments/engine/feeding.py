"""Batches of a study as its first device gets them: their cost on CPU cores, and the time between them."""

import dataclasses
import math
import time
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.engine.matrix_floor import count_flops
from experiments.study.dataset import Dataset
from experiments.study.stages import StudySFT, answer_feed
from experiments.study.study import StudyConfig
from touchr1_jax.distributed.memory import GRPOShape
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.work import Machine, seconds
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.training.encoding import encode_program
from touchr1_jax.training.feeds import AnswerFeed
from touchr1_jax.training.loop import Batches, LoopConfig
from touchr1_jax.training.questions import QuestionFeed
from touchr1_jax.training.sft import SFTBatch, SFTState
from touchr1_jax.training.train_sft import sft_program
from touchr1_jax.types import TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeedScale:
    """A study, its devices, and how many contacts its feed is tried on."""

    study: StudyConfig
    devices: int
    contacts: int

    def __post_init__(self) -> None:
        for name, size in (("sft.batch_size", self.study.sft.batch_size), ("grpo.drawn", self.study.grpo.drawn)):
            if size % self.devices:
                raise ValueError(f"devices is {self.devices}: must divide {name} = {size}; change either")


def clip_bytes(touch: TouchBatch) -> int:
    """Bytes of each clip of a batch."""
    return sum(x.nbytes for x in jax.tree.leaves(touch)) // len(touch.stream_mask)


def memory_share(study: StudyConfig, data: Dataset, touch: TouchBatch) -> float:
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


class BatchCost(NamedTuple):
    """Cost of one batch: seconds of one core, and bytes sent to the device."""

    cpu_s: float
    size_bytes: int


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


def make_seconds(batches: Iterator[Any], rounds: Iterable[object], ahead: Iterable[object]) -> BatchCost:
    """Mean processor time of some batches: all threads together, without the load of other processes.

    Args:
      batches: endless.
      rounds: a batch is timed for each item.
      ahead: batches that may have been made before the first is asked for; one is drawn first for each item.
    """
    for _ in ahead:
        next(batches)
    spent = []
    for _ in rounds:
        began = time.process_time()
        batch = next(batches)
        spent.append(time.process_time() - began)
    return BatchCost(float(np.mean(spent)), sum(np.asarray(x).nbytes for x in jax.tree.leaves(batch)))


def idle_share(batches: Batches, step_s: float, steps: int, context: Context, stage: str) -> float:
    """Share of the time that a device stands still in the loop that trains, fed by these batches."""
    device = SimulatedDevice(step_s)
    run_loop(
        device.step, {"nothing": jnp.zeros(())}, batches, LoopConfig(steps=steps, save_every=steps), context, stage
    )
    return device.idle_share
