"""Supervised training of a policy's encoders with a linear head, before the decoder is trained on encoded contacts.

    L = mean −log softmax(b + W h)_label over known labels,   h = (Σ touch tokens / √n, Σ view tokens / √m)

Each step uses one label of each attribute of a contact and predicts only levels, so the encoders learn several times as
much per contact as from answers.  The head reads the n touch tokens of all sensors and time steps with the same
weights, as attention can, so the decoder soon learns to read them too.  A head with separate weights for each token
fits better but helps the decoder less.  Half of the contacts show a random part of their sensors, so that the tokens
of each single sensor indicate the levels.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import grain
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from touchr1_jax import masked
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rl.gradient import batches_of
from touchr1_jax.training.encoding import BATCH
from touchr1_jax.training.feeds import FULL_SHARE, ONE_AT_A_TIME
from touchr1_jax.training.fine_tuning import FineTuneState, label_cost, normalised_levels
from touchr1_jax.training.loop import SILENT, Batches, Hooks, LoopConfig, fit, peek
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.types import Params, TouchBatch
from touchr1_jax.validation import at_least


@dataclasses.dataclass(frozen=True, kw_only=True)
class EncoderTrainingConfig:
    """Supervised training of the encoders; the learning rate is the paper's 1e-5 times `lr_scale`."""

    steps: int = 1000
    batch_size: int = 16
    save_every: int = 500
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=100.0, weight_decay=0.05)

    def __post_init__(self) -> None:
        at_least(self, 0, "steps")
        at_least(self, 1, "batch_size", "save_every")


def train_encoder(
    policy: TouchPolicy,
    params: Params,
    batches: Batches,
    config: EncoderTrainingConfig,
    hooks: Hooks = SILENT,
    *,
    seed: int = 0,
) -> Params:
    """Train all of a policy except its decoder and frozen towers; the head is discarded.

    Args:
      policy: its forward passes, attributes and levels.
      params: initial parameters.
      batches: `TouchBatch`es with labels, −1 if unknown, for example of `touch_rows`.
      config: steps and optimizer.
      hooks: log, checkpoints, devices.
      seed: of the sensors that are shown.
    """
    kept = {name: tree for name, tree in params.items() if name in ("decoder", *policy.frozen)}
    encoders = jax.tree.map(jnp.copy, {name: tree for name, tree in params.items() if name not in kept})
    width = jax.eval_shape(lambda p, b: read_tokens(policy.fns.encode(p, b)), params, peek(batches)).shape[-1]
    outputs = len(policy.levels) * max(policy.levels)  # in one dimension, as the sharding rules of a dense layer ask
    trained = {"encoders": encoders, "head": {"kernel": jnp.zeros((width, outputs)), "bias": jnp.zeros(outputs)}}
    optimizer, step = encoder_program(policy, config)
    state = FineTuneState(params=trained, opt_state=optimizer.init(trained), step=jnp.zeros((), jnp.int32))
    constants = kept, jnp.uint32(seed)
    step, state, batches = hooks.devices.shard(step, state, batches, config.batch_size, *constants)
    state = fit(step, state, batches, LoopConfig(steps=config.steps, save_every=config.save_every), hooks)
    return kept | hooks.devices.gather(state.params)["encoders"]


