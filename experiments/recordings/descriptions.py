"""Cached descriptions of the videos of a folder and of generated scenes."""

import dataclasses
import hashlib
import json
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from experiments.core import numerics
from experiments.core.context import Context
from experiments.recordings.scene_presses import PressVariant, press_pictures
from sensors_io.errors import MALFORMED, name_and_text
from sensors_io.importers.keep import ImportSourceError, Skip
from sensors_io.importers.physiclear import read_labels
from sensors_io.importers.video import VideoError
from sensors_io.scenes.cards import solid_of
from sensors_io.scenes.config import SceneConfig, config_hash
from sensors_io.schema import ATTRIBUTES
from sensors_io.schema import LEVELS as SCENE_LEVELS
from sensors_io.touches import describe, families, read_touch, touch_of_scene
from touchr1_jax.models.description_policy import LANGUAGE, LEVELS

OF_VIDEOS, OF_SCENES = 2, 1  # raised when descriptions change, so that no cache outlives it
SUFFIXES = (".mov", ".mp4", ".avi", ".mkv")  # file names that count as videos in a folder that no table lists
SceneDescriber = Callable[[SceneConfig], Float[np.ndarray, "n D"]]
ROWS = ("names", "objects", "label", "x", "rating")  # of `DescribedVideos`, one entry for each video


@dataclasses.dataclass(frozen=True, kw_only=True)
class DescribedVideos:
    """n videos: name, object, levels (−1 unknown), people's ratings of it (NaN unknown) and description of each.

    `skipped` are those that could not be read.
    """

    names: np.ndarray
    objects: np.ndarray
    label: Int[np.ndarray, "n A"]
    x: Float[np.ndarray, "n D"]
    rating: Float[np.ndarray, "n A"]
    skipped: tuple[Skip, ...] = ()

    @property
    def families(self) -> tuple[str, ...]:
        """The family of each number of a description; those of another description have none of `describe`'s."""
        own = families()
        return own if self.x.shape[1] == len(own) else ("",) * self.x.shape[1]

    def labelled(self) -> "DescribedVideos":
        """The videos whose levels are all known."""
        return self.rows(np.all(self.label >= 0, 1))

    def rows(self, chosen: np.ndarray) -> "DescribedVideos":
        """Some of the videos, by index or by mask."""
        take = {name: getattr(self, name)[chosen] for name in ROWS}
        return dataclasses.replace(self, **take)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AuxiliaryData:
    """Data without labels of real objects: touches of generated objects and unlabelled videos."""

    scene_x: Float[np.ndarray, "S n D"]
    scene_target: Float[np.ndarray, "S n T"]
    """Descriptions of S sets of scenes, and their properties: levels and material one-hot, then the logarithms of the
    physical quantities behind them, standardised.
    """
    kinds: np.ndarray  # [T], whether a property is of the levels, the material or the physics
    unlabelled: Float[np.ndarray, "m D"]  # descriptions of the videos


def describe_source(source: Path, frames: int, context: Context, objects: int | None = None) -> DescribedVideos:
    """Describe so many frames in contact of the videos of a folder that holds labels.json and videos/.

    `objects` takes so many labelled ones, the first of the table; `None` takes all, unlabelled ones too.
    `ImportSourceError` as of `read_labels` and `read_ratings`, or without one readable video; `ConfigurationError` if
    they are others than the run began with.
    """
    entries = read_labels(source / "labels.json")
    if objects is not None:
        known = [e for e in entries if all(e.card.labels[a.name] >= 0 for a in LANGUAGE.attributes)]
        entries = known[:objects]
    files = [source / "videos" / name for entry in entries for name in entry.videos]
    owner = np.array([entry.card.object_id for entry in entries for _ in entry.videos])
    levels = [[e.card.labels[a.name] for a in LANGUAGE.attributes] for e in entries for _ in e.videos]
    found = _describe_files(files, owner, np.array(levels, np.int32).reshape(len(files), -1), frames, context)
    rated = read_ratings(source / "ratings.json")
    unknown = np.full(len(LANGUAGE.attributes), np.nan)
    rating = np.array([rated.get(name, unknown) for name in found.objects]).reshape(len(found.names), -1)
    found, where = dataclasses.replace(found, rating=rating), hashlib.sha256(str(source).encode()).hexdigest()[:16]
    digest = hashlib.sha256(json.dumps([getattr(found, name).tolist() for name in ROWS]).encode()).hexdigest()[:16]
    context.require_same(f"videos/{where}", digest, f"videos, labels or ratings of {source}")
    return found


def read_ratings(path: Path) -> dict[str, Float[np.ndarray, "A"]]:
    """Ratings of objects by people, 0 to 10, NaN for an attribute that was not rated; none where there is no file."""
    if not path.is_file():
        return {}
    try:
        table = json.loads(path.read_text(encoding="utf-8"))["objects"]
        return {n: np.array([float(r.get(a.name, np.nan)) for a in LANGUAGE.attributes]) for n, r in table.items()}
    except MALFORMED as error:
        raise ImportSourceError(f"{path}: {name_and_text(error)}; correct the entry or remove the file") from error


def videos_of(places: Sequence[Path]) -> list[Path]:
    """The videos that are named, each once, a folder standing for its own; `ImportSourceError` where there is none."""
    files = []
    for place in places:
        inside = sorted(p for p in place.iterdir() if p.suffix.lower() in SUFFIXES) if place.is_dir() else [place]
        if not inside or not inside[0].is_file():
            raise ImportSourceError(f"predict is {place}: must be or hold videos ({', '.join(SUFFIXES)}); correct it")
        files += inside
    return list(dict.fromkeys(files))


