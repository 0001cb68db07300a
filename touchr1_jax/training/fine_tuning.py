"""Fine-tuning of a tactile encoder on labelled contacts: the encoder and one linear head for all attributes.

    L = mean −log softmax(W h)_label over the known labels,   h = LN(tokens of each stream, mean over its steps)

The head starts at zero, so that all encoders start from the same answers.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.predictor import layer_norm
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.rl.losses import token_log_probs
from touchr1_jax.training.dynamics import encode_batch, encode_each, steps_of
from touchr1_jax.training.latent_probes import contact_features
from touchr1_jax.types import Params, TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class FineTuned:
    """Shape of the encoder that is fine-tuned, and levels of the first attributes of a label."""

    encoder: TactileViTConfig
    levels: tuple[int, ...] = (3, 3, 3)


@struct.dataclass
class FineTuneState:
    """State of training; `params` holds the encoder, or a policy's encoders, and the "head"."""

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]


FineTuneStep = Callable[[FineTuneState, TouchBatch], tuple[FineTuneState, dict[str, Array]]]


def start_fine_tuning(
    config: FineTuned, optimizer: optax.GradientTransformation, encoder: Params, batch: TouchBatch
) -> FineTuneState:
    """State with a copy of an encoder and a head of zeros for the shapes of a batch."""
    features = jax.eval_shape(lambda p, b: _features(config, p, b, encode_batch), encoder, batch)
    head = jnp.zeros((features.shape[-1], len(config.levels) * max(config.levels)))
    params = {"encoder": jax.tree.map(jnp.copy, encoder), "head": head}
    return FineTuneState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))


def make_fine_tune_step(config: FineTuned, optimizer: optax.GradientTransformation) -> FineTuneStep:
    """Build the jitted step, (state, batch) → (state, metrics); it takes the buffers of its state over."""

    def step(state: FineTuneState, batch: TouchBatch) -> tuple[FineTuneState, dict[str, Array]]:
        def loss(params: Params) -> Float[Array, ""]:
            log_p = level_log_probs(config, params, batch, encode=encode_batch)
            return label_loss(log_p, batch.label[:, : len(config.levels)])

        value, grads = jax.value_and_grad(loss)(state.params)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics = {"loss": value, "grad_norm": optax.tree.norm(grads)}
        return FineTuneState(params=params, opt_state=opt_state, step=state.step + 1), metrics

    return jax.jit(step, donate_argnums=0)


def label_loss(log_p: Float[Array, "P A K"], label: Int[Array, "P A"]) -> Float[Array, ""]:
    """Mean −log p of the known labels; −1 marks an unknown one."""
    return label_cost(log_p, label) / jnp.maximum(jnp.sum(label >= 0), 1)


def label_cost(log_p: Float[Array, "P A K"], label: Int[Array, "P A"]) -> Float[Array, ""]:
    """Sum of −log p over the known labels; −1 marks an unknown one."""
    return -masked.total(token_log_probs(log_p, jnp.maximum(label, 0)), label >= 0)


def level_log_probs(
    config: FineTuned, params: Params, batch: TouchBatch, *, encode: Callable[..., Any] = encode_each
) -> Float[Array, "P A K"]:
    """Log-probability of every level of every attribute; −∞ for levels that an attribute lacks."""
    features = _features(config, params["encoder"], batch, encode)
    return normalised_levels((features @ params["head"]).reshape(len(features), len(config.levels), -1), config.levels)


def normalised_levels(logits: Float[Array, "P A K"], levels: Sequence[int]) -> Float[Array, "P A K"]:
    """Log-softmax over the levels that each attribute has; −∞ for those that it lacks."""
    exists: Bool[np.ndarray, "A K"] = np.arange(logits.shape[-1]) < np.array(levels)[:, None]
    return jax.nn.log_softmax(jnp.where(exists, logits, -jnp.inf))


def _features(config: FineTuned, encoder: Params, batch: TouchBatch, encode: Callable[..., Any]) -> Float[Array, "P W"]:
    exists = steps_of(batch, config.encoder.frames_per_step).exists
    latent: Any = encode(config.encoder, encoder, batch)
    return layer_norm(contact_features(latent, exists))
