"""Encoder pretraining: its configuration, first state and compiled step, and measurements of the resulting encoder.

The objective is that of `dynamics`.  Measurements are the error of the next latent and the accuracy of linear probes.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Bool

from touchr1_jax import masked
from touchr1_jax.models.predictor import PredictorConfig, layer_norm
from touchr1_jax.models.pretrained import PretrainedEncoder
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.training.dynamics import (
    FLAT,
    DynamicsConfig,
    DynamicsState,
    DynamicsStep,
    Guards,
    MeasuredTouch,
    encode_each,
    make_dynamics_step,
    predict_next,
    read_frames,
    residuals,
    spread_of,
    start_dynamics,
    steps_of,
)
from touchr1_jax.training.latent_probes import rank_me, told_apart
from touchr1_jax.training.objectives import Objective
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.types import Params, TouchBatch

RANK_ROWS = 4096
"""Latents whose rank is computed: twenty for each of two hundred dimensions."""

ORDINAL = tuple(a.name for a in TOUCH_LANGUAGE.attributes if a.ordinal)

Encode = Callable[[TouchBatch], dict[str, Any]]
"""From a batch of contacts to arrays with one entry a contact."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """Stage 1; the learning rate is the paper's 1e-5 times `lr_scale`, `encoder.sensors` is set by the data."""

    encoder: TactileViTConfig = TactileViTConfig(sensors=0, causal=True)
    predictor: PredictorConfig = PredictorConfig()
    frames: int = 4
    frames_kept: int | None = None
    """Number of these frames that are read, the most salient ones; all by default."""
    image_px: int = 112
    objective: Objective = "dynamics"
    """Task that is learned without labels (see `objectives.Objective`)."""
    steps: int = 450
    batch_size: int = 32
    probe_every: int = 150
    """Steps between held-out measurements, and between checkpoints."""
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=100.0)

    def dynamics(self, sensors: int) -> DynamicsConfig:
        """The networks for this number of streams."""
        encoder = dataclasses.replace(self.encoder, sensors=sensors)
        return DynamicsConfig(
            encoder=encoder, predictor=self.predictor, frames_kept=self.frames_kept, objective=self.objective
        )


def untrained(config: PretrainConfig, batch: TouchBatch | MeasuredTouch, seed: int) -> DynamicsState:
    """The state before training, for contacts like those of a batch; its target is an untrained encoder."""
    touch = batch.touch if isinstance(batch, MeasuredTouch) else batch
    networks = config.dynamics(touch.stream_mask.shape[1])
    optimizer, _ = dynamics_program(networks, config.optimizer, config.steps)
    start = jax.jit(lambda key, batch: start_dynamics(networks, optimizer, key, batch))
    # committed to the device, as a restored state is: otherwise the step would be compiled twice
    state: DynamicsState = jax.device_put(start(jax.random.key(seed), batch), jax.devices()[0])
    return state


@functools.cache
def dynamics_program(
    networks: DynamicsConfig, optimizer: OptimizerConfig, steps: int
) -> tuple[optax.GradientTransformation, DynamicsStep]:
    """Optimizer and compiled step with all guards against collapse, made once for all seeds."""
    made = make_optimizer(optimizer, steps)
    return made, make_dynamics_step(networks, made, Guards())


