"""Which parts of a generated scene help to read real videos, and do fields read them better than pictures?

    python -m experiments sim_to_real --data-dir DIR [--calibration CAL.npz] [--scale smoke]

Probes learn hardness, roughness and protrusion from generated presses and predict them for PhysiCLeAR's videos, as in
`physiclear`, without a policy.  One part of the scene at a time is omitted, made coarser, or added; objects and places
of the presses stay the same.  With a calibration of a GelSight Mini (from `sensors_io calibrate`), depth and slopes
also replace the pictures of scenes and videos.

Partitions are the development partitions of `physiclear`; intervals over objects, paired by video.

Cost: 50 minutes of one core, 6 more with a calibration; 81 minutes in the recorded run; `--scale smoke` a minute.

Expected: lamps set by eye, no roughness, one relief and a bed of springs each cost 2 to 3 of the 5 points that scenes
are worth; fields are 3 points worse than pictures.
"""

import dataclasses
import functools
import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from experiments.core.charts import Panel, Rule, draw, estimates
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Picture, Results, Table, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds, interval
from experiments.recordings.cross_validation import (
    FORMATS,
    UNITS,
    CrossValidation,
    deal_folds,
    intervals,
    require_divisions,
    scores,
)
from experiments.recordings.descriptions import (
    DescribedVideos,
    auxiliary_data,
    describe_scenes,
    describe_source,
    described_presses,
)
from experiments.recordings.findings import JudgedAnswers, gains
from experiments.recordings.learning import LearnConfig
from experiments.recordings.scene_presses import AS_GENERATED, VARIANTS, press_pictures
from sensors_io.calibration.calibrate import calibrate
from sensors_io.calibration.generated_presses import generated_presses
from sensors_io.fields.depth import DepthReader
from sensors_io.fields.types import Calibration
from sensors_io.scenes.config import SceneConfig
from sensors_io.touches import (
    SIZE_PX,
    describe,
    describe_frames,
    families,
    frame_families,
    read_touch,
    touch_of_scene,
)
from touchr1_jax.bench.statistics import Interval

NO_SCENES = "no scenes: probes of the videos alone"
PICTURES, WITH_COURSE, FIELDS, BOTH = "pictures", "pictures and their course", "fields", "pictures and fields"
SLOPE_GREY, DEPTH_GREY = 100.0, 100.0
"""Grey levels that a slope of 1 and a depth of 1 mm count as: about what a slope of 1 changes in a picture."""

BALL_MM, BALLS = 6.31, 40  # generated presses that the scenes' pictures are calibrated by


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimToRealStudy:
    """Videos, scenes, partitions."""

    data_dir: Path | None = None  # folder with labels.json and videos/
    calibration: Path | None = None
    """Calibration of a GelSight Mini that shows the videos' window; without one no fields are read."""
    objects: int | None = None  # labelled objects to use; all by default
    frames: int = 8  # frames in contact that are described of each video
    folds: int = 10
    seeds: tuple[int, ...] = tuple(range(101, 109))  # of the partitions
    scenes: SceneConfig = SceneConfig(objects=800, sites=1)
    scene_sets: int = 2  # sets of consecutive seeds, whose probes are averaged
    learn: LearnConfig = LearnConfig()

    def __post_init__(self) -> None:
        require_divisions(self.seeds, self.folds, self.learn.evidence)


def run(config: SimToRealStudy, context: Context) -> Results:
    """Score the probes of every variant of the scenes, and of every input; `ConfigurationError` without data_dir."""
    if config.data_dir is None:
        raise ConfigurationError("data_dir is None: must be the folder of labels.json and videos/; give --data-dir")
    videos = describe_source(config.data_dir, config.frames, context, config.objects)
    parts, milliseconds = dict[str, JudgedAnswers](), dict[str, float]()
    for name, variant in context.each("parts of a scene", VARIANTS.items()):
        describe_set = functools.partial(described_presses, variant=variant, context=context)
        answer = functools.partial(timed_answers, config, videos, describe_set, context)
        found = context.once(f"scenes/{slug(name)}", answer)
        parts[name], milliseconds[name] = judged(found["log_prob"], videos), found["milliseconds"]
    own = dataclasses.replace(config.learn.evidence, families=tuple(dict.fromkeys(families())), by_attribute=())
    alone = dataclasses.replace(config, learn=dataclasses.replace(config.learn, evidence=own))
    pictured = functools.partial(describe_scenes, context=context)
    bare = functools.partial(answers, alone, videos, pictured, context)
    parts[NO_SCENES] = judged(context.once("no-scenes", bare), videos)
    inputs: dict[str, JudgedAnswers] = {}
    seconds: dict[str, float] = {}
    if config.calibration is not None:
        calibration = Calibration.load(config.calibration).at_size(SIZE_PX)
        inputs, seconds = read_inputs(config, videos, calibration, context)
        inputs = {WITH_COURSE: parts[AS_GENERATED], **inputs}
    return report(config, videos, parts, milliseconds, inputs, seconds)


