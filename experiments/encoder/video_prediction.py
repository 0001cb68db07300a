"""How well can the next frames of a tactile sensor be predicted from the earlier ones, and does vision help?

    make experiment EXP=video_prediction [ARGS="--encoder runs/pretrain_encoder/latest"]

Two predictors read the frames of a press up to t, one of them also the picture of the object.  They predict the frames
3 and 5 levels of force later, in [0, 1] pixels of 112², for four sensors and every t, on objects unseen in training.
Scores are L1, SSIM (11 × 11 Gaussian) and the distance of a tactile encoder's features.  LPIPS needs weights that may
not be distributed: `--lpips-weights FILE.npz` adds it (see `touchr1_jax.bench.image_similarity`).

Cost: 16 minutes in the recorded run on one core, `--scale smoke` under one.

Expected: copying the last frame is poor because contacts grow; the mean frame contains the force and not the object; a
predictor must be better than both.  The picture shows shape but can mislead about material, so it should help early
frames a little.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.core.pictures import image_grid
from experiments.core.results import Cell, Picture, Results, Table, at_least, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds, interval
from experiments.encoder.pretrain import ClipFeed, StageOneDataConfig, open_touch, padded
from experiments.study import paper_numbers as paper
from experiments.study.dataset import Dataset
from experiments.study.training import require_encoder
from sensors_io.arrays import load_arrays
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.bench.image_similarity import check_weights, lpips, ssim
from touchr1_jax.bench.statistics import Interval, skill
from touchr1_jax.models.frame_decoder import FrameDecoderConfig
from touchr1_jax.models.predictor import layer_norm
from touchr1_jax.models.pretrained import PretrainedEncoder, load_encoder
from touchr1_jax.models.tactile_vit import TactileViT, TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.training import video
from touchr1_jax.training.feeds import touch_batch
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.types import Params, TouchBatch

TOUCH, VISION = "touch", "touch + vision"
COPY, MEAN = "copy last", "mean frame"
"""The baselines: the last visible frame, and the mean training frame of that sensor at that position."""

TARGET, EXISTS = "true frame", "exists"

SEED = 0
SHOWN = 3  # contacts in the picture
SCORE_BATCH = 8  # contacts that are scored at once; a clip of 8 frames by four sensors is 1.2 MB
OPTIMIZER = OptimizerConfig(learning_rate=1e-5, lr_scale=200.0)

METRICS = {
    "L1": "mean absolute difference of pixels in [0, 1]",
    "SSIM": "structural similarity, 11 × 11 Gaussian window, higher is better",
    "encoder distance": "mean absolute difference of a tactile encoder's patch tokens; no published metric",
    "LPIPS": "AlexNet, with the given weights",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoTrainingConfig:
    """Training of one predictor."""

    steps: int = 300
    batch_size: int = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoPredictionConfig:
    """Data, networks, training; `scored` test contacts are scored, `mean_of` training contacts make the mean frame."""

    touch: StageOneDataConfig = StageOneDataConfig()
    encoder: Path | None = None
    """Run of `pretrain_encoder` to start from; from scratch without."""
    lpips_weights: Path | None = None
    frames: int = 8
    image_px: int = 112
    skips: tuple[int, ...] = (3, 5)
    tactile: TactileViTConfig = TactileViTConfig(sensors=0, causal=True)
    decoder: FrameDecoderConfig = FrameDecoderConfig()
    film: VideoTrainingConfig = VideoTrainingConfig()
    scored: int = 120
    mean_of: int = 320


def run(config: VideoPredictionConfig, context: Context) -> Results:
    """Train both predictors, score them and the baselines."""
    require_encoder(config.encoder, context)
    data = open_touch(config.touch, config.frames, config.image_px, context)
    rows, test = data.training, data.parts["test"][: config.scored]
    start = None if config.encoder is None else load_encoder(config.encoder)
    predictors = {name: train(config, name, data, rows, context, start) for name in (TOUCH, VISION)}
    params = jax.device_get(predictors[TOUCH].params["encoder"] if start is None else start.params)
    metrics = frame_metrics(predictors[TOUCH].config.encoder, params, config.lpips_weights)
    with context.timed("score"):
        mean = mean_frames(data, rows[: config.mean_of], context)
        methods = FrameMethods(predictors=predictors, mean=mean, skips=config.skips)
        scores = score_frames(methods, data, test, metrics, context)
    return report(config, data, scores, data.object_ids[test], frame_grid(methods, data, test))


class TrainedPredictor(NamedTuple):
    """A trained video predictor; `predict` gives frames clipped to [0, 1]."""

    config: video.VideoConfig
    params: Params
    predict: Callable[[TouchBatch, video.Asked], Any]


def train(
    config: VideoPredictionConfig,
    name: str,
    data: Dataset,
    rows: np.ndarray,
    context: Context,
    start: PretrainedEncoder | None,
) -> TrainedPredictor:
    """Train one predictor, its encoder of the shape of `start` if given; a stopped stage resumes."""
    tactile = config.tactile if start is None else start.config
    networks = video.VideoConfig(
        encoder=dataclasses.replace(tactile, sensors=len(data.clip.sensors)),
        decoder=config.decoder,
        vision=VisionConfig(image_px=data.clip.view_px) if name == VISION else None,
        skips=config.skips,
    )
    feed = ClipFeed(data.store, rows, data.clip, batch_size=config.film.batch_size, seed=SEED)
    optimizer = make_optimizer(OPTIMIZER, config.film.steps)
    one = touch_batch(next(iter(data.batches(rows[:1], batch_size=1, seed=0, repeat=False))))
    begin = jax.jit(lambda key, batch: video.start_video(networks, optimizer, key, batch))
    state = begin(jax.random.key(SEED), one)
    if start is not None:
        params = {**state.params, "encoder": jax.tree.map(jnp.array, start.for_sensors(data.clip.sensors).params)}
        state = dataclasses.replace(state, params=params)
    step, loop = video.make_video_step(networks, optimizer), LoopConfig(steps=config.film.steps, save_every=100)
    trained = run_loop(step, state, feed, loop, context, f"film/{name.replace(' + ', '-')}/{SEED}")
    predict = jax.jit(lambda p, b, a: jnp.clip(video.predict_frames(networks, p, b, a), 0.0, 1.0))
    return TrainedPredictor(networks, trained.params, functools.partial(predict, trained.params))


FrameMetrics = Callable[[np.ndarray, np.ndarray, TouchBatch], dict[str, np.ndarray]]
"""From predicted and true frames [P, S, H, W, 3] in [0, 1] and their batch to metric → [P, S]."""


def frame_metrics(encoder: TactileViTConfig, params: Params, lpips_weights: Path | None) -> FrameMetrics:
    """L1, SSIM, distance of an encoder's features, and LPIPS by weights of the published shapes, if given.

    The distance is the mean |LN f(x̂) − LN f(x)| over the patch tokens of the second frame of the pair (first frame,
    frame).
    """
    network = TactileViT(encoder)

    def tokens(params: Params, frame: Any, batch: TouchBatch) -> Any:
        pair = 255.0 * jnp.stack([video.unit_pixels(batch.frames[:, :, 0]), frame], 2)
        index = jnp.broadcast_to(jnp.arange(2), pair.shape[:3])
        sensors = jnp.broadcast_to(jnp.arange(pair.shape[1]), pair.shape[:2])
        streams = (pair, jnp.zeros((*index.shape, 3)), index, jnp.ones(index.shape, bool), sensors)
        encoded: Any = network.apply({"params": params}, *streams, method=TactileViT.encode)
        return layer_norm(encoded.patches[:, :, 1])

    distance = jax.jit(lambda p, a, b, batch: jnp.abs(tokens(p, a, batch) - tokens(p, b, batch)).mean((-2, -1)))
    weights = {} if lpips_weights is None else load_arrays(lpips_weights)
    if weights:
        check_weights(weights)
    perceptual = jax.jit(lambda a, b: lpips(a, b, weights))

    def score(predicted: np.ndarray, target: np.ndarray, batch: TouchBatch) -> dict[str, np.ndarray]:
        found = {
            "L1": np.abs(predicted - target).mean((-3, -2, -1)),
            "SSIM": ssim(predicted, target),
            "encoder distance": np.asarray(distance(params, predicted, target, batch)),
        }
        if weights:
            flat = lambda x: jnp.asarray(x).reshape(-1, *x.shape[-3:])
            found["LPIPS"] = np.asarray(perceptual(flat(predicted), flat(target))).reshape(predicted.shape[:2])
        return found

    return score


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameScores:
    """Scores of one method: metric → [contact, S, question], NaN where a stream or frame is missing.

    Question q asks for the frame `skips[q]` frames ahead.
    """

    values: Mapping[str, np.ndarray]
    skips: np.ndarray

    def mean(self, metric: str, skip: int, axis: int) -> np.ndarray:
        """Mean over the questions of one skip and over the contacts, axis 0, or the sensors, axis 1."""
        return np.asarray(np.nanmean(self.values[metric][:, :, self.skips == skip], (axis, 2)))


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameMethods:
    """The predictors, all of the same skips, and the baselines; `mean` is that of `mean_frames`."""

    predictors: Mapping[str, TrainedPredictor]
    mean: np.ndarray
    skips: tuple[int, ...]

    def frames(self, batch: TouchBatch, t: int, k: int) -> dict[str, np.ndarray]:
        """Every method's frames `skips[k]` ahead of frame t, the true frames (`TARGET`) and whether they exist."""
        shape = batch.stream_mask.shape
        asked = video.Asked(last=jnp.full(shape, t, jnp.int32), skip=jnp.full(shape, k, jnp.int32))
        target, exists = video.target_of(batch, asked, self.skips)
        return {
            **{name: np.asarray(predictor.predict(batch, asked)) for name, predictor in self.predictors.items()},
            COPY: np.asarray(video.frame_at(batch, asked.last)),
            MEAN: np.broadcast_to(self.mean[:, t + self.skips[k]], target.shape),
            TARGET: np.asarray(target),
            EXISTS: np.asarray(exists),
        }


