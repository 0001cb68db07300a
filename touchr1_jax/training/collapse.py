"""Small encoders that are made to collapse, many seeds at once, and the measurements that raise alarms."""

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
from touchr1_jax.training.latent_probes import contact_features, rank_me, told_apart
from touchr1_jax.types import TouchBatch

COPY_FLOOR = 1e-6
"""Error of copying the last latent below which all latents are one; any prediction then counts as unskilled."""


@struct.dataclass
class LatentMeasures:
    """Measurements of an encoder on held-out contacts: `told_apart`, effective rank over width, skill."""

    told_apart: Float[Array, ""]
    rank_share: Float[Array, ""]
    skill: Float[Array, ""]


@struct.dataclass
class CollapseRun:
    """One run.

    Args:
      untrained, blocks: measurements on the watched contacts, before training and after every block of steps.
      start, end: measurements on the test contacts, before and after training.
      before, after: features of all contacts except the watched ones.
    """

    untrained: LatentMeasures
    blocks: LatentMeasures
    start: LatentMeasures
    end: LatentMeasures
    before: Float[Array, "n D"]
    after: Float[Array, "n D"]


CollapseRunner = Callable[[Guards, Float[Array, ""], Array], CollapseRun]


def make_runner(
    config: DynamicsConfig,
    contacts: TouchBatch,
    train: Bool[np.ndarray, "n"],
    watched: TouchBatch,
    *,
    batch_size: int,
    blocks: int,
    block_steps: int,
) -> CollapseRunner:
    """A compiled function (guards, rate, keys [seed]) → runs [seed, …]; one program serves all arms.

    Args:
      config: networks.
      contacts: all contacts, in memory.
      train: contacts for training; the others are the test contacts.
      watched: contacts of other objects, for the alarms during training.
      batch_size: contacts of a step, drawn with replacement.
      blocks, block_steps: number of measurements, and steps between them.
    """
    rows, test = np.flatnonzero(train), _take(contacts, np.flatnonzero(~train))

    def run(guards: Guards, rate: Float[Array, ""], key: Array) -> CollapseRun:
        optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(b2=0.95), optax.scale(-rate))
        start_key, draw_key = jax.random.split(key)
        start = start_dynamics(config, optimizer, start_key, contacts)
        draws = jax.random.choice(draw_key, jnp.asarray(rows), (blocks, block_steps, batch_size))

        def block(state: DynamicsState, drawn: Int[Array, "steps batch"]) -> tuple[DynamicsState, LatentMeasures]:
            step = lambda s, i: (dynamics_update(config, optimizer, guards, s, _take(contacts, i))[0], None)
            state, _ = jax.lax.scan(step, state, drawn)
            return state, measure_latents(config, state, watched)

        end, measured = jax.lax.scan(block, start, draws)
        exists = steps_of(contacts, config.encoder.frames_per_step).exists
        features = lambda state: contact_features(encode_batch(config.encoder, state.target, contacts), exists)
        return CollapseRun(
            untrained=measure_latents(config, start, watched),
            blocks=measured,
            start=measure_latents(config, start, test),
            end=measure_latents(config, end, test),
            before=features(start),
            after=features(end),
        )

    return jax.jit(jax.vmap(run, in_axes=(None, None, 0)))


def measure_latents(config: DynamicsConfig, state: DynamicsState, batch: TouchBatch) -> LatentMeasures:
    """Held-out skill, and the differences between contacts of the averaged encoder's latents."""
    steps = steps_of(batch, config.encoder.frames_per_step)
    latent = encode_batch(config.encoder, state.target, batch)
    goal = layer_norm(latent)
    online = encode_batch(config.encoder, state.params["encoder"], batch)
    predicted = predict_next(config, state.params["predictor"], online, steps, batch.stream_mask)
    error, copied = prediction_errors(predicted, goal, steps)
    return LatentMeasures(
        told_apart=told_apart(latent, steps.exists),
        rank_share=rank_me(residuals(latent, steps.exists)) / latent.shape[-1],
        skill=1.0 - error / jnp.maximum(copied, COPY_FLOOR),
    )


def _take(contacts: TouchBatch, rows: Array | np.ndarray) -> TouchBatch:
    taken: TouchBatch = jax.tree.map(lambda x: x[rows], contacts)
    return taken
