"""Stage 1, tactile dynamics: predict the next latent of touch, with no label.

    L = mean |P(f(x_≤t)) − LN(sg f̄(x_≤t+1))| + w_v · mean_d max(0, 1 − std_d) + w_c · Σ_{i≠j} cov_ij² / D

over the steps and streams that exist.  f is a causal `TactileViT`, f̄ its moving average, P a `LatentPredictor` that
sees a random subset of the streams and is asked about all.  Standard deviation and covariance are those of f's latents
before the layer norm *between contacts*: of one sensor at one step, across the batch.  If pooled over sensors and
steps, latents that only distinguish sensors and forces would satisfy them.

Sources: Assran et al. 2023 (I-JEPA) for the objective; Bardes et al. 2022 (VICReg, §4.1) for the two terms, here with
std = √(var + 1e-4); Grill et al. 2020 (BYOL) for the moving average.  Departures: the predictor receives time and force
of the step that it predicts, and latents of other sensors.

`DynamicsConfig.objective` selects one of three other objectives (see `objectives`), each with a head instead of the
predictor: contrast between sensors, prediction of hidden patches, force and depth.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, assert_never

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.predictor import LN_FLOOR, Head, LatentPredictor, PredictorConfig, layer_norm
from touchr1_jax.models.salience import fewer_frames
from touchr1_jax.models.tactile_vit import TactileViT, TactileViTConfig
from touchr1_jax.training.objectives import (
    Objective,
    contrast_loss,
    hidden_loss,
    hide_patches,
    measured_loss,
    measured_targets,
    random_patches,
)
from touchr1_jax.types import Params, TouchBatch
from touchr1_jax.validation import at_least, within

SPREAD_FLOOR = 1e-4
"""Added to a variance under the root, whose gradient is then finite; VICReg's."""


@struct.dataclass
class Guards:
    """Terms that keep the latents from collapsing; numbers, so that one compiled step serves them all.

    Args:
      variance, covariance: weights w_v, w_c of the two terms.
      ema: share of the moving average that stays in a step; 0 makes the target the encoder itself.
      leak: share of the gradient that reaches the target; 0 is the stop-gradient.
    """

    variance: Float[Array, ""] | float = 1.0
    covariance: Float[Array, ""] | float = 0.04
    ema: Float[Array, ""] | float = 0.99
    leak: Float[Array, ""] | float = 0.0