@functools.cache
def encoder_program(
    policy: TouchPolicy, config: EncoderTrainingConfig
) -> tuple[optax.GradientTransformation, Callable[..., tuple[FineTuneState, dict[str, Array]]]]:
    """Optimizer and compiled step, (state, batch, frozen towers, seed) → (state, metrics), made once for all seeds."""
    optimizer = make_optimizer(config.optimizer, config.steps)

    def step(
        state: FineTuneState, batch: TouchBatch, kept: Params, seed: Array
    ) -> tuple[FineTuneState, dict[str, Array]]:
        # (seed, step) as the two words of a key; those of seed 0 are those of key(step)
        key = jax.random.wrap_key_data(jnp.stack([seed, state.step.astype(jnp.uint32)]), impl="threefry2x32")
        shown = some_streams(key, batch.stream_mask)
        known = jnp.maximum(jnp.sum(batch.label >= 0), 1)

        def share(params: Params, part: tuple[TouchBatch, Array]) -> tuple[Array, Array]:
            contacts, streams = part
            features = policy.fns.encode(kept | params["encoders"], contacts)
            log_p = head_log_probs(policy.levels, params["head"], dataclasses.replace(features, stream_mask=streams))
            right = masked.total(log_p.argmax(-1) == contacts.label, contacts.label >= 0)
            return label_cost(log_p, contacts.label) / known, right / known

        def add(total: Any, part: tuple[TouchBatch, Array]) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, total, jax.value_and_grad(share, has_aux=True)(state.params, part)), None

        zero = (jnp.zeros(()), jnp.zeros(())), jax.tree.map(jnp.zeros_like, state.params)
        parts = batches_of(math.gcd(len(shown), BATCH), (batch, shown))
        (value, right), grads = jax.lax.scan(add, zero, parts)[0]
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics = {"loss": value, "accuracy": right, "grad_norm": optax.tree.norm(grads)}
        return FineTuneState(params=params, opt_state=opt_state, step=state.step + 1), metrics

    return optimizer, jax.jit(step, donate_argnums=0)


def head_log_probs(levels: Sequence[int], head: Params, features: Features) -> Float[Array, "P A K"]:
    """Log-probability of every level of every attribute; −∞ for a level that an attribute lacks."""
    logits = read_tokens(features) @ head["kernel"] + head["bias"]
    return normalised_levels(logits.reshape(len(logits), len(levels), -1), levels)


def read_tokens(features: Features) -> Float[Array, "P W"]:
    """Input of the head, h: the sums of touch and of view tokens, each divided by the root of their number."""
    exists = features.stream_mask[..., None] & (features.touch_time >= 0)
    touch = features.touch.reshape(len(features.touch), -1, features.touch.shape[-1]).astype(jnp.float32)
    exists = jnp.broadcast_to(exists, features.touch.shape[:-1]).reshape(touch.shape[:-1])
    view = features.view.astype(jnp.float32)
    seen = jnp.broadcast_to(features.view_mask[:, None], view.shape[:-1])
    return jnp.concatenate([_root_mean(x, mask) for x, mask in ((touch, exists), (view, seen))], -1)


def _root_mean(x: Float[Array, "P n D"], mask: Bool[Array, "P n"]) -> Float[Array, "P D"]:
    """Σ x / √n over the n that are selected, 0 where none is."""
    number = jnp.maximum(mask.sum(-1, keepdims=True), 1)
    return masked.total(x, mask[..., None], 1) / jnp.sqrt(number)


def some_streams(key: Array, present: Bool[Array, "P S"]) -> Bool[Array, "P S"]:
    """`random_streams` in the graph: all present streams with probability `FULL_SHARE`, else a random part of them."""
    order, size, full = jax.random.split(key, 3)
    rank = jnp.argsort(jnp.argsort(jax.random.uniform(order, present.shape), -1), -1)
    part = present & (rank < jax.random.randint(size, (len(present), 1), 1, present.shape[1] + 1))
    use = (jax.random.uniform(full, (len(present), 1)) >= FULL_SHARE) & part.any(-1, keepdims=True)
    return jnp.where(use, part, present)


def touch_rows(
    touch: TouchBatch, rows: np.ndarray, *, batch_size: int, seed: int, own: np.ndarray | None = None
) -> Batches:
    """Endless batches of some contacts on the host in random order.

    Args:
      touch: all contacts.
      rows: contacts to train on.
      batch_size, seed: of the batches and their order.
      own: rows of a batch that this process reads; all by default.
    """
    own = np.arange(batch_size) if own is None else own
    order = grain.MapDataset.range(len(rows)).seed(seed).shuffle().repeat().batch(batch_size, drop_remainder=True)
    batches = order.map(lambda at: jax.tree.map(lambda x: x[rows[at[own]]], touch))
    return iter(batches.to_iter_dataset(ONE_AT_A_TIME))