def score_frames(
    methods: FrameMethods, data: Dataset, rows: np.ndarray, metrics: FrameMetrics, context: Context
) -> dict[str, FrameScores]:
    """Scores of every method on some contacts, for every question."""
    questions = video.every_question(data.clip.frames, methods.skips)
    blocks: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in (*methods.predictors, COPY, MEAN)}
    with context.progress("scoring", len(rows)) as advance:
        for batch, count in batches(data, rows):
            frames = [methods.frames(batch, t, k) for t, k in questions]
            for name, parts in blocks.items():
                found = [(metrics(one[name], one[TARGET], batch), one[EXISTS]) for one in frames]
                known = {m: [np.where(exists, s[m], np.nan) for s, exists in found] for m in found[0][0]}
                parts.append({m: np.stack(values, -1)[:count] for m, values in known.items()})
            advance(count)
    skip_of = np.array([methods.skips[k] for _, k in questions])
    return {
        name: FrameScores(values={m: np.concatenate([b[m] for b in parts]) for m in parts[0]}, skips=skip_of)
        for name, parts in blocks.items()
    }


def batches(data: Dataset, rows: np.ndarray) -> Iterator[tuple[TouchBatch, int]]:
    """Batches of one size, the last one padded, and the number of their contacts that count."""
    whole = padded(rows, SCORE_BATCH)
    clips = data.batches(whole, batch_size=SCORE_BATCH, seed=0, shuffle=False, repeat=False)
    for start, clip in zip(range(0, len(whole), SCORE_BATCH), clips, strict=True):
        yield touch_batch(clip), min(SCORE_BATCH, len(rows) - start)