FULL_SHARE = 0.5
"""Probability that all streams are shown; else a random non-empty subset is."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DynamicsConfig:
    """Encoder and predictor.

    With `frames_kept`, only the most salient frames of each stream are read (`salience.fewer_frames`).
    """

    encoder: TactileViTConfig
    predictor: PredictorConfig = PredictorConfig()
    frames_kept: int | None = None
    objective: Objective = "dynamics"
    hidden_share: float = 0.5
    """Share of the patches that are hidden, for the objective `masked`."""
    embedding: int = 64
    """Width of the embedding that the objective `contrast` compares."""

    def __post_init__(self) -> None:
        if self.objective == "dynamics" and not self.encoder.causal:
            raise ValueError("encoder.causal is False: a step that sees the next one predicts it by copying; set it")
        kept = {"frames_kept": self.frames_kept, "encoder.patches_kept": self.encoder.patches_kept}
        if self.objective in ("masked", "physics") and any(value is not None for value in kept.values()):
            raise ValueError(f"{kept}: must be None for objective {self.objective!r}, which reads all; leave them out")
        within(self, 0, 1, "hidden_share")
        at_least(self, 1, "embedding")


@struct.dataclass
class MeasuredTouch:
    """Contacts with measures of the depth of each frame, mm; NaN where it was not measured."""

    touch: TouchBatch
    depth_mm: Float[Array, "P S F q"]


@struct.dataclass
class DynamicsState:
    """State of training; `params` holds "encoder" and "predictor", `target` the averaged encoder."""

    params: Params
    target: Params
    opt_state: optax.OptState
    step: Int[Array, ""]
    key: Array


@struct.dataclass
class Steps:
    """Time steps, [P, S, T]: frame index, force of the last frame, existence."""

    index: Int[Array, "P S T"]
    force_n: Float[Array, "P S T 3"]
    exists: Bool[Array, "P S T"]


def read_frames(config: DynamicsConfig, batch: TouchBatch) -> TouchBatch:
    """The batch with the frames that are read."""
    return batch if config.frames_kept is None else fewer_frames(batch, config.frames_kept)


def steps_of(batch: TouchBatch, frames_per_step: int) -> Steps:
    """Time steps of the streams that are present."""
    p, s, f = batch.frame_index.shape
    split = lambda x: x.reshape(p, s, f // frames_per_step, frames_per_step, *x.shape[3:])
    exists = split(batch.frame_mask).any(-1) & batch.stream_mask[..., None]
    force_n = jnp.where(batch.frame_mask[..., None], batch.force_n, 0.0)
    return Steps(index=split(batch.frame_index)[..., 0], force_n=split(force_n)[:, :, :, -1], exists=exists)


def encode_batch(config: TactileViTConfig, params: Params, batch: TouchBatch) -> Float[Array, "P S T N D"]:
    """Latents f(x_≤t) of all streams of a batch: the pooled tokens of each step."""
    latent: Any = TactileViT(config).apply({"params": params}, *_streams(batch))
    return latent


def encode_each(config: TactileViTConfig, params: Params, batch: TouchBatch) -> Float[Array, "P S T N D"]:
    """The same, contact by contact, without gradient: two to three times faster on a CPU.

    The activations of the stem then stay in a core's cache until the next layer; those of eight contacts of 32 frames
    take 25 MB and would have to be read from memory.  With a gradient, they must be stored anyway.
    """
    latent: Any = jax.lax.map(lambda x: TactileViT(config).apply({"params": params}, *x), _streams(batch))
    return latent


def _streams(batch: TouchBatch) -> tuple[Array, Array, Array, Array, Array]:
    """Arguments of the encoder, leading [P, S]."""
    sensors = jnp.broadcast_to(jnp.arange(batch.frames.shape[1]), batch.frames.shape[:2])
    return batch.frames, batch.force_n, batch.frame_index, batch.frame_mask, sensors


def predict_next(
    config: DynamicsConfig, params: Params, latent: Float[Array, "P S T N D"], steps: Steps, shown: Bool[Array, "P S"]
) -> Float[Array, "P S T-1 N D"]:
    """Predicted latents of the steps 1 … T − 1 from the shown streams."""
    predictor = LatentPredictor(config.predictor, latent.shape[1])
    visible = steps.exists & shown[..., None]
    known = (steps.index[:, :, 1:], steps.force_n[:, :, 1:])
    out: Any = predictor.apply({"params": params}, latent[:, :, :-1], visible[:, :, :-1], *known)
    return out


def dynamics_loss(
    config: DynamicsConfig, params: Params, target: Params, batch: TouchBatch, shown: Bool[Array, "P S"], guards: Guards
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The loss of the module's formula and its terms.

    Args:
      config: networks.
      params: of encoder and predictor.
      target: of the averaged encoder.
      batch: P contacts.
      shown: streams that the predictor sees.
      guards: weights.
    """
    batch = read_frames(config, batch)
    steps = steps_of(batch, config.encoder.frames_per_step)
    latent = encode_batch(config.encoder, params["encoder"], batch)
    goal = layer_norm(_goal(config.encoder, target, params["encoder"], batch, guards.leak))
    error, copied = prediction_errors(predict_next(config, params["predictor"], latent, steps, shown), goal, steps)
    spread, mixed = spread_of(latent, steps.exists), covariance_of(latent, steps.exists)
    variance = jnp.maximum(0.0, 1.0 - spread).mean()
    metrics = {
        "prediction": error,
        "skill": 1.0 - error / jnp.maximum(copied, LN_FLOOR),
        "variance_term": variance,
        "covariance_term": mixed,
        "flat_share": jnp.mean(spread < FLAT),
        "spread": spread.mean(),
    }
    return error + guards.variance * variance + guards.covariance * mixed, metrics


def _goal(
    config: TactileViTConfig, target: Params, params: Params, batch: TouchBatch, leak: Float[Array, ""] | float
) -> Float[Array, "P S T N D"]:
    """Latents of the target; where gradients leak into it, as if a share of its parameters were the encoder's."""
    if isinstance(leak, float) and leak == 0.0:  # known when the step is compiled: no backward pass is made for it
        return encode_each(config, target, batch)
    leaked = jax.tree.map(lambda t, p: t + leak * (p - jax.lax.stop_gradient(p)), target, params)
    return encode_batch(config, leaked, batch)


FLAT = 0.1
"""Standard deviation of a latent dimension between contacts below which it counts as collapsed; the goal is 1."""