def slug(name: str) -> str:
    """A name that a stage may have."""
    return "-".join(re.findall(r"\w+", name))


def answers(
    config: SimToRealStudy,
    videos: DescribedVideos,
    describe_set: Callable[[SceneConfig], Float[np.ndarray, "n D"]],
    context: Context,
) -> list[Any]:
    """Log-probabilities of the answers about all labelled videos on every partition, [P, n, 27]."""
    labelled = videos.labelled()
    auxiliary = auxiliary_data(config.scenes, config.scene_sets, videos, context, describe_set)
    rows = []
    for seed in config.seeds:
        fold = deal_folds(labelled.objects, labelled.label, config.folds, seed)
        split = CrossValidation(
            config=config.learn, videos=labelled, auxiliary=auxiliary, fold=fold, seed=seed, context=context
        )
        rows.append(split.probes().tolist())
    return rows


def timed_answers(
    config: SimToRealStudy,
    videos: DescribedVideos,
    describe_set: Callable[[SceneConfig], Float[np.ndarray, "n D"]],
    context: Context,
) -> dict[str, Any]:
    """The same, and processor milliseconds of a press, compilation and description included."""
    spent = [0.0]

    def timed(scenes: SceneConfig) -> Float[np.ndarray, "n D"]:
        start = time.process_time()
        found = describe_set(scenes)
        spent[0] += time.process_time() - start
        return found

    log_prob = answers(config, videos, timed, context)
    presses = config.scene_sets * config.scenes.contact_count
    return {"log_prob": log_prob, "milliseconds": 1e3 * spent[0] / presses}


def judged(log_prob: Sequence[Any], videos: DescribedVideos) -> JudgedAnswers:
    """Answers of probes, which are their own evidence."""
    labelled, rows = videos.labelled(), np.array(log_prob)
    return JudgedAnswers(log_prob=rows, evidence=rows, label=labelled.label, objects=labelled.objects)


def read_inputs(
    config: SimToRealStudy, videos: DescribedVideos, calibration: Calibration, context: Context
) -> tuple[dict[str, JudgedAnswers], dict[str, float]]:
    """Answers from pictures, from fields and from both, and median processor seconds to describe a video."""
    size = (config.scenes.image_px,) * 2
    balls = generated_presses(BALL_MM, BALLS, 0)
    of_scenes = calibrate(balls, tuple(map(str, range(len(balls)))), "gelsight_mini")[0].at_size(size)
    frames, sets = len(frame_families()), dict[int, np.ndarray]()
    read = context.once("fields-of-videos", functools.partial(fields_of_videos, config, videos, calibration, context))

    def pictured(scenes: SceneConfig) -> np.ndarray:
        return describe_scenes(scenes, context)[:, :frames]

    def fields(scenes: SceneConfig) -> np.ndarray:
        if scenes.seed not in sets:
            every = context.each("reading fields of scenes", range(scenes.contact_count))
            sets[scenes.seed] = np.array([fields_of_scene(scenes, i, of_scenes) for i in every])
        return sets[scenes.seed]

    def joined(scenes: SceneConfig) -> np.ndarray:
        return np.concatenate([pictured(scenes), fields(scenes)], 1)

    of_videos = np.array(read["x"], np.float32)
    seen = videos.x[:, :frames]
    variants = {
        PICTURES: (seen, pictured),
        FIELDS: (of_videos, fields),
        BOTH: (np.concatenate([seen, of_videos], 1), joined),
    }
    found = dict[str, JudgedAnswers]()
    for name, (x, describe_set) in variants.items():
        described = dataclasses.replace(videos, x=x)
        answer = functools.partial(answers, config, described, describe_set, context)
        found[name] = judged(context.once(f"inputs/{slug(name)}", answer), described)
    picture, field, course = (float(np.median(read[name])) for name in ("pictures s", "fields s", "course s"))
    return found, {WITH_COURSE: course, PICTURES: picture, FIELDS: field, BOTH: picture + field}


