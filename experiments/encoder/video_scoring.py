"""Predicted frames and their scores: trained predictors, baselines, metrics."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.study.dataset import Dataset
from touchr1_jax.bench.image_similarity import lpips, ssim
from touchr1_jax.models.predictor import layer_norm
from touchr1_jax.models.tactile_vit import TactileViT, TactileViTConfig
from touchr1_jax.training.feeds import touch_batch
from touchr1_jax.training.video import (
    Asked,
    VideoConfig,
    every_question,
    frame_at,
    predict_frames,
    target_of,
    unit_pixels,
)
from touchr1_jax.types import Params, TouchBatch

COPY, MEAN = "copy last", "mean frame"
"""The baselines: the last visible frame, and the mean training frame of that sensor at that position."""

TARGET, EXISTS = "true frame", "exists"

SCORE_BATCH = 8  # contacts that are scored at once; a clip of 8 frames by four sensors is 1.2 MB


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TrainedPredictor:
    """A trained video predictor."""

    config: VideoConfig
    params: Params

    @functools.cached_property
    def predict(self) -> Callable[[TouchBatch, Asked], Any]:
        """Predicted frames, clipped to [0, 1]; compiled once."""
        apply = jax.jit(lambda p, b, a: jnp.clip(predict_frames(self.config, p, b, a), 0.0, 1.0))
        return functools.partial(apply, self.params)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameScores:
    """Scores of one method: metric → [contact, S, question], NaN where a stream or frame is missing.

    Question q asks for the frame `skips[q]` frames ahead.
    """

    values: Mapping[str, np.ndarray]
    skips: np.ndarray

    def by_contact(self, metric: str, skip: int) -> np.ndarray:
        """Mean over the sensors and the questions of one skip, [contact]."""
        mean: np.ndarray = np.nanmean(self.values[metric][:, :, self.skips == skip], (1, 2))
        return mean

    def by_sensor(self, metric: str, skip: int) -> np.ndarray:
        """Mean over the contacts and the questions of one skip, [S]."""
        mean: np.ndarray = np.nanmean(self.values[metric][:, :, self.skips == skip], (0, 2))
        return mean


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FrameMetrics:
    """The metrics: L1 and SSIM, the distance of an encoder's features, LPIPS if its weights are given."""

    encoder: TactileViTConfig
    params: Params
    lpips_weights: Mapping[str, np.ndarray] | None = None

    def score(self, predicted: np.ndarray, target: np.ndarray, batch: TouchBatch) -> dict[str, np.ndarray]:
        """Metric → [P, S], of frames [P, S, H, W, 3] in [0, 1]."""
        found = {
            "l1": np.abs(predicted - target).mean((-3, -2, -1)),
            "ssim": ssim(predicted, target),
            "encoder_distance": np.asarray(self._distance(self.params, predicted, target, batch)),
        }
        if self.lpips_weights is not None:
            flat = lambda x: jnp.asarray(x).reshape(-1, *x.shape[-3:])
            found["lpips"] = np.asarray(self._lpips(flat(predicted), flat(target))).reshape(predicted.shape[:2])
        return found

    @functools.cached_property
    def _lpips(self) -> Callable[..., Any]:
        return jax.jit(lambda a, b: lpips(a, b, self.lpips_weights or {}))

    @functools.cached_property
    def _distance(self) -> Callable[..., Any]:
        """Mean |LN f(x̂) − LN f(x)| over the patch tokens of the second frame of the pair (first frame, frame)."""
        network = TactileViT(self.encoder)

        def tokens(params: Params, frame: Any, batch: TouchBatch) -> Any:
            pair = 255.0 * jnp.stack([unit_pixels(batch.frames[:, :, 0]), frame], 2)
            index = jnp.broadcast_to(jnp.arange(2), pair.shape[:3])
            sensors = jnp.broadcast_to(jnp.arange(pair.shape[1]), pair.shape[:2])
            streams = (pair, jnp.zeros((*index.shape, 3)), index, jnp.ones(index.shape, bool), sensors)
            encoded: Any = network.apply({"params": params}, *streams, method=TactileViT.encode)
            return layer_norm(encoded.patches[:, :, 1])

        return jax.jit(lambda p, a, b, batch: jnp.abs(tokens(p, a, batch) - tokens(p, b, batch)).mean((-2, -1)))