def encoder_of(
    config: PretrainConfig, state: DynamicsState, sensors: tuple[str, ...], **notes: Any
) -> PretrainedEncoder:
    """The averaged encoder, from which other training starts."""
    encoder = dataclasses.replace(config.encoder, sensors=len(sensors))
    return PretrainedEncoder(config=encoder, sensors=sensors, params=jax.device_get(state.target), notes=notes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EncoderAssessment:
    """Measurements of one encoder, by contact if intervals resample objects.

    Args:
      error, copied, constant: [n] mean error of the prediction, of the last latent, of each step's mean latent.
      right: [n, 3], true where the probe is right about hardness, roughness, protrusion.
      told_apart: spread between contacts over the size of the latents.
      flat_share: share of latent dimensions that hardly vary between contacts.
      rank_share: effective rank over width.
    """

    error: np.ndarray
    copied: np.ndarray
    constant: np.ndarray
    right: np.ndarray
    told_apart: float
    flat_share: float
    rank_share: float

    @property
    def accuracy(self) -> float:
        """Mean of the three probes, percent."""
        return float(100 * self.right.mean())

    def summary(self) -> dict[str, float]:
        """Numbers for the log, under the names that the alarms use."""
        skill_over = lambda reference: float(1 - self.error.mean() / max(float(reference.mean()), 1e-9))
        return {
            "skill": skill_over(self.copied),
            "skill_over_mean": skill_over(self.constant),
            **{f"probe_{name}": float(100 * self.right[:, a].mean()) for a, name in enumerate(ORDINAL)},
            "probe": self.accuracy,
            **{name: getattr(self, name) for name in ("told_apart", "flat_share", "rank_share")},
        }


def assess(
    networks: DynamicsConfig,
    state: DynamicsState,
    encode_all: Callable[[Encode], dict[str, np.ndarray]],
    fitted: Bool[np.ndarray, "n"],
    probe_right: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> EncoderAssessment:
    """Measure the averaged encoder and the predictor on n contacts; all streams that exist are shown.

    Args:
      networks, state: the trained encoder and predictor.
      encode_all: applies a function to all contacts, batch by batch.
      fitted: contacts of known labels, on which probes and constant predictions are fitted; the others are scored.
      probe_right: from latents and existing steps of all contacts to bool [scored, 3], the answers of the probes.
    """
    compiled = _predict(networks)
    found = encode_all(lambda batch: compiled(state.params, state.target, batch))
    goal, latent, exists = found["goal"], found["latent"], found["exists"]
    both = (exists[:, :, 1:] & exists[:, :, :-1])[..., None, None]
    mean = np.asarray(masked.mean(goal[fitted], exists[fitted][..., None, None], 0))
    constant = masked.mean(np.abs(goal[~fitted][:, :, 1:] - mean[:, 1:]), both[~fitted], (1, 2, 3, 4))
    spread = spread_of(jnp.asarray(latent), jnp.asarray(exists))
    rows = np.asarray(residuals(jnp.asarray(latent), jnp.asarray(exists)))
    chosen = np.random.default_rng(0).permutation(len(rows))[:RANK_ROWS]
    return EncoderAssessment(
        error=found["error"][~fitted],
        copied=found["copied"][~fitted],
        constant=np.asarray(constant),
        right=probe_right(latent, exists),
        told_apart=float(told_apart(latent, exists)),
        flat_share=float(jnp.mean(spread < FLAT)),
        rank_share=float(rank_me(jnp.asarray(rows[chosen]))) / rows.shape[1],
    )


@functools.cache
def _predict(networks: DynamicsConfig) -> Callable[[Params, Params, TouchBatch], dict[str, Any]]:
    """Compiled latents and errors of the prediction for one batch, made once."""

    def predict(params: Params, target: Params, batch: TouchBatch) -> dict[str, Any]:
        batch = read_frames(networks, batch)
        steps = steps_of(batch, networks.encoder.frames_per_step)
        latent = encode_each(networks.encoder, target, batch)
        goal = layer_norm(latent)
        online = encode_each(networks.encoder, params["encoder"], batch)
        predicted = predict_next(networks, params["predictor"], online, steps, batch.stream_mask)
        both = (steps.exists[:, :, 1:] & steps.exists[:, :, :-1])[..., None, None]
        mean = lambda x: masked.mean(jnp.abs(x), both, (1, 2, 3, 4))
        error, copied = mean(predicted - goal[:, :, 1:]), mean(goal[:, :, :-1] - goal[:, :, 1:])
        return {"latent": latent, "goal": goal, "exists": steps.exists, "error": error, "copied": copied}

    return jax.jit(predict)
