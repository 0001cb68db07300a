"""The objects of a generated data set: their cards, splits, ids and where on their view a sensor touches."""

import functools

import numpy as np

from sensors_io.scenes import appearance, objects
from sensors_io.scenes.config import SceneConfig, stream
from sensors_io.scenes.sensors import MODELS, SensorModel
from sensors_io.schema import ObjectCard


def object_cards(config: SceneConfig) -> list[ObjectCard]:
    """Cards of all objects: view, labels, physical truth, split.  Splits are by object, exact in size."""
    splits = _splits(config)
    return [_card(config, index, split) for index, split in enumerate(splits)]


@functools.lru_cache(maxsize=32)
def solid_of(config: SceneConfig, index: int) -> objects.Solid:
    """Object number `index`."""
    return objects.sample(
        stream(config.seed, "object", index),
        config.visual_lie_share,
        shortest_wave_mm(config),
        config.part_share,
        config.graded_share,
    )


def shortest_wave_mm(config: SceneConfig) -> float:
    """Shortest wave of the roughness: 2.5 pixels of the coarsest contact grid."""
    return max(0.8, 2.5 * max(m.window_mm for m in MODELS) / config.contact_grid)


def object_id(index: int) -> str:
    """Id of object number `index`."""
    return f"g{index:06d}"


def region_px(config: SceneConfig, sensor: SensorModel, site: np.ndarray) -> tuple[int, int, int, int]:
    """The sensing window on the view, clipped to it: x, y, width, height."""
    scale = config.view_px / appearance.VIEW_MM
    low = np.round(np.clip(config.view_px / 2 + (site - sensor.window_mm / 2) * scale, 0, config.view_px - 1)).astype(
        int
    )
    side = max(1, round(sensor.window_mm * scale))
    width, height = np.minimum(side, config.view_px - low)
    return int(low[0]), int(low[1]), int(width), int(height)


def _card(config: SceneConfig, index: int, split: str) -> ObjectCard:
    solid = solid_of(config, index)
    picture, depth = appearance.view(solid.looks_like, config.view_px, stream(config.seed, "view", index))
    return ObjectCard(
        object_id=object_id(index),
        split=split,
        labels=solid.labels(),
        annotator="generator",
        view=picture,
        view_depth_mm=depth,
        visual_lies=solid.looks_like != solid.material,
        truth=solid.truth(),
        name=f"generated object {index}",
    )


def _splits(config: SceneConfig) -> list[str]:
    train, val, _ = config.split_shares
    edges = np.round(np.cumsum([train, val]) * config.objects).astype(int)
    names = np.array(["test"] * config.objects, dtype=object)
    order = stream(config.seed, "split").permutation(config.objects)
    names[order[: edges[0]]] = "train"
    names[order[edges[0] : edges[1]]] = "val"
    return list(names)