def fields_of_videos(
    config: SimToRealStudy, videos: DescribedVideos, calibration: Calibration, context: Context
) -> dict[str, Any]:
    """Descriptions of the fields of every video, and processor seconds of each way to describe it after decoding."""
    if config.data_dir is None:
        raise ValueError("data_dir is None: must be the folder of the videos; set it")
    rows = dict[str, list[Any]](x=[])
    for name in context.each("reading fields of videos", videos.names):
        touch = read_touch(config.data_dir / "videos" / str(name), config.frames)
        readers: dict[str, Callable[[], np.ndarray]] = {
            "fields s": functools.partial(fields_of, touch.frames, touch.rest, calibration),
            "pictures s": functools.partial(describe_frames, touch.difference),
            "course s": functools.partial(describe, touch),
        }
        made = dict[str, np.ndarray]()
        for name, make in readers.items():
            start = time.process_time()
            made[name] = make()
            rows.setdefault(name, []).append(time.process_time() - start)
        rows["x"].append(made["fields s"].tolist())
    return rows


def fields_of_scene(config: SceneConfig, index: int, calibration: Calibration) -> Float[np.ndarray, "D"]:
    """Description of the fields of a generated press, of the frames that `touch_of_scene` describes."""
    frames = press_pictures(config, index)
    return fields_of(frames[touch_of_scene(frames).position], frames[0].astype(np.float32), calibration)


def fields_of(frames: np.ndarray, rest: np.ndarray, calibration: Calibration) -> Float[np.ndarray, "D"]:
    """Description of depth and slopes as the colours of a picture; arguments as in `VideoTouch`."""
    at_rest = dataclasses.replace(calibration, background=np.clip(rest, 0, 255).round().astype(np.uint8))
    read, maps = DepthReader(at_rest), []
    for frame in frames:
        depth, _ = read(frame)
        down_y, down_x = np.gradient(depth, calibration.mm_per_px)
        field = np.stack([DEPTH_GREY * depth, SLOPE_GREY * down_x, SLOPE_GREY * down_y], -1)
        maps.append(cv2.resize(field.astype(np.float32), SIZE_PX[::-1], interpolation=cv2.INTER_LINEAR))
    return describe_frames(np.stack(maps))


def report(
    config: SimToRealStudy,
    videos: DescribedVideos,
    parts: Mapping[str, JudgedAnswers],
    milliseconds: Mapping[str, float],
    inputs: Mapping[str, JudgedAnswers],
    seconds: Mapping[str, float],
) -> Results:
    """Tables, charts and what pays."""
    lost = {name: gains(found, parts[AS_GENERATED])["mean"] for name, found in parts.items() if name != AS_GENERATED}
    changed = {name: gain for name, gain in lost.items() if name != NO_SCENES}
    pays = [f"{name} ({interval(gain, '+.1f')})" for name, gain in changed.items() if gain.high < 0]
    free = [name for name, gain in changed.items() if gain.low <= 0 <= gain.high]
    helps = [f"{name} ({interval(gain, '+.1f')})" for name, gain in changed.items() if gain.low > 0]
    verdict = [
        f"Scenes as generated are worth {interval(negative(lost[NO_SCENES]), '+.1f')} points of single levels over "
        "probes of the videos alone.",
        f"Of {len(changed)} changes, these cost accuracy: {'; '.join(pays) or 'none'}.  These gain: "
        f"{'; '.join(helps) or 'none'}.  No difference is seen for: {'; '.join(free) or 'none'}.  By chance alone one "
        "interval in twenty excludes 0.",
    ]
    tables, pictures = [part_table(parts, lost, milliseconds)], [part_picture(changed)]
    if inputs:
        gain = gains(inputs[FIELDS], inputs[PICTURES])["mean"]
        verdict.append(
            f"Fields in the place of pictures: {interval(gain, '+.1f')} points of single levels, "
            f"{seconds[FIELDS]:.2f} s of a core a video in the place of {seconds[PICTURES]:.2f}."
        )
        tables.append(input_table(inputs, seconds))
        pictures.append(input_picture(inputs, seconds))
    labelled = videos.labelled()
    return Results(
        verdict=tuple(verdict),
        tables=tuple(tables),
        pictures=tuple(pictures),
        settings={"partitions": len(config.seeds), "folds": config.folds, "sets of scenes": config.scene_sets},
        data={"objects": len(np.unique(labelled.objects)), "videos": len(labelled.names)},
    )


