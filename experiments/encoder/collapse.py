"""Small encoders driven into collapse, many seeds at once, with the alarms watching."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.predictor import layer_norm
from touchr1_jax.training.dynamics import (
    DynamicsConfig,
    DynamicsState,
    Guards,
    dynamics_update,
    encode_batch,
    predict_next,
    prediction_errors,
    residuals,
    start_dynamics,
    steps_of,
)
from touchr1_jax.training.probes import contact_features, rank_me, told_apart
from touchr1_jax.types import TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class CollapseArm:
    """One way to train: guards, learning rate, and which arm's failure it is meant to cure, if any."""

    name: str
    guards: Guards
    rate: float
    cures: str = ""


@struct.dataclass
class LatentMeasures:
    """What is measured of an encoder on held-out contacts; `telling` is `probes.told_apart`."""

    telling: Float[Array, ""]
    rank_share: Float[Array, ""]
    skill: Float[Array, ""]


@struct.dataclass
class CollapseRun:
    """One run.

    Args:
      untrained, looks: measurements on the contacts that are watched, before training and after every block of steps.
      start, end: measurements on the contacts that judge the run.
      before, after: features of all contacts but those watched.
    """

    untrained: LatentMeasures
    looks: LatentMeasures
    start: LatentMeasures
    end: LatentMeasures
    before: Float[Array, "n D"]
    after: Float[Array, "n D"]


Runner = Callable[[Guards, Float[Array, ""], Array], CollapseRun]


def make_runner(
    config: DynamicsConfig,
    contacts: TouchBatch,
    train: Bool[np.ndarray, "n"],
    watched: TouchBatch,
    *,
    batch_size: int,
    blocks: int,
    block_steps: int,
) -> Runner:
    """A compiled function (guards, rate, keys [seed]) → courses [seed, …]; one program serves all arms.

    Args:
      config: networks.
      contacts: all contacts, in memory.
      train: which of them are trained on; the others judge a run when it has ended.
      watched: contacts of other objects, which the alarms are read on during training.
      batch_size: contacts of a step, drawn with replacement.
      blocks, block_steps: measurements, and steps between them.
    """
    rows, held = np.flatnonzero(train), _take(contacts, np.flatnonzero(~train))

    def run(guards: Guards, rate: Float[Array, ""], key: Array) -> CollapseRun:
        optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(b2=0.95), optax.scale(-rate))
        start_key, draw_key = jax.random.split(key)
        start = start_dynamics(config, optimizer, start_key, contacts)
        draws = jax.random.choice(draw_key, jnp.asarray(rows), (blocks, block_steps, batch_size))

        def block(state: DynamicsState, drawn: Int[Array, "steps batch"]) -> tuple[DynamicsState, LatentMeasures]:
            step = lambda s, i: (dynamics_update(config, optimizer, guards, s, _take(contacts, i))[0], None)
            state, _ = jax.lax.scan(step, state, drawn)
            return state, look_at(config, state, watched)

        end, looks = jax.lax.scan(block, start, draws)
        features = functools.partial(_features, config, contacts)
        return CollapseRun(
            untrained=look_at(config, start, watched),
            looks=looks,
            start=look_at(config, start, held),
            end=look_at(config, end, held),
            before=features(start),
            after=features(end),
        )

    return jax.jit(jax.vmap(run, in_axes=(None, None, 0)))


def look_at(config: DynamicsConfig, state: DynamicsState, batch: TouchBatch) -> LatentMeasures:
    """Held-out skill, and how the averaged encoder's latents differ between contacts."""
    steps = steps_of(batch, config.encoder.frames_per_step)
    latent = encode_batch(config.encoder, state.target, batch)
    goal = layer_norm(latent)
    seen = encode_batch(config.encoder, state.params["encoder"], batch)
    predicted = predict_next(config, state.params["predictor"], seen, steps, batch.stream_mask)
    error, copied = prediction_errors(predicted, goal, steps)
    return LatentMeasures(
        telling=told_apart(latent, steps.exists),
        rank_share=rank_me(residuals(latent, steps.exists)) / latent.shape[-1],
        skill=1.0 - error / jnp.maximum(copied, COPY_FLOOR),
    )


COPY_FLOOR = 1e-6
"""Error of copy-last below which all latents are one; any prediction then counts as unskilled."""


def _features(config: DynamicsConfig, contacts: TouchBatch, state: DynamicsState) -> Float[Array, "n D"]:
    exists = steps_of(contacts, config.encoder.frames_per_step).exists
    return contact_features(encode_batch(config.encoder, state.target, contacts), exists)


def _take(contacts: TouchBatch, rows: Array | np.ndarray) -> TouchBatch:
    taken: TouchBatch = jax.tree.map(lambda x: x[rows], contacts)
    return taken


def in_memory(parts: list[TouchBatch]) -> TouchBatch:
    """Several batches as one, pictures of the objects left out."""
    joined: TouchBatch = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    return dataclasses.replace(joined, view=joined.view[:, :1, :1])
