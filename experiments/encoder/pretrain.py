"""Stage 1 as a stage of a run: pretraining with held-out skill and probes on the way, and the resulting encoder."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
import optax

from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.encoder.held_out import HeldOutContacts, assess
from sensors_io.pipeline import ClipConfig, Contacts, clip_batches
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.models.pretrained import PretrainedEncoder
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.training.dynamics import (
    DynamicsConfig,
    DynamicsState,
    DynamicsStep,
    Guards,
    make_dynamics_step,
    start_dynamics,
)
from touchr1_jax.training.feeds import Feed, host_touch, touch_batch
from touchr1_jax.training.latent_probes import collapse_alarms
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.types import TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """Stage 1; the learning rate is the paper's 1e-5 times `lr_scale`, `encoder.sensors` is set by the data."""

    encoder: TactileViTConfig = TactileViTConfig(sensors=0, causal=True)
    predictor: PredictorConfig = PredictorConfig()
    frames: int = 4
    frames_kept: int | None = None
    """Number of these frames that are read, the most salient ones; all by default."""
    image_px: int = 112
    steps: int = 450
    batch_size: int = 32
    probe_every: int = 150
    """Steps between held-out measurements, and between checkpoints."""
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=100.0)

    def dynamics(self, sensors: int) -> DynamicsConfig:
        """The networks for this number of streams."""
        encoder = dataclasses.replace(self.encoder, sensors=sensors)
        return DynamicsConfig(encoder=encoder, predictor=self.predictor, frames_kept=self.frames_kept)


class ClipFeed(Feed):
    """Clips in random order, without end."""

    def __init__(self, store: Contacts, rows: np.ndarray, clip: ClipConfig, *, batch_size: int, seed: int) -> None:
        super().__init__(clip_batches(store, rows, clip, batch_size=batch_size, seed=seed), seed)

    def make(self, element: dict[str, np.ndarray], rng: np.random.Generator) -> TouchBatch:
        """The clips unchanged."""
        del rng
        return host_touch(element)


def clip_of(config: PretrainConfig, clip: ClipConfig) -> ClipConfig:
    """The clip with the number and size of frames that the encoder reads."""
    return dataclasses.replace(clip, frames=config.frames, image_px=config.image_px)


def pretrain(
    config: PretrainConfig,
    store: Contacts,
    rows: np.ndarray,
    clip: ClipConfig,
    context: Context,
    *,
    stage: str,
    seed: int,
    held_out: HeldOutContacts | None = None,
) -> DynamicsState:
    """Train encoder and predictor on some contacts, without their labels; a stopped stage resumes.

    Args:
      config: networks and training.
      store, rows: the contacts to train on.
      clip: sensors and flags; number and size of the frames are the config's.
      context, stage: the run, and the name of the stage, `PHASE/SEED`.
      seed: of parameters and order.
      held_out: contacts to measure on every `probe_every` steps; nothing is measured by default.
    """
    clip = clip_of(config, clip)
    feed = ClipFeed(store, rows, clip, batch_size=config.batch_size, seed=seed)
    networks = config.dynamics(len(clip.sensors))
    _, step = dynamics_program(networks, config.optimizer, config.steps)
    state = untrained(config, store, rows, clip, seed)
    measure = functools.partial(_measure, networks, context, f"probe/{stage.rpartition('/')[2]}", held_out)
    measure(state, 0)
    for end in range(config.probe_every, config.steps + config.probe_every, config.probe_every):
        loop = LoopConfig(steps=min(end, config.steps), save_every=config.probe_every)
        state = run_loop(step, state, feed, loop, context, stage)
        measure(state, loop.steps, end - config.probe_every)
    return state


def encoder_of(
    config: PretrainConfig, state: DynamicsState, sensors: tuple[str, ...], **notes: Any
) -> PretrainedEncoder:
    """The averaged encoder, from which other studies start."""
    encoder = dataclasses.replace(config.encoder, sensors=len(sensors))
    return PretrainedEncoder(config=encoder, sensors=sensors, params=jax.device_get(state.target), notes=notes)


def untrained(config: PretrainConfig, store: Contacts, rows: np.ndarray, clip: ClipConfig, seed: int) -> DynamicsState:
    """The state before training; its target is an untrained encoder."""
    networks = config.dynamics(len(clip.sensors))
    optimizer, _ = dynamics_program(networks, config.optimizer, config.steps)
    one = next(iter(clip_batches(store, rows[:1], clip, batch_size=1, seed=0, repeat=False)))
    start = jax.jit(lambda key, batch: start_dynamics(networks, optimizer, key, batch))
    # committed to the device, as a restored state is: otherwise the step would be compiled twice
    state: DynamicsState = jax.device_put(start(jax.random.key(seed), touch_batch(one)), jax.devices()[0])
    return state


@functools.cache
def dynamics_program(
    networks: DynamicsConfig, optimizer: OptimizerConfig, steps: int
) -> tuple[optax.GradientTransformation, DynamicsStep]:
    """Optimizer and compiled step with all guards against collapse, made once for all seeds."""
    made = make_optimizer(optimizer, steps)
    return made, make_dynamics_step(networks, made, Guards())


def _measure(
    networks: DynamicsConfig,
    context: Context,
    stage: str,
    held_out: HeldOutContacts | None,
    state: DynamicsState,
    step: int,
    before: int = 0,
) -> None:
    """Log the measurements after `step` steps, and the alarms since those after `before` steps; once in a run."""
    if held_out is None or context.done(f"{stage}/at{step}"):
        return
    found = assess(networks, state, held_out, context).summary()
    if step:  # the probes are compared with the random encoder, which has no lead over itself
        start = context.load_stage(f"{stage}/at0")
        found |= {"probe_lead": found["probe"] - start["probe"], "kept": found["told_apart"] / start["told_apart"]}
    if before:
        for alarm in collapse_alarms(context.load_stage(f"{stage}/at{before}"), found):
            context.print(f"{stage}, step {step}: {alarm}")
    context.log(stage, step, **found)
    context.print(f"{stage}, step {step}: " + ", ".join(f"{name} {value:.3g}" for name, value in found.items()))
    context.save_stage(f"{stage}/at{step}", found)
