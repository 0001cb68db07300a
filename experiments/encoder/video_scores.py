"""Scores of predicted frames, those of the baselines beside them."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.study.dataset import Dataset
from experiments.study.feeds import touch_batch
from touchr1_jax.bench.image_similarity import lpips, ssim
from touchr1_jax.models.predictor import layer_norm
from touchr1_jax.models.tactile_vit import TactileViT, TactileViTConfig
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
"""The baselines: the last frame that is seen, and the mean frame of that sensor at that position in training."""

SCORE_BATCH = 8  # contacts that are scored at once; a clip of 8 frames by four sensors is 1.2 MB


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class VideoPredictor:
    """A trained predictor."""

    config: VideoConfig
    params: Params

    @functools.cached_property
    def predict(self) -> Callable[[TouchBatch, Asked], Any]:
        """Predicted frames, cut to [0, 1]; compiled once."""
        apply = jax.jit(lambda p, b, a: jnp.clip(predict_frames(self.config, p, b, a), 0.0, 1.0))
        return functools.partial(apply, self.params)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameScores:
    """Scores of one method: metric → [contact, S, question], NaN where a stream or frame is missing.

    Question q asks about the frame after `skips[q]` others.
    """

    values: Mapping[str, np.ndarray]
    skips: np.ndarray

    def of(self, metric: str, skip: int) -> np.ndarray:
        """Mean of each contact over the sensors and the questions of one skip, [contact]."""
        mean: np.ndarray = np.nanmean(self.values[metric][:, :, self.skips == skip], (1, 2))
        return mean

    def by_sensor(self, metric: str, skip: int) -> np.ndarray:
        """Mean over contacts and questions of one skip, [S]."""
        mean: np.ndarray = np.nanmean(self.values[metric][:, :, self.skips == skip], (0, 2))
        return mean


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FrameMetrics:
    """The metrics: L1 and SSIM, the distance of an encoder's features, LPIPS where there are weights for it."""

    encoder: TactileViTConfig
    params: Params
    lpips_weights: Mapping[str, np.ndarray] | None = None

    def score(self, predicted: np.ndarray, goal: np.ndarray, batch: TouchBatch) -> dict[str, np.ndarray]:
        """Metric → [P, S], of frames [P, S, H, W, 3] in [0, 1]."""
        found = {
            "l1": np.abs(predicted - goal).mean((-3, -2, -1)),
            "ssim": ssim(predicted, goal),
            "encoder_distance": np.asarray(self._distance(self.params, predicted, goal, batch)),
        }
        if self.lpips_weights is not None:
            flat = lambda x: jnp.asarray(x).reshape(-1, *x.shape[-3:])
            found["lpips"] = np.asarray(self._lpips(flat(predicted), flat(goal))).reshape(predicted.shape[:2])
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
    """Mean frame of every sensor at every position of its clip, float32 [S, F, H, W, 3] in [0, 1]; 0 where none was."""
    total: Any = 0.0
    count: Any = 0.0
    with context.progress("mean frames", len(rows)) as advance:
        for clip in data.batches(rows, batch_size=SCORE_BATCH, seed=0, shuffle=False, repeat=False):
            seen = (clip["frame_mask"] & clip["stream_mask"][..., None])[..., None, None, None]
            total = total + np.where(seen, clip["frames"], 0).sum(0, dtype=np.float64)
            count = count + seen.sum(0)
            advance(len(seen))
    return (total / np.maximum(count, 1) / 255.0).astype(np.float32)


def judged(
    films: Mapping[str, VideoPredictor],
    mean: np.ndarray,
    data: Dataset,
    rows: np.ndarray,
    judge: FrameMetrics,
    context: Context,
) -> dict[str, FrameScores]:
    """Scores of every predictor, which all know the same skips, and of the baselines on some contacts.

    Args:
      films: predictors by name.
      mean: `mean_frames`.
      data: the records.
      rows: contacts to score.
      judge: metrics.
      context: shows how far it is.
    """
    skips = next(iter(films.values())).config.skips
    questions = every_question(data.clip.frames, skips)
    blocks: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in (*films, COPY, MEAN)}
    with context.progress("scoring", len(rows)) as advance:
        for batch, count in batches(data, rows):
            answers = [answer_all(films, mean, batch, t, k, skips) for t, k in questions]
            for name, parts in blocks.items():
                found = [_masked(judge.score(a[name], a[GOAL], batch), a[EXISTS]) for a in answers]
                parts.append({m: np.stack([f[m] for f in found], -1)[:count] for m in found[0]})
            advance(count)
    asked = np.array([skips[k] for _, k in questions])
    return {
        name: FrameScores(values={m: np.concatenate([b[m] for b in parts]) for m in parts[0]}, skips=asked)
        for name, parts in blocks.items()
    }


GOAL, EXISTS = "goal", "exists"


def answer_all(
    films: Mapping[str, VideoPredictor], mean: np.ndarray, batch: TouchBatch, t: int, k: int, skips: tuple[int, ...]
) -> dict[str, np.ndarray]:
    """Every method's frames for the question (t, skip number k), the true ones and whether they exist."""
    shape = batch.stream_mask.shape
    asked = Asked(last=jnp.full(shape, t, jnp.int32), skip=jnp.full(shape, k, jnp.int32))
    goal, exists = target_of(batch, asked, skips)
    found = {name: np.asarray(film.predict(batch, asked)) for name, film in films.items()}
    steady = np.broadcast_to(mean[:, t + skips[k]], goal.shape)
    last = np.asarray(frame_at(batch, asked.last))
    return {**found, COPY: last, MEAN: steady, GOAL: np.asarray(goal), EXISTS: np.asarray(exists)}


def batches(data: Dataset, rows: np.ndarray) -> Iterator[tuple[TouchBatch, int]]:
    """Batches of one size, and how many of their contacts count."""
    padded = rows[np.minimum(np.arange(-(-len(rows) // SCORE_BATCH) * SCORE_BATCH), len(rows) - 1)]
    clips = data.batches(padded, batch_size=SCORE_BATCH, seed=0, shuffle=False, repeat=False)
    for start, clip in zip(range(0, len(padded), SCORE_BATCH), clips, strict=True):
        yield touch_batch(clip), min(SCORE_BATCH, len(rows) - start)


def _masked(found: Mapping[str, np.ndarray], exists: np.ndarray) -> dict[str, np.ndarray]:
    return {metric: np.where(exists, x, np.nan) for metric, x in found.items()}
