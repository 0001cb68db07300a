"""Knowledge from generated scenes: probes of their known properties, applied to real videos.

A scene's hardness, roughness and relief are known exactly and cost nothing, while people judged only 67 real objects.
So a probe learns the properties of scenes from the same description, and what it says of a real video, few numbers that
mean something, is what the labels of real objects are then learned from.  Scenes and videos are standardised each by
their own mean and deviation: lamps, gels and hands differ, the order of touches within each world is trusted alone.
"""

import dataclasses
import hashlib
import io
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from experiments.core.artifacts import write_bytes
from experiments.core.context import Context
from experiments.recordings.descriptors import describe, families
from experiments.recordings.evidence import EvidenceConfig, kernel_ridge, standardise
from experiments.recordings.touches import touch_of_scene
from experiments.study.sources import SourceConfig, prepare_records
from sensors_io.importers.physiclear import PhysiclearConfig
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig, config_hash
from sensors_io.schema import ATTRIBUTES, LEVELS

SENSOR = "gelsight_mini"
VERSION = 1
"""Raised when a description changes, so that no cache outlives it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scenes:
    """n touches of generated objects: descriptions, and their properties one-hot, level by level."""

    x: Float[np.ndarray, "n D"]
    target: Float[np.ndarray, "n T"]


def describe_scenes(config: SceneConfig, context: Context) -> Scenes:
    """Generate and describe presses as a GelSight Mini sees them, once; both are cached."""
    identity = hashlib.sha256(json.dumps([VERSION, config_hash(config), families()]).encode()).hexdigest()[:16]
    path = context.cache_dir / f"scene-descriptions-{identity}.npz"
    if not path.exists():
        _make(config, path, context)
    with np.load(path) as cached:
        return Scenes(x=cached["x"], target=cached["target"])


def _make(config: SceneConfig, path: Path, context: Context) -> None:
    source = SourceConfig(kind="generated", directory=None, scenes=config, physiclear=PhysiclearConfig())
    store = RecordStore(prepare_records(source, context))
    x, target = [], []
    with context.progress("describing scenes", len(store)) as advance, context.timed("scenes"):
        for i, key in enumerate(store.contacts):
            frames = store.contact(i, fields=False)[SENSOR].frames
            if frames is None:
                raise ValueError(f"{key}: {SENSOR} has no camera frames: scenes must be generated with pictures")
            x.append(describe(touch_of_scene(frames)))
            target.append(_one_hot(store.objects[key.object_id].label_row()))
            advance()
    buffer = io.BytesIO()
    np.savez_compressed(buffer, x=np.array(x), target=np.array(target))
    write_bytes(path, buffer.getvalue())


def _one_hot(levels: np.ndarray) -> np.ndarray:
    return np.concatenate([np.eye(LEVELS[a])[level] for a, level in zip(ATTRIBUTES, levels, strict=True)])


def sense(
    scenes: Scenes, world: Float[np.ndarray, "m D"], x: Float[np.ndarray, "n D"], config: EvidenceConfig
) -> Float[np.ndarray, "n T"]:
    """Predictions of scene probes for videos: each level of hardness, roughness and protrusion, and each material.

    Args:
      scenes: what they learn from.
      world: descriptions of videos that say what is usual in the real world; no label is needed.
      x: descriptions of the videos asked about.
      config: scene ridge and clip.
    """
    count = len(scenes.x)
    known = np.arange(len(world) + len(x)) < len(world)
    real = standardise(np.concatenate([world, x]).astype(np.float64), known, config.clip)[len(world) :]
    made = standardise(scenes.x.astype(np.float64), np.ones(count, bool), config.clip)
    both, fit = np.concatenate([made, real]), np.arange(count + len(x)) < count
    return kernel_ridge(both, fit, np.full(count, 1 / count), scenes.target, config.scene_ridge)[count:]