def describe_files(files: Sequence[Path], frames: int, context: Context) -> DescribedVideos:
    """Describe videos without labels."""
    unknown = np.full((len(files), len(LANGUAGE.attributes)), -1, np.int32)
    return _describe_files(files, np.array([p.name for p in files]), unknown, frames, context)


def _describe_files(
    files: Sequence[Path], objects: np.ndarray, label: np.ndarray, frames: int, context: Context
) -> DescribedVideos:
    def make() -> dict[str, np.ndarray]:
        x, reasons = np.zeros((len(files), len(families())), np.float32), []
        with context.timed("descriptions"):
            for i, file in enumerate(context.each("describing touches", files)):
                try:
                    x[i] = describe(read_touch(file, frames))
                    reasons.append("")
                except VideoError as error:
                    reasons.append(str(error))
        return {"x": x, "reasons": np.array(reasons)}

    states = [(str(p.resolve()), *_state(p)) for p in files]
    cached = _cached(context, "descriptions", [OF_VIDEOS, frames, families(), states], make)
    reasons = cached["reasons"]
    read = np.flatnonzero(reasons == "")
    if not len(read):
        raise ImportSourceError(f"{files[0].parent}: no video can be read, the first {reasons[0]}; check the folder")
    skipped = tuple(Skip(name=file.name, reason=str(why)) for file, why in zip(files, reasons, strict=True) if why)
    alike = Counter(p.name for p in files)  # in several folders
    names = np.array([p.name if alike[p.name] == 1 else str(p) for p in files])
    for skip in skipped:
        context.print(f"left out: {skip.name} {skip.reason}")
    which = np.unique(cached["x"][read], axis=0, return_inverse=True)[1].ravel()
    for same in (read[which == n] for n in np.flatnonzero(np.bincount(which) > 1)):
        if len(set(objects[same])) > 1:
            context.print(f"the same video of several objects, left in: {', '.join(names[same])}")
    return DescribedVideos(
        names=names[read],
        objects=objects[read],
        label=label[read],
        x=cached["x"][read],
        rating=np.full((len(read), label.shape[1]), np.nan),
        skipped=skipped,
    )


def _state(file: Path) -> tuple[int, ...]:
    """Size and time of a file, by which another in its place is noticed; empty if there is none."""
    return (file.stat().st_size, file.stat().st_mtime_ns) if file.is_file() else ()


def auxiliary_data(
    config: SceneConfig, sets: int, every: DescribedVideos, context: Context, describe_set: SceneDescriber | None = None
) -> AuxiliaryData:
    """Describe sets of scenes that differ in their seeds, and take the videos without all levels.

    `describe_set` gives the descriptions of a set, float32 [n, D]; by default `describe_scenes`.
    """
    of = describe_set or (lambda scenes: describe_scenes(scenes, context))
    every_set = [dataclasses.replace(config, seed=config.seed + i) for i in range(sets)]
    target, kinds = zip(*(scene_properties(scenes) for scenes in every_set), strict=True)
    unlabelled = every.x[np.any(every.label < 0, 1)]
    x = np.array([of(scenes) for scenes in every_set])
    return AuxiliaryData(scene_x=x, scene_target=np.array(target), kinds=kinds[0], unlabelled=unlabelled)


def describe_scenes(config: SceneConfig, context: Context) -> Float[np.ndarray, "n D"]:
    """Generate and describe presses as a GelSight Mini sees them."""

    def make() -> dict[str, np.ndarray]:
        with context.timed("scenes"):
            return {"x": described_presses(config, variant=PressVariant(), context=context)}

    return _cached(context, "scene-descriptions", [OF_SCENES, config_hash(config), families()], make)["x"]


def described_presses(config: SceneConfig, *, variant: PressVariant, context: Context) -> Float[np.ndarray, "n D"]:
    """Descriptions of a set of presses."""
    every = context.each("generating and describing scenes", range(config.contact_count))
    return np.array([describe(touch_of_scene(press_pictures(config, i, variant))) for i in every])


def scene_properties(config: SceneConfig) -> tuple[Float[np.ndarray, "n T"], np.ndarray]:
    """Properties of the objects that are pressed, see `AuxiliaryData`, and the kind of each."""
    owner = np.repeat(np.arange(config.objects), config.sites)
    solids = [solid_of(config, i) for i in owner]
    labels = np.array([[solid.labels()[a] for a in ATTRIBUTES] for solid in solids])
    named = np.concatenate([np.eye(SCENE_LEVELS[a])[labels[:, i]] for i, a in enumerate(ATTRIBUTES)], 1)
    truth = np.log([list(solid.truth().values()) for solid in solids])
    spread = truth.std(0)
    physics = (truth - truth.mean(0)) / np.where(spread > 0, spread, 1.0)
    levels = len(LANGUAGE.attributes) * LEVELS
    kinds = ["levels"] * levels + ["material"] * (named.shape[1] - levels) + ["physics"] * physics.shape[1]
    return np.concatenate([named, physics], 1), np.array(kinds)


def _cached(
    context: Context, name: str, identity: Sequence[object], make: Callable[[], dict[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """Arrays from a file of the cache that is named by the hash of an identity and of NumPy's and OpenCV's settings."""
    digest = hashlib.sha256(json.dumps([*identity, numerics.environment()]).encode()).hexdigest()[:16]
    return context.cached_arrays(f"{name}-{digest}", make, compressed=True)
