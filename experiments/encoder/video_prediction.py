"""How well can the frames that a tactile sensor will see be predicted from those that it saw, and does sight help?

    make experiment EXP=video_prediction [ARGS="--encoder runs/pretrain_encoder/latest"]

From the frames of a press up to t, and for one of the two predictors also the picture of the object, to the frame 3 and
5 levels of force later, in [0, 1] pixels of 112², by four sensors; scored on objects that training never saw, every t.
Beside L1 and SSIM (11 × 11 Gaussian) stands the distance of a tactile encoder's features; LPIPS needs weights that
nobody may ship: `--lpips-weights FILE.npz` adds it (see `touchr1_jax.bench.image_similarity`).

Cost: about nine minutes on one core, `--scale smoke` under one.

Expected: copying the last frame is poor because contacts grow; the mean frame knows the force and not the object; a
predictor must beat both.  The picture shows shape but lies about material, so it should help early frames a little.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.encoder.data import StageOneDataConfig, open_touch, training_rows
from experiments.encoder.intervals import skill
from experiments.encoder.video_scores import (
    COPY,
    MEAN,
    FrameMetrics,
    FrameScores,
    VideoPredictor,
    answer_all,
    batches,
    judged,
    mean_frames,
)
from experiments.encoder.video_strip import FrameStrip, video_strip
from experiments.encoder.video_training import VideoTrainingConfig, train_predictor
from experiments.study import paper_numbers as paper
from experiments.study.dataset import Dataset
from experiments.study.pretrained import PretrainedEncoder, load_encoder
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.bench.image_similarity import check_weights
from touchr1_jax.bench.statistics import Interval
from touchr1_jax.models.frame_decoder import FrameDecoderConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.training.video import VideoConfig, every_question

TOUCH, SIGHT = "touch", "touch + vision"
SEED = 0
SHOWN = 3  # contacts in the picture


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoPredictionConfig:
    """Data, networks, training; how many test contacts are scored and how many training ones make the mean frame."""

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
    films = {name: train(config, name, data, rows, context, start) for name in (TOUCH, SIGHT)}
    judge = make_judge(config, start, films[TOUCH])
    with context.timed("score"):
        mean = mean_frames(data, rows[: config.mean_of], context)
        scores = judged(films, mean, data, test, judge, context)
    strips = show(films, mean, data, test, config)
    return findings(config, data, scores, data.object_ids[test], strips)


def train(
    config: VideoPredictionConfig,
    name: str,
    data: Dataset,
    rows: np.ndarray,
    context: Context,
    start: PretrainedEncoder | None,
) -> VideoPredictor:
    """One predictor; the encoder has the shape of the one that it starts from."""
    tactile = config.tactile if start is None else start.config
    video = VideoConfig(
        encoder=dataclasses.replace(tactile, sensors=len(data.clip.sensors)),
        decoder=config.decoder,
        vision=VisionConfig(image_px=data.clip.view_px) if name == SIGHT else None,
        skips=config.skips,
    )
    stage = f"film/{name.replace(' + ', '-')}/{SEED}"
    params = train_predictor(video, config.film, data, rows, context, stage=stage, seed=SEED, start=start)
    return VideoPredictor(config=video, params=params)


def make_judge(config: VideoPredictionConfig, start: PretrainedEncoder | None, film: VideoPredictor) -> FrameMetrics:
    """The metrics; features are those of the encoder that training starts from, else of the predictor by touch alone.

    Raises:
      ValueError: the LPIPS weights are not the published ones in shape.
    """
    weights = None
    if config.lpips_weights is not None:
        with np.load(config.lpips_weights) as file:
            weights = dict(file)
        check_weights(weights)
    params = film.params["encoder"] if start is None else start.params
    return FrameMetrics(encoder=film.config.encoder, params=jax.device_get(params), lpips_weights=weights)


def show(
    films: Mapping[str, VideoPredictor],
    mean: np.ndarray,
    data: Dataset,
    rows: np.ndarray,
    config: VideoPredictionConfig,
) -> list[FrameStrip]:
    """Frames of the first test contacts by the first sensor, predicted from the first frame over the longest skip."""
    batch, _ = next(batches(data, rows))
    k = int(np.argmax(config.skips))
    answers = answer_all(films, mean, batch, 0, k, config.skips)
    first = np.asarray(batch.frames[:, 0, 0]) / 255.0
    names = (*films, MEAN, "goal")
    return [
        FrameStrip(title=f"object {i + 1}", frames={"seen": first[i], **{n: answers[n][i, 0] for n in names}})
        for i in range(min(SHOWN, len(rows)))
    ]


def findings(
    config: VideoPredictionConfig,
    data: Dataset,
    scores: Mapping[str, FrameScores],
    objects: np.ndarray,
    strips: list[FrameStrip],
) -> Results:
    """Skill of each predictor and skip, table of all metrics, a strip of frames."""
    skills = {
        (name, s): skill(scores[name].of("l1", s), scores[COPY].of("l1", s), objects)
        for name in (TOUCH, SIGHT, MEAN)
        for s in config.skips
    }
    longest = max(config.skips)
    sight = skill(scores[SIGHT].of("l1", longest), scores[TOUCH].of("l1", longest), objects)
    over_mean = skill(scores[TOUCH].of("l1", longest), scores[MEAN].of("l1", longest), objects)
    return Results(
        verdict=(
            *(
                f"{s} frames ahead, touch alone errs {skills[TOUCH, s].mean:.0%} less than copying the last frame "
                f"[{skills[TOUCH, s].low:.2f}, {skills[TOUCH, s].high:.2f}]; the mean frame does so by "
                f"{skills[MEAN, s].mean:.0%}."
                for s in config.skips
            ),
            f"Seeing the object takes {sight.mean:.1%} off the error {longest} frames ahead "
            f"[{sight.low:.3f}, {sight.high:.3f}].",
        ),
        requirements=(
            *(
                Requirement(
                    name=f"skill of touch, {s} frames ahead",
                    measured=skills[TOUCH, s].low,
                    bound=0.0,
                    better="higher",
                    note="lower end of the 95 % interval over objects",
                )
                for s in config.skips
            ),
            Requirement(
                name=f"touch over the mean frame, {longest} frames ahead",
                measured=over_mean.low,
                bound=0.0,
                better="higher",
                note="lower end of the 95 % interval over objects",
            ),
        ),
        tables=(_table(config, scores, skills), _beside_table(config, scores), _sensor_table(config, data, scores)),
        pictures=(
            Picture(
                name="film_strip",
                title=f"From the first frame to the one {longest} later",
                caption="GelSight Mini, unseen objects: what is seen, what is predicted, what came.",
                content=video_strip(strips),
                kind="png",
            ),
        ),
        data=data.summary()
        | {"scored contacts": len(objects), "questions": len(every_question(config.frames, config.skips))},
    )


def _table(
    config: VideoPredictionConfig, scores: Mapping[str, FrameScores], skills: Mapping[tuple[str, int], Interval]
) -> Table:
    metrics = tuple(next(iter(scores.values())).values)
    rows: list[tuple[Cell, ...]] = []
    for s in config.skips:
        for name, found in scores.items():
            x = skills.get((name, s))
            span = "–" if x is None else f"{x.mean:.3f} [{x.low:.3f}, {x.high:.3f}]"
            rows.append((f"{name}, {s} ahead", *(float(found.of(m, s).mean()) for m in metrics), span))
    return Table(
        title="Scores on unseen objects",
        columns=(
            Column(name="method"),
            *(Column(name=m, format=".4f", meaning=MEANINGS[m]) for m in metrics),
            Column(name="skill", meaning="1 − L1 / L1 of copying the last frame, 95 % interval over objects"),
        ),
        rows=tuple(rows),
    )


def _beside_table(config: VideoPredictionConfig, scores: Mapping[str, FrameScores]) -> Table:
    """The predictors and what costs nothing, beside the paper's rows for its own recordings."""
    metrics = ("l1", "ssim", "lpips")

    def line(name: str, s: int, found: FrameScores) -> tuple[Cell, ...]:
        return f"{name}, {s} ahead", *(float(found.of(m, s).mean()) if m in found.values else None for m in metrics)

    ours = [line(name, s, found) for s in config.skips for name, found in scores.items()]
    theirs: list[tuple[Cell, ...]] = [
        (f"{name}: {way}, {s} ahead (paper)", *values) for (name, s, way), values in paper.VIDEO.items()
    ]
    return Table(
        title="Beside the paper",
        columns=(
            Column(name="method"),
            Column(name="L1", format=".3f"),
            Column(name="SSIM", format=".3f"),
            Column(name="LPIPS", format=".3f", meaning="only with weights given by the user"),
        ),
        rows=(*ours, *theirs),
        note="What differs: generated presses of 8 frames here, recorded press-and-slide videos there; no pretrained "
        "weights here. The paper does not give the scale of its L1. A grey picture is nowhere further than .5 from "
        "pixels in [0, 1], so its figures, .608 to .861, cannot be means of absolute differences on that scale. It has "
        "no row for copying the last frame or for a mean frame.",
    )


