"""What an encoder knows about contacts that it was not trained on: skill of its predictions, probes, rank."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.study.feeds import touch_batch
from sensors_io.pipeline import ClipConfig, Contacts, clip_batches
from sensors_io.schema import ATTRIBUTES
from touchr1_jax import masked
from touchr1_jax.bench.metrics import ORDINAL
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
from touchr1_jax.training.evidence import ProbeConfig
from touchr1_jax.training.probes import contact_features, probe_right, rank_me, told_apart
from touchr1_jax.types import Params, TouchBatch

BATCH = 32
"""Contacts that are encoded at once."""

RANK_ROWS = 4096
"""Latents whose rank is taken: twenty for each of two hundred dimensions."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeldOutContacts:
    """Contacts to measure on: probes are fitted on `fit_rows` and everything is read on `read_rows`.

    `label` int32 [contact, A] and `objects` [contact] are of the whole store.
    """

    store: Contacts
    clip: ClipConfig
    fit_rows: np.ndarray
    read_rows: np.ndarray
    label: np.ndarray
    objects: np.ndarray
    probe: ProbeConfig = ProbeConfig()

    @property
    def fitted(self) -> np.ndarray:
        """Which of all rows, those to fit first, are fitted on, bool [fit + read]."""
        return np.arange(len(self.fit_rows) + len(self.read_rows)) < len(self.fit_rows)

    def ordinal_labels(self) -> np.ndarray:
        """Labels of all rows, int32 [fit + read, 3]."""
        columns = [ATTRIBUTES.index(name) for name in ORDINAL]
        return self.label[np.concatenate([self.fit_rows, self.read_rows])][:, columns]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EncoderAssessment:
    """Everything by contact, so that intervals can resample objects.

    Args:
      error, copied, constant: [n] mean error of the prediction, of the last latent, of each step's mean latent.
      right: [n, 3] whether the probe is right about hardness, roughness, protrusion.
      told_apart: what contacts differ by, over the size of the latents.
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
    def skill(self) -> float:
        """1 − error / error of copying the last latent."""
        return float(1 - self.error.mean() / max(float(self.copied.mean()), 1e-9))

    @property
    def accuracy(self) -> float:
        """Mean of the three probes, percent."""
        return float(100 * self.right.mean())

    def summary(self) -> dict[str, float]:
        """Numbers for the log, named as the alarms know them."""
        by_name = {f"probe_{name}": float(100 * self.right[:, a].mean()) for a, name in enumerate(ORDINAL)}
        return {
            "skill": self.skill,
            "skill_over_mean": float(1 - self.error.mean() / max(float(self.constant.mean()), 1e-9)),
            **by_name,
            "probe": self.accuracy,
            "told_apart": self.told_apart,
            "flat_share": self.flat_share,
            "rank_share": self.rank_share,
        }


def assess(
    networks: DynamicsConfig, state: DynamicsState, watched: HeldOutContacts, context: Context
) -> EncoderAssessment:
    """Measure; all streams that are there are shown."""
    rows = np.concatenate([watched.fit_rows, watched.read_rows])
    look = _look(networks)
    seen = encode_rows(
        lambda batch: look(state.params, state.target, batch), watched.store, rows, watched.clip, context
    )
    fitted = watched.fitted
    goal, exists = seen["goal"], seen["exists"]
    both = (exists[:, :, 1:] & exists[:, :, :-1])[..., None, None]
    mean = np.asarray(masked.mean(goal[fitted], exists[fitted][..., None, None], 0))
    constant = masked.mean(np.abs(goal[~fitted][:, :, 1:] - mean[:, 1:]), both[~fitted], (1, 2, 3, 4))
    features = np.asarray(contact_features(seen["latent"], exists))
    spread = spread_of(jnp.asarray(seen["latent"]), jnp.asarray(exists))
    return EncoderAssessment(
        error=seen["error"][~fitted],
        copied=seen["copied"][~fitted],
        constant=np.asarray(constant),
        right=probe_right(features, watched.ordinal_labels(), fitted, watched.probe),
        told_apart=float(told_apart(seen["latent"], exists)),
        flat_share=float(jnp.mean(spread < FLAT)),
        rank_share=_rank_share(seen["latent"], exists),
    )


def probe_encoder(networks: DynamicsConfig, encoder: Params, watched: HeldOutContacts, context: Context) -> np.ndarray:
    """Whether the probes on an encoder alone are right, bool [read, 3]."""

    def encode(batch: TouchBatch) -> dict[str, Any]:
        batch = read_frames(networks, batch)
        exists = steps_of(batch, networks.encoder.frames_per_step).exists
        return {"latent": encode_each(networks.encoder, encoder, batch), "exists": exists}

    rows = np.concatenate([watched.fit_rows, watched.read_rows])
    seen = encode_rows(jax.jit(encode), watched.store, rows, watched.clip, context)
    features = np.asarray(contact_features(seen["latent"], seen["exists"]))
    return probe_right(features, watched.ordinal_labels(), watched.fitted, watched.probe)


def encode_rows(
    encode: Callable[[TouchBatch], dict[str, Any]],
    store: Contacts,
    rows: np.ndarray,
    clip: ClipConfig,
    context: Context,
) -> dict[str, np.ndarray]:
    """Results of all rows on the host, in their order; every call has the same number of contacts."""
    padded = rows[np.minimum(np.arange(-(-len(rows) // BATCH) * BATCH), len(rows) - 1)]
    parts = []
    with context.progress("encoding", len(padded)) as advance:
        for element in clip_batches(store, padded, clip, batch_size=BATCH, seed=0, shuffle=False, repeat=False):
            parts.append(jax.device_get(encode(touch_batch(element))))
            advance(BATCH)
    return {name: np.concatenate([part[name] for part in parts])[: len(rows)] for name in parts[0]}


@functools.cache
def _look(networks: DynamicsConfig) -> Callable[[Params, Params, TouchBatch], dict[str, Any]]:
    """Compiled measurement of one batch, made once."""

    def look(params: Params, target: Params, batch: TouchBatch) -> dict[str, Any]:
        batch = read_frames(networks, batch)
        steps = steps_of(batch, networks.encoder.frames_per_step)
        latent = encode_each(networks.encoder, target, batch)
        goal = layer_norm(latent)
        seen = encode_each(networks.encoder, params["encoder"], batch)
        predicted = predict_next(networks, params["predictor"], seen, steps, batch.stream_mask)
        both = (steps.exists[:, :, 1:] & steps.exists[:, :, :-1])[..., None, None]
        mean = lambda x: masked.mean(jnp.abs(x), both, (1, 2, 3, 4))
        error, copied = mean(predicted - goal[:, :, 1:]), mean(goal[:, :, :-1] - goal[:, :, 1:])
        return {"latent": latent, "goal": goal, "exists": steps.exists, "error": error, "copied": copied}

    return jax.jit(look)


def _rank_share(latent: np.ndarray, exists: np.ndarray) -> float:
    """Effective rank of the latents' differences between contacts, over their width."""
    rows = np.asarray(residuals(jnp.asarray(latent), jnp.asarray(exists)))
    chosen = np.random.default_rng(0).permutation(len(rows))[:RANK_ROWS]
    return float(rank_me(jnp.asarray(rows[chosen]))) / rows.shape[1]
