"""Recordings for encoders, and measurements on held-out contacts: skill, linear probes, rank; with intervals.

The scenes differ from those of the later stages, and are split by object.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.study.dataset import Dataset, open_dataset
from experiments.study.sources import SourceConfig, prepare_records
from sensors_io.pipeline import ClipConfig, Contacts, clip_batches
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import ATTRIBUTES, Flag
from touchr1_jax import masked
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.models.predictor import layer_norm
from touchr1_jax.training.dynamics import (
    FLAT,
    DynamicsConfig,
    DynamicsState,
    encode_each,
    predict_next,
    read_frames,
    residuals,
    spread_of,
    steps_of,
)
from touchr1_jax.training.feeds import touch_batch
from touchr1_jax.training.latent_probes import contact_features, probe_right, rank_me, told_apart
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.types import Params, TouchBatch

BATCH = 32
"""Contacts that are encoded at once."""

RANK_ROWS = 4096
"""Latents whose rank is computed: twenty for each of two hundred dimensions."""

RESAMPLES = 2000
"""Resamples of each interval: the error of its ends is about a tenth of its width."""

STAGE_ONE_SEED = 1
"""Seed of the scenes of stage 1: its objects differ from those of seed 0, on which later stages train and test."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageOneDataConfig(SourceConfig):
    """The recordings, and the largest number of labelled contacts to fit the probes on."""

    scenes: SceneConfig = SceneConfig(objects=2400, sites=1, seed=STAGE_ONE_SEED)
    probe_fit: int = 1680
    probe: ProbeConfig = ProbeConfig()


def open_touch(config: StageOneDataConfig, frames: int, image_px: int, context: Context) -> Dataset:
    """The records, made first if the cache lacks them; frames past the strain limit stay in, as in the studies."""
    clip = ClipConfig(frames=frames, image_px=image_px, rejected=(Flag.NOT_CONVERGED, Flag.SATURATED))
    return open_dataset(prepare_records(config, context), clip, grpo_share=0.5)


def training_rows(data: Dataset) -> np.ndarray:
    """Contacts of all training objects, ascending; all are used, since no later stage shares these scenes."""
    return np.sort(np.concatenate([data.parts["sft"], data.parts["grpo"]]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeldOutContacts:
    """Contacts to measure on: probes are fitted on `fit_rows`, everything is measured on `read_rows`.

    `label` int32 [contact, A] is of the whole store.
    """

    store: Contacts
    clip: ClipConfig
    fit_rows: np.ndarray
    read_rows: np.ndarray
    label: np.ndarray
    probe: ProbeConfig

    @property
    def rows(self) -> np.ndarray:
        """All contacts, those to fit on first, [fit + read]."""
        return np.concatenate([self.fit_rows, self.read_rows])

    @property
    def fitted(self) -> np.ndarray:
        """True for the rows to fit on, bool [fit + read]."""
        return np.arange(len(self.rows)) < len(self.fit_rows)

    def probe_right(self, latent: np.ndarray, exists: np.ndarray) -> np.ndarray:
        """True where a linear probe on the latents of all contacts is right, bool [read, 3]."""
        label = self.label[self.rows][:, [ATTRIBUTES.index(name) for name in ORDINAL]]
        return probe_right(np.asarray(contact_features(latent, exists)), label, self.fitted, self.probe)

    def encode(self, encode: Callable[[TouchBatch], dict[str, Any]], context: Context) -> dict[str, np.ndarray]:
        """Results of all rows on the host, in their order; every call has the same number of contacts."""
        rows, parts = self.rows, []
        padded = rows[np.minimum(np.arange(-(-len(rows) // BATCH) * BATCH), len(rows) - 1)]
        order: dict[str, Any] = {"batch_size": BATCH, "seed": 0, "shuffle": False, "repeat": False}
        with context.progress("encoding", len(padded)) as advance:
            for element in clip_batches(self.store, padded, self.clip, **order):
                parts.append(jax.device_get(encode(touch_batch(element))))
                advance(BATCH)
        return {name: np.concatenate([part[name] for part in parts])[: len(rows)] for name in parts[0]}


def held_out_contacts(data: Dataset, part: str, config: StageOneDataConfig, fit: int | None = None) -> HeldOutContacts:
    """Contacts of a part ("val" for choosing, "test" for reporting) to measure on, and training contacts to fit on.

    `fit` is another number of contacts to fit on than the configured one.
    """
    return HeldOutContacts(
        store=data.store,
        clip=data.clip,
        fit_rows=training_rows(data)[: config.probe_fit if fit is None else fit],
        read_rows=data.parts[part],
        label=data.label,
        probe=config.probe,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class EncoderAssessment:
    """Measurements of one encoder, by contact where intervals resample objects.

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
    networks: DynamicsConfig, state: DynamicsState, held_out: HeldOutContacts, context: Context
) -> EncoderAssessment:
    """Measure the averaged encoder and the predictor; all streams that exist are shown."""
    compiled, fitted = _predict(networks), held_out.fitted
    found = held_out.encode(lambda batch: compiled(state.params, state.target, batch), context)
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
        right=held_out.probe_right(latent, exists),
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


def probe_encoder(networks: DynamicsConfig, encoder: Params, held_out: HeldOutContacts, context: Context) -> np.ndarray:
    """True where the probes on an encoder alone are right, bool [read, 3]."""

    def encode(batch: TouchBatch) -> dict[str, Any]:
        batch = read_frames(networks, batch)
        exists = steps_of(batch, networks.encoder.frames_per_step).exists
        return {"latent": encode_each(networks.encoder, encoder, batch), "exists": exists}

    return held_out.probe_right(**held_out.encode(jax.jit(encode), context))


def points(values: np.ndarray, objects: np.ndarray) -> Interval:
    """Mean in points of values [n] or [n, A] of n contacts, with an interval over objects [n]."""
    clusters = np.repeat(objects, values[0].size)
    return clustered_bootstrap(100.0 * values.astype(float).ravel(), clusters, resamples=RESAMPLES)


def skill(error: np.ndarray, reference: np.ndarray, objects: np.ndarray) -> Interval:
    """1 − Σ error / Σ reference over n contacts, with an interval over objects.

    Args:
      error, reference: [n] of the same contacts, reference > 0 in sum.
      objects: [n].

    Raises:
      ValueError: a reference without error, for which no skill is defined.
    """
    if not reference.sum() > 0:
        raise ValueError(f"reference sums to {reference.sum()}: must be > 0, or no skill is defined; choose another")
    names, group = np.unique(objects, return_inverse=True)
    sums = np.zeros((len(names), 2))
    np.add.at(sums, group, np.stack([error, reference], 1).astype(float))
    weights = np.random.default_rng(0).multinomial(len(names), np.full(len(names), 1 / len(names)), RESAMPLES)
    drawn = weights @ sums
    low, high = np.quantile(1 - drawn[:, 0] / drawn[:, 1], (0.025, 0.975))
    return Interval(mean=float(1 - error.sum() / reference.sum()), low=float(low), high=float(high))