def mean_frames(data: Dataset, rows: np.ndarray, context: Context) -> np.ndarray:
    """Mean frame of every sensor at every position of its clip, float32 [S, F, H, W, 3] in [0, 1]; 0 without frames."""
    total: Any = 0.0
    count: Any = 0.0
    with context.progress("mean frames", len(rows)) as advance:
        for clip in data.batches(rows, batch_size=SCORE_BATCH, seed=0, shuffle=False, repeat=False):
            exists = (clip["frame_mask"] & clip["stream_mask"][..., None])[..., None, None, None]
            total = total + np.where(exists, clip["frames"], 0).sum(0, dtype=np.float64)
            count = count + exists.sum(0)
            advance(len(exists))
    return (total / np.maximum(count, 1) / 255.0).astype(np.float32)


def score_frames(
    predictors: Mapping[str, TrainedPredictor],
    mean: np.ndarray,
    data: Dataset,
    rows: np.ndarray,
    metrics: FrameMetrics,
    context: Context,
) -> dict[str, FrameScores]:
    """Scores of the predictors, all of the same skips, and of the baselines.

    Args:
      predictors: by name.
      mean: `mean_frames`.
      data: the records.
      rows: contacts to score.
      metrics: to score by.
      context: shows the progress.
    """
    skips = next(iter(predictors.values())).config.skips
    questions = every_question(data.clip.frames, skips)
    blocks: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in (*predictors, COPY, MEAN)}
    with context.progress("scoring", len(rows)) as advance:
        for batch, count in batches(data, rows):
            frames = [predict_all(predictors, mean, batch, t, k, skips) for t, k in questions]
            for name, parts in blocks.items():
                found = [metrics.score(one[name], one[TARGET], batch) for one in frames]
                masked = lambda m, found=found, frames=frames: [
                    np.where(one[EXISTS], scores[m], np.nan) for scores, one in zip(found, frames, strict=True)
                ]
                parts.append({m: np.stack(masked(m), -1)[:count] for m in found[0]})
            advance(count)
    skip_of = np.array([skips[k] for _, k in questions])
    return {
        name: FrameScores(values={m: np.concatenate([b[m] for b in parts]) for m in parts[0]}, skips=skip_of)
        for name, parts in blocks.items()
    }


def predict_all(
    predictors: Mapping[str, TrainedPredictor],
    mean: np.ndarray,
    batch: TouchBatch,
    t: int,
    k: int,
    skips: tuple[int, ...],
) -> dict[str, np.ndarray]:
    """Every method's frames `skips[k]` ahead of frame t, the true frames (`TARGET`) and whether they exist."""
    shape = batch.stream_mask.shape
    asked = Asked(last=jnp.full(shape, t, jnp.int32), skip=jnp.full(shape, k, jnp.int32))
    target, exists = target_of(batch, asked, skips)
    return {
        **{name: np.asarray(predictor.predict(batch, asked)) for name, predictor in predictors.items()},
        COPY: np.asarray(frame_at(batch, asked.last)),
        MEAN: np.broadcast_to(mean[:, t + skips[k]], target.shape),
        TARGET: np.asarray(target),
        EXISTS: np.asarray(exists),
    }


def batches(data: Dataset, rows: np.ndarray) -> Iterator[tuple[TouchBatch, int]]:
    """Batches of one size, the last one padded, and the number of their contacts that count."""
    padded = rows[np.minimum(np.arange(-(-len(rows) // SCORE_BATCH) * SCORE_BATCH), len(rows) - 1)]
    clips = data.batches(padded, batch_size=SCORE_BATCH, seed=0, shuffle=False, repeat=False)
    for start, clip in zip(range(0, len(padded), SCORE_BATCH), clips, strict=True):
        yield touch_batch(clip), min(SCORE_BATCH, len(rows) - start)