def frame_grid(methods: FrameMethods, data: Dataset, rows: np.ndarray) -> bytes:
    """Frames of the first test contacts by the first sensor, predicted from the first frame over the longest skip."""
    batch, _ = next(batches(data, rows))
    found = methods.frames(batch, 0, int(np.argmax(methods.skips)))
    first, names = np.asarray(batch.frames[:, 0, 0]) / 255.0, (*methods.predictors, MEAN, TARGET)
    shown = {
        f"object {i + 1}": [np.clip(frame, 0, 1) for frame in (first[i], *(found[name][i, 0] for name in names))]
        for i in range(min(SHOWN, len(rows)))
    }
    return image_grid(shown, ("first frame", *names), cell_inch=1.5)


def report(
    config: VideoPredictionConfig, data: Dataset, scores: Mapping[str, FrameScores], objects: np.ndarray, grid: bytes
) -> Results:
    """Skill of each predictor and skip, tables of all metrics, a grid of frames."""
    l1 = lambda name, skip: scores[name].mean("L1", skip, 1)
    skills = {
        (name, s): skill(l1(name, s), l1(COPY, s), objects) for name in (TOUCH, VISION, MEAN) for s in config.skips
    }
    longest = max(config.skips)
    vision = skill(l1(VISION, longest), l1(TOUCH, longest), objects)
    note = "lower end of the 95 % interval over objects"
    questions = len(video.every_question(config.frames, config.skips))
    required = {f"skill of touch, {s} frames ahead": skills[TOUCH, s] for s in config.skips}
    over_mean = f"touch over the mean frame, {longest} frames ahead"
    required[over_mean] = skill(l1(TOUCH, longest), l1(MEAN, longest), objects)
    return Results(
        verdict=(
            *(
                f"{s} frames ahead, touch alone has a skill of {interval(skills[TOUCH, s], '.2f')} over copying the "
                f"last frame, the mean frame one of {skills[MEAN, s].mean:.2f}."
                for s in config.skips
            ),
            f"The picture of the object reduces the error {longest} frames ahead by {vision.mean:.1%} "
            f"{bounds(vision.low, vision.high, '.3f')}.",
        ),
        requirements=tuple(at_least(name, found.low, 0.0, note=note) for name, found in required.items()),
        tables=(score_table(config, scores, skills), paper_table(config, scores), sensor_table(config, data, scores)),
        pictures=(
            Picture(
                name="film_strip",
                title=f"From the first frame to the one {longest} later",
                caption="GelSight Mini, unseen objects: the first frame, the predictions, the true frame.",
                content=grid,
                kind="png",
            ),
        ),
        data={**data.summary(), "scored contacts": len(objects), "questions": questions},
    )