MEANINGS = {
    "l1": "mean absolute difference of pixels in [0, 1]",
    "ssim": "structural similarity, 11 × 11 Gaussian window, higher is better",
    "encoder_distance": "mean absolute difference of a tactile encoder's patch tokens; no published metric",
    "lpips": "AlexNet, by the weights that were given",
}


def _sensor_table(config: VideoPredictionConfig, data: Dataset, scores: Mapping[str, FrameScores]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (sensor, *(float(scores[name].by_sensor("l1", s)[i]) for s in config.skips for name in (TOUCH, COPY, MEAN)))
        for i, sensor in enumerate(data.clip.sensors)
    ]
    return Table(
        title="L1 by sensor",
        columns=(
            Column(name="sensor"),
            *(Column(name=f"{name}, {s}", format=".4f") for s in config.skips for name in (TOUCH, COPY, MEAN)),
        ),
        rows=tuple(rows),
    )


DEFAULT = VideoPredictionConfig()
SMOKE = VideoPredictionConfig(
    touch=StageOneDataConfig(scenes=SceneConfig(objects=60, sites=1, seed=1)),
    film=VideoTrainingConfig(steps=4, batch_size=2),
    scored=8,
    mean_of=16,
)

EXPERIMENT = Experiment(name="video_prediction", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