def prediction_errors(
    predicted: Float[Array, "P S pair N D"], goal: Float[Array, "P S T N D"], steps: Steps
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean |ẑ_{t+1} − z_{t+1}| and mean |z_t − z_{t+1}|, copy-last, over the T − 1 pairs of steps, if both exist."""
    both = (steps.exists[:, :, 1:] & steps.exists[:, :, :-1])[..., None, None]
    error = masked.mean(jnp.abs(predicted - goal[:, :, 1:]), both)
    return error, masked.mean(jnp.abs(goal[:, :, :-1] - goal[:, :, 1:]), both)


def spread_of(latent: Float[Array, "P S T N D"], exists: Bool[Array, "P S T"]) -> Float[Array, "D"]:
    """Standard deviation of each dimension between contacts, √(var + 1e-4), mean over sensors, steps and tokens."""
    seen = exists[..., None, None]
    spread = jnp.sqrt(masked.var(latent, seen, 0) + SPREAD_FLOOR)  # S T N D
    return masked.mean(spread, (exists.sum(0) > 1)[..., None, None], (0, 1, 2))


def covariance_of(latent: Float[Array, "P S T N D"], exists: Bool[Array, "P S T"]) -> Float[Array, ""]:
    """Σ_{i≠j} cov_ij² / D of the dimensions between contacts, pooled over sensors, steps and tokens."""
    rows, d = residuals(latent, exists), latent.shape[-1]
    cov = rows.T @ rows / jnp.maximum(latent.shape[3] * exists.sum(), 1)
    return jnp.sum(jnp.where(jnp.eye(d, dtype=bool), 0.0, cov) ** 2) / d


def residuals(latent: Float[Array, "P S T N D"], exists: Bool[Array, "P S T"]) -> Float[Array, "rows D"]:
    """Latents less their mean over the contacts of the batch, one row each; zeros where a step does not exist."""
    seen = exists[..., None, None]
    centred = jnp.where(seen, latent - masked.mean(latent, seen, 0, keepdims=True), 0.0)
    return centred.reshape(-1, latent.shape[-1])


def random_shown(key: Array, present: Bool[Array, "P S"], full_share: float) -> Bool[Array, "P S"]:
    """All present streams with probability `full_share`, else a random non-empty subset of them.

    A subset keeps each stream with probability one half, and always one stream chosen at random.
    """
    full_key, keep_key, one_key = jax.random.split(key, 3)
    full = jax.random.bernoulli(full_key, full_share, (present.shape[0], 1))
    score = jnp.where(present, jax.random.uniform(one_key, present.shape), -1.0)
    one = score == score.max(-1, keepdims=True)
    return present & (full | one | jax.random.bernoulli(keep_key, 0.5, present.shape))


def head_of(config: DynamicsConfig, quantities: int = 0) -> Head:
    """The head of an objective other than `dynamics`; `quantities` are those of `physics`."""
    out = {"contrast": config.embedding, "masked": config.encoder.width, "physics": quantities}[config.objective]
    return Head(width=2 * config.encoder.width, out=out)


def contrast_terms(config: DynamicsConfig, params: Params, batch: TouchBatch) -> Float[Array, ""]:
    """`contrast_loss` of each stream's mean latent, without force and time, which would identify a contact."""
    batch = read_frames(config, batch)
    order = jnp.broadcast_to(jnp.arange(batch.frame_index.shape[-1]), batch.frame_index.shape)
    latent = encode_batch(
        config.encoder, params["encoder"], dataclasses.replace(without_force(batch), frame_index=order)
    )
    exists = steps_of(batch, config.encoder.frames_per_step).exists
    mean = masked.mean(latent, exists[..., None, None], (2, 3))
    embedding: Any = head_of(config).apply({"params": params["predictor"]}, mean)
    return contrast_loss(embedding, exists.any(-1))


def masked_terms(
    config: DynamicsConfig, params: Params, target: Params, batch: TouchBatch, key: Array
) -> Float[Array, ""]:
    """`hidden_loss` of hidden patches, and of all pooled tokens, against the averaged encoder that sees everything."""
    frames, index = batch.frames, batch.frame_index
    cell = config.encoder.stem_px * config.encoder.patch_cells
    grid = frames.shape[-3] // cell * (frames.shape[-2] // cell)
    hidden = random_patches(key, (*index.shape[:2], grid), config.hidden_share)
    encode = lambda p, x: TactileViT(config.encoder).apply({"params": p}, *_streams(x), method=TactileViT.encode)
    seen: Any = encode(params["encoder"], dataclasses.replace(batch, frames=hide_patches(frames, hidden)))
    goal: Any = encode(target, batch)

    def head(latent: Array) -> Array:
        found: Any = head_of(config).apply({"params": params["predictor"]}, latent)
        return found

    exists = steps_of(batch, config.encoder.frames_per_step).exists[..., None]
    patches = hidden_loss(head(seen.patches), layer_norm(goal.patches), exists & hidden[:, :, None])
    pooled = hidden_loss(head(seen.pooled), layer_norm(goal.pooled), jnp.broadcast_to(exists, seen.pooled.shape[:-1]))
    return patches + pooled


def physics_terms(config: DynamicsConfig, params: Params, batch: MeasuredTouch) -> Float[Array, ""]:
    """`measured_loss` of force and depth at the last frame of each step, estimated without force as input."""
    touch, per_step = batch.touch, config.encoder.frames_per_step
    steps = steps_of(touch, per_step)
    depth_mm = batch.depth_mm[:, :, per_step - 1 :: per_step]
    measured, known = measured_targets(steps.force_n, depth_mm)
    latent = encode_batch(config.encoder, params["encoder"], without_force(touch))
    head = head_of(config, measured.shape[-1])
    found: Any = head.apply({"params": params["predictor"]}, latent.reshape(*latent.shape[:3], -1))
    return measured_loss(found, measured, known & steps.exists[..., None])


def without_force(batch: TouchBatch) -> TouchBatch:
    """The contacts with unknown forces."""
    return dataclasses.replace(batch, force_n=jnp.zeros_like(batch.force_n))


def stage_one_loss(
    config: DynamicsConfig,
    params: Params,
    target: Params,
    batch: TouchBatch | MeasuredTouch,
    key: Array,
    guards: Guards,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Loss and metrics of the configured objective; arguments as in `dynamics_loss`, `key` draws what is hidden.

    Raises:
      ValueError: the objective `physics` without measured depth.
    """
    touch = batch.touch if isinstance(batch, MeasuredTouch) else batch
    match config.objective:
        case "dynamics":
            shown = random_shown(key, touch.stream_mask, FULL_SHARE)
            return dynamics_loss(config, params, target, touch, shown, guards)
        case "contrast":
            value = contrast_terms(config, params, touch)
        case "masked":
            value = masked_terms(config, params, target, touch, key)
        case "physics":
            if not isinstance(batch, MeasuredTouch):
                raise ValueError("batch has no depth_mm: the objective physics needs it; pass a MeasuredTouch")
            value = physics_terms(config, params, batch)
        case _:
            assert_never(config.objective)
    return value, {config.objective: value}


def start_dynamics(
    config: DynamicsConfig, optimizer: optax.GradientTransformation, key: Array, batch: TouchBatch | MeasuredTouch
) -> DynamicsState:
    """Fresh state from one key and the shapes of a batch."""
    encoder_key, predictor_key, key = jax.random.split(key, 3)
    batch, depth = (batch.touch, batch.depth_mm) if isinstance(batch, MeasuredTouch) else (batch, None)
    one = read_frames(config, jax.tree.map(lambda x: x[:1], batch))
    sensors = jnp.arange(batch.frames.shape[1])[None]
    streams = (one.frames, one.force_n, one.frame_index, one.frame_mask, sensors)
    encoder = TactileViT(config.encoder).init(encoder_key, *streams)["params"]
    latent, steps = encode_batch(config.encoder, encoder, one), steps_of(one, config.encoder.frames_per_step)
    if config.objective == "dynamics":
        asked = (latent[:, :, :-1], steps.exists[:, :, :-1], steps.index[:, :, 1:], steps.force_n[:, :, 1:])
        predictor = LatentPredictor(config.predictor, batch.frames.shape[1]).init(predictor_key, *asked)["params"]
    else:
        quantities = 0 if depth is None else 4 + depth.shape[-1]
        joined = latent.reshape(*latent.shape[:3], -1) if config.objective == "physics" else latent
        predictor = head_of(config, quantities).init(predictor_key, joined)["params"]
    params = {"encoder": encoder, "predictor": predictor}
    target = jax.tree.map(jnp.copy, encoder)  # the step gives its buffers away: the two must not share any
    zero = jnp.zeros((), jnp.int32)
    return DynamicsState(params=params, target=target, opt_state=optimizer.init(params), step=zero, key=key)


DynamicsStep = Callable[[DynamicsState, TouchBatch | MeasuredTouch], tuple[DynamicsState, dict[str, Array]]]


def dynamics_update(
    config: DynamicsConfig,
    optimizer: optax.GradientTransformation,
    guards: Guards,
    state: DynamicsState,
    batch: TouchBatch | MeasuredTouch,
) -> tuple[DynamicsState, dict[str, Array]]:
    """One step of gradient descent, then f̄ ← ema · f̄ + (1 − ema) · f; pure, for `jit` and `vmap`."""
    key = jax.random.fold_in(state.key, state.step)
    loss = lambda p: stage_one_loss(config, p, state.target, batch, key, guards)
    (value, metrics), grads = jax.value_and_grad(loss, has_aux=True)(state.params)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    target = jax.tree.map(lambda t, p: guards.ema * t + (1 - guards.ema) * p, state.target, params["encoder"])
    metrics = {"loss": value, **metrics, "grad_norm": optax.tree.norm(grads)}
    return dataclasses.replace(state, params=params, target=target, opt_state=opt_state, step=state.step + 1), metrics


def make_dynamics_step(
    config: DynamicsConfig, optimizer: optax.GradientTransformation, guards: Guards | None = None
) -> DynamicsStep:
    """Build the jitted step, (state, batch) → (state, metrics); it takes the buffers of its state over."""
    fixed = guards or Guards()
    return jax.jit(lambda state, batch: dynamics_update(config, optimizer, fixed, state, batch), donate_argnums=0)