def negative(gain: Interval) -> Interval:
    """The gain of the other side."""
    return dataclasses.replace(gain, mean=-gain.mean, low=-gain.high, high=-gain.low)


def gain_table(
    title: str,
    found: Mapping[str, JudgedAnswers],
    gained: Mapping[str, Interval],
    cost: Mapping[str, float],
    over: str,
    *,
    of: str,
    costs: str,
    unit: str,
    spec: str,
    meaning: str,
    note: str,
) -> Table:
    """The scores of every entry, mean over the partitions, its gain over one of them, and its cost.

    `of` and `costs` are the names of the first and the last column; unit, format and meaning are of the last.
    """
    rows = []
    for name, one in found.items():
        row: dict[str, Any] = {of: name, **{k: x.mean() for k, x in scores(one.levels, one.truth).items()}}
        gain = gained.get(name)
        row["gain"] = None if gain is None else gain.mean
        row["95 %"] = None if gain is None else bounds(gain.low, gain.high, "+.1f")
        row[costs] = cost.get(name)
        rows.append(row)
    return named_table(
        title,
        rows,
        formats={**FORMATS, "gain": "+.1f", costs: spec},
        units={**UNITS, "gain": "points", costs: unit},
        meanings={
            "gain": f"of the mean over '{over}', paired by video",
            "95 %": "of the gain, over objects",
            costs: meaning,
        },
        note=note,
    )


def part_table(
    parts: Mapping[str, JudgedAnswers], lost: Mapping[str, Interval], milliseconds: Mapping[str, float]
) -> Table:
    """All variants of the scenes."""
    meaning = "processor time to generate and describe one, compilation included"
    note = "Probes alone, on the partitions that settings were chosen on."
    last: dict[str, Any] = {"costs": "a press", "unit": "ms", "spec": ".0f", "meaning": meaning}
    return gain_table("Parts of a scene", parts, lost, milliseconds, AS_GENERATED, of="scenes", **last, note=note)


def part_picture(changed: Mapping[str, Interval]) -> Picture:
    """Gain of every change."""
    series = estimates("", [*changed.values()])
    axes: dict[str, Any] = {"x_label": "gain in levels right (points)", "rows": [*changed], "rules": [Rule(x=0.0)]}
    return Picture(
        name="parts",
        title="What a part of the scene is worth on real videos",
        caption=f"Mean of the three levels against scenes '{AS_GENERATED}'; bars are 95 % intervals over objects.",
        content=draw([Panel([series], **axes)], size=(8.0, 5.0)),
    )


def input_table(inputs: Mapping[str, JudgedAnswers], seconds: Mapping[str, float]) -> Table:
    """Pictures, fields and both."""
    gained = {name: gains(found, inputs[PICTURES])["mean"] for name, found in inputs.items() if name != PICTURES}
    meaning = "median processor time to read and describe its frames after decoding"
    note = "Fields are depth and its slopes by a calibration; 'course' is how the change grows and fades."
    last: dict[str, Any] = {"costs": "a video", "unit": "s", "spec": ".2f", "meaning": meaning}
    return gain_table("Pictures and fields", inputs, gained, seconds, PICTURES, of="input", **last, note=note)


def input_picture(inputs: Mapping[str, JudgedAnswers], seconds: Mapping[str, float]) -> Picture:
    """Accuracy over cost."""
    series = [
        estimates(name, [intervals(found.levels, found.truth, found.owner)["mean"]], at=[seconds[name]], line="")
        for name, found in inputs.items()
    ]
    axes: dict[str, Any] = {"x_label": "processor time a video (s)", "y_label": "levels right (%)"}
    return Picture(
        name="inputs",
        title="Pictures or fields: accuracy against cost",
        caption="Bars are 95 % intervals over objects, not paired; the table has paired gains.",
        content=draw([Panel(series, x_limits=(0, None), better=("lower", "higher"), **axes)], size=(6.4, 3.8)),
    )


DEFAULT = SimToRealStudy()

SMOKE = dataclasses.replace(
    DEFAULT,
    objects=12,
    frames=2,
    folds=2,
    seeds=(101, 102),
    scene_sets=1,
    scenes=SceneConfig(objects=6, sites=1, image_px=28, contact_grid=24),
    learn=dataclasses.replace(DEFAULT.learn, evidence=dataclasses.replace(DEFAULT.learn.evidence, folds=2)),
)

EXPERIMENT = Experiment(name="sim_to_real", config=DEFAULT, run=run, scales={"smoke": SMOKE})