def score_table(
    config: VideoPredictionConfig, scores: Mapping[str, FrameScores], skills: Mapping[tuple[str, int], Interval]
) -> Table:
    """Every metric of every method and skip."""
    metrics = [metric for metric in METRICS if metric in next(iter(scores.values())).values]
    return named_table(
        "Scores on unseen objects",
        [
            {
                "method": f"{name}, {s} ahead",
                **{metric: float(found.mean(metric, s, 1).mean()) for metric in metrics},
                "skill": interval(skills.get((name, s)), ".3f"),
            }
            for s in config.skips
            for name, found in scores.items()
        ],
        formats=dict.fromkeys(metrics, ".4f"),
        meanings={metric: METRICS[metric] for metric in metrics}
        | {"skill": "1 − L1 / L1 of copying the last frame, 95 % interval over objects"},
    )


def paper_table(config: VideoPredictionConfig, scores: Mapping[str, FrameScores]) -> Table:
    """The predictors and baselines, and the paper's rows for its own recordings."""
    columns = ("L1", "SSIM", "LPIPS")
    means = lambda found, s: {c: float(found.mean(c, s, 1).mean()) for c in columns if c in found.values}
    rows: list[dict[str, Cell]] = [
        {"method": f"{name}, {s} ahead", **means(found, s)} for s in config.skips for name, found in scores.items()
    ]
    for (name, s, inputs), values in paper.VIDEO.items():
        cells = dict(zip(columns, values, strict=True))
        rows.append({"method": f"{name.replace('Ours', 'Touch-R1')}: {inputs}, {s} ahead (paper)", **cells})
    return named_table(
        "Comparison with the paper",
        rows,
        formats=dict.fromkeys(columns, ".3f"),
        meanings={"LPIPS": "only with weights given by the user"},
        note="Generated presses of 8 frames here, recorded press-and-slide videos there; no pretrained weights here. "
        "The paper does not give the scale of its L1: a grey picture differs by at most 0.5 from pixels in [0, 1], so "
        "0.608 to 0.861 cannot be means of absolute differences on that scale. It has no row for copying the last "
        "frame or for a mean frame.",
    )


def sensor_table(config: VideoPredictionConfig, data: Dataset, scores: Mapping[str, FrameScores]) -> Table:
    """L1 by sensor."""
    columns = {f"{name}, {s}": scores[name].mean("L1", s, 0) for s in config.skips for name in (TOUCH, COPY, MEAN)}
    rows = [
        {"sensor": sensor, **{name: float(values[i]) for name, values in columns.items()}}
        for i, sensor in enumerate(data.clip.sensors)
    ]
    return named_table("L1 by sensor", rows, formats=dict.fromkeys(columns, ".4f"))


SMOKE = VideoPredictionConfig(
    touch=StageOneDataConfig(scenes=SceneConfig(objects=60, sites=1, seed=1)),
    film=VideoTrainingConfig(steps=4, batch_size=2),
    scored=8,
    mean_of=16,
)

EXPERIMENT = Experiment(name="video_prediction", config=VideoPredictionConfig(), scales={"smoke": SMOKE}, run=run)
