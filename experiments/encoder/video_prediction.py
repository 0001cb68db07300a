"""How well can the next frames of a tactile sensor be predicted from those before, and does vision help?

    make experiment EXP=video_prediction [ARGS="--encoder runs/pretrain_encoder/latest"]

From the frames of a press up to t, and for one of the two predictors also the picture of the object, to the frames 3
and 5 levels of force later, in [0, 1] pixels of 112², by four sensors; scored on objects that training never used, for
every t.  Next to L1 and SSIM (11 × 11 Gaussian) the distance of a tactile encoder's features is reported; LPIPS needs
weights that may not be distributed: `--lpips-weights FILE.npz` adds it (see `touchr1_jax.bench.image_similarity`).

Cost: about nine minutes on one core, `--scale smoke` under one.

Expected: copying the last frame is poor because contacts grow; the mean frame knows the force and not the object; a
predictor must beat both.  The picture shows shape but can mislead about material, so it should help early frames a
little.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.core.pictures import image_grid
from experiments.core.results import Cell, Picture, Results, Table, at_least, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds, interval
from experiments.encoder.held_out import StageOneDataConfig, open_touch, skill, training_rows
from experiments.encoder.pretrain import ClipFeed
from experiments.encoder.video_scoring import (
    COPY,
    MEAN,
    TARGET,
    FrameMetrics,
    FrameScores,
    TrainedPredictor,
    batches,
    mean_frames,
    predict_all,
    score_frames,
)
from experiments.study import paper_numbers as paper
from experiments.study.dataset import Dataset
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.bench.image_similarity import check_weights
from touchr1_jax.bench.statistics import Interval
from touchr1_jax.models.frame_decoder import FrameDecoderConfig
from touchr1_jax.models.pretrained import PretrainedEncoder, load_encoder
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.training.feeds import touch_batch
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.training.video import VideoConfig, VideoState, every_question, make_video_step, start_video

TOUCH, VISION = "touch", "touch + vision"
SEED = 0
SHOWN = 3  # contacts in the picture


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoTrainingConfig:
    """Training of one predictor."""

    steps: int = 300
    batch_size: int = 8
    save_every: int = 100
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=200.0)


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
    data = open_touch(config.touch, config.frames, config.image_px, context)
    rows, test = training_rows(data), data.parts["test"][: config.scored]
    start = None if config.encoder is None else load_encoder(config.encoder)
    predictors = {name: train(config, name, data, rows, context, start) for name in (TOUCH, VISION)}
    metrics = frame_metrics(config, start, predictors[TOUCH])
    with context.timed("score"):
        mean = mean_frames(data, rows[: config.mean_of], context)
        scores = score_frames(predictors, mean, data, test, metrics, context)
    return report(config, data, scores, data.object_ids[test], frame_grid(predictors, mean, data, test, config))


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
    video = VideoConfig(
        encoder=dataclasses.replace(tactile, sensors=len(data.clip.sensors)),
        decoder=config.decoder,
        vision=VisionConfig(image_px=data.clip.view_px) if name == VISION else None,
        skips=config.skips,
    )
    training = config.film
    feed = ClipFeed(data.store, rows, data.clip, batch_size=training.batch_size, seed=SEED)
    optimizer = make_optimizer(training.optimizer, training.steps)
    one = next(iter(data.batches(rows[:1], batch_size=1, seed=0, repeat=False)))
    state: VideoState = jax.jit(lambda key, batch: start_video(video, optimizer, key, batch))(
        jax.random.key(SEED), touch_batch(one)
    )
    if start is not None:
        params = {**state.params, "encoder": jax.tree.map(jnp.array, start.for_sensors(data.clip.sensors).params)}
        state = dataclasses.replace(state, params=params)
    step, loop = make_video_step(video, optimizer), LoopConfig(steps=training.steps, save_every=training.save_every)
    trained = run_loop(step, state, feed, loop, context, f"film/{name.replace(' + ', '-')}/{SEED}")
    return TrainedPredictor(config=video, params=trained.params)


def frame_metrics(
    config: VideoPredictionConfig, start: PretrainedEncoder | None, predictor: TrainedPredictor
) -> FrameMetrics:
    """The metrics; features are those of the encoder to start from, otherwise of the predictor by touch alone.

    Raises:
      ValueError: the LPIPS weights do not have the published shapes.
    """
    weights = None
    if config.lpips_weights is not None:
        with np.load(config.lpips_weights) as file:
            weights = dict(file)
        check_weights(weights)
    params = predictor.params["encoder"] if start is None else start.params
    return FrameMetrics(encoder=predictor.config.encoder, params=jax.device_get(params), lpips_weights=weights)


def frame_grid(
    predictors: Mapping[str, TrainedPredictor],
    mean: np.ndarray,
    data: Dataset,
    rows: np.ndarray,
    config: VideoPredictionConfig,
) -> bytes:
    """Frames of the first test contacts by the first sensor, predicted from the first frame over the longest skip."""
    batch, _ = next(batches(data, rows))
    found = predict_all(predictors, mean, batch, 0, int(np.argmax(config.skips)), config.skips)
    first, names = np.asarray(batch.frames[:, 0, 0]) / 255.0, (*predictors, MEAN, TARGET)
    shown = {
        f"object {i + 1}": [np.clip(frame, 0, 1) for frame in (first[i], *(found[name][i, 0] for name in names))]
        for i in range(min(SHOWN, len(rows)))
    }
    return image_grid(shown, ("first frame", *names), cell_inch=1.5)


def report(
    config: VideoPredictionConfig, data: Dataset, scores: Mapping[str, FrameScores], objects: np.ndarray, grid: bytes
) -> Results:
    """Skill of each predictor and skip, tables of all metrics, a grid of frames."""
    l1 = lambda name, skip: scores[name].by_contact("l1", skip)
    skills = {
        (name, s): skill(l1(name, s), l1(COPY, s), objects) for name in (TOUCH, VISION, MEAN) for s in config.skips
    }
    longest = max(config.skips)
    vision = skill(l1(VISION, longest), l1(TOUCH, longest), objects)
    over_mean = skill(l1(TOUCH, longest), l1(MEAN, longest), objects)
    note = "lower end of the 95 % interval over objects"
    required = {f"skill of touch, {s} frames ahead": skills[TOUCH, s] for s in config.skips}
    required[f"touch over the mean frame, {longest} frames ahead"] = over_mean
    return Results(
        verdict=(
            *(
                f"{s} frames ahead, the error of touch alone is {skills[TOUCH, s].mean:.0%} below that of copying the "
                f"last frame {bounds(skills[TOUCH, s].low, skills[TOUCH, s].high, '.2f')}, that of the mean frame "
                f"{skills[MEAN, s].mean:.0%}."
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
        data=data.summary()
        | {"scored contacts": len(objects), "questions": len(every_question(config.frames, config.skips))},
    )


def score_table(
    config: VideoPredictionConfig, scores: Mapping[str, FrameScores], skills: Mapping[tuple[str, int], Interval]
) -> Table:
    """Every metric of every method and skip."""
    metrics = tuple(next(iter(scores.values())).values)
    rows: list[dict[str, Cell]] = []
    for s in config.skips:
        for name, found in scores.items():
            means = {metric: float(found.by_contact(metric, s).mean()) for metric in metrics}
            rows.append({"method": f"{name}, {s} ahead", **means, "skill": interval(skills.get((name, s)), ".3f")})
    meanings = {
        "l1": "mean absolute difference of pixels in [0, 1]",
        "ssim": "structural similarity, 11 × 11 Gaussian window, higher is better",
        "encoder_distance": "mean absolute difference of a tactile encoder's patch tokens; no published metric",
        "lpips": "AlexNet, with the given weights",
    }
    return named_table(
        "Scores on unseen objects",
        rows,
        formats=dict.fromkeys(metrics, ".4f"),
        meanings={metric: meanings[metric] for metric in metrics}
        | {"skill": "1 − L1 / L1 of copying the last frame, 95 % interval over objects"},
    )


def paper_table(config: VideoPredictionConfig, scores: Mapping[str, FrameScores]) -> Table:
    """The predictors and baselines, and the paper's rows for its own recordings."""
    columns = {"l1": "L1", "ssim": "SSIM", "lpips": "LPIPS"}
    rows: list[dict[str, Cell]] = []
    for s in config.skips:
        for name, found in scores.items():
            means = {columns[m]: float(found.by_contact(m, s).mean()) for m in columns if m in found.values}
            rows.append({"method": f"{name}, {s} ahead", **means})
    for (name, s, inputs), values in paper.VIDEO.items():
        cells = dict(zip(columns.values(), values, strict=True))
        rows.append({"method": f"{name}: {inputs}, {s} ahead (paper)", **cells})
    return named_table(
        "Beside the paper",
        rows,
        formats=dict.fromkeys(columns.values(), ".3f"),
        meanings={"LPIPS": "only with weights given by the user"},
        note="Differences: generated presses of 8 frames here, recorded press-and-slide videos there; no pretrained "
        "weights here. The paper does not give the scale of its L1. A grey picture differs by at most .5 from pixels "
        "in [0, 1], so its figures, .608 to .861, cannot be means of absolute differences on that scale. It has no row "
        "for copying the last frame or for a mean frame.",
    )


def sensor_table(config: VideoPredictionConfig, data: Dataset, scores: Mapping[str, FrameScores]) -> Table:
    """L1 by sensor."""
    columns = {f"{name}, {s}": scores[name].by_sensor("l1", s) for s in config.skips for name in (TOUCH, COPY, MEAN)}
    rows: list[dict[str, Cell]] = [
        {"sensor": sensor} | {name: float(values[i]) for name, values in columns.items()}
        for i, sensor in enumerate(data.clip.sensors)
    ]
    return named_table("L1 by sensor", rows, formats=dict.fromkeys(columns, ".4f"))


DEFAULT = VideoPredictionConfig()
SMOKE = VideoPredictionConfig(
    touch=StageOneDataConfig(scenes=SceneConfig(objects=60, sites=1, seed=1)),
    film=VideoTrainingConfig(steps=4, batch_size=2),
    scored=8,
    mean_of=16,
)

EXPERIMENT = Experiment(name="video_prediction", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
