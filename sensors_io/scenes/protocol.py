"""The generated data set: which objects there are, how each is pressed, and the records that come of it.

Every object is pressed at `sites` places, at each by all four sensors, 0→20 N.  Contact i depends on (config, i) alone,
so that generation may stop and go on anywhere.  Small strain is assumed; frames beyond it are flagged, not removed.
"""

import collections
import concurrent.futures
import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sensors_io.scenes import appearance, objects, optics, surface
from sensors_io.scenes.config import GENERATOR, SceneConfig, require, stream
from sensors_io.scenes.press import Grid, Press, Recording, Unit, draw_noise, make_kernels, record
from sensors_io.scenes.sensors import MODELS, SensorModel
from sensors_io.schema import ContactKey, Flag, ObjectCard, Sequence

UNITS = 3
"""Physical units of every sensor type."""

LOAD = 1
"""Phase of every frame of a press: loading."""

_STRAIN_LIMIT = 0.3  # of the gel's thickness, past which small strain is off by more than the label noise
_FORCE_LEAD_NS = 2_000_000  # the force sensor is read 2 ms before the picture arrives
_WORKERS = 2
_LOOKAHEAD = 3  # contacts in flight


def object_cards(config: SceneConfig) -> list[ObjectCard]:
    """Cards of all objects: view, labels, physical truth, split.  Splits are by object, exact in size."""
    splits = _splits(config)
    return [_card(config, index, split) for index, split in enumerate(splits)]


def contacts(config: SceneConfig, start: int = 0) -> Iterator[list[Sequence]]:
    """Generate contacts in order, from contact `start` on.

    Contact i is object i // sites at site i % sites; each item holds one sequence per sensor, in the order of
    `schema.SENSORS`.  Two contacts are made at a time, on two threads; the order and the values do not depend on it.

    Raises:
      ValueError: a start outside the data set.
    """
    require(0 <= start <= config.contact_count, "start", start, f"must lie in [0, {config.contact_count}]")
    return _in_order(config, start)


def make_contact(config: SceneConfig, index: int) -> list[Sequence]:
    """Contact `index`: the same patch of the same object, pressed by every sensor in turn."""
    return [_press(config, index, order) for order in range(len(MODELS))]


def _in_order(config: SceneConfig, start: int) -> Iterator[list[Sequence]]:
    """Presses are the unit of work, so that at the start two threads compile two sensors and none twice."""
    tasks = iter([(index, order) for index in range(start, config.contact_count) for order in range(len(MODELS))])
    pending: collections.deque[concurrent.futures.Future[Sequence]] = collections.deque()
    pool = concurrent.futures.ThreadPoolExecutor(_WORKERS, thread_name_prefix="scenes")

    def submit(count: int) -> None:
        pending.extend(pool.submit(_press, config, *task) for task in itertools.islice(tasks, count))

    try:
        submit(_LOOKAHEAD * len(MODELS))
        while pending:
            done = [pending.popleft().result() for _ in MODELS]
            submit(len(MODELS))
            yield done
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@functools.lru_cache(maxsize=32)
def _site(config: SceneConfig, index: int) -> tuple[objects.Solid, surface.Skin, np.ndarray, float]:
    """What all sensors share in a contact: object, skin, site (mm from the object's centre), direction."""
    solid = _solid(config, index // config.sites)
    rng = stream(config.seed, "contact", index)
    site = rng.uniform(-8, 8, 2)
    turn = rng.uniform(0, 2 * np.pi)
    return solid, surface.make_skin(solid, site, float(np.exp(0.15 * rng.standard_normal()))), site, turn


def _press(config: SceneConfig, index: int, order: int) -> Sequence:
    """Contact `index` by sensor number `order`."""
    solid, skin, site, turn = _site(config, index)
    sensor = MODELS[order]
    rng = stream(config.seed, "press", index, order)
    serial = int(rng.integers(UNITS))
    force, measured, target = _ramp(config, rng)
    press = Press(
        skin=skin,
        pose=_pose(turn, rng),
        modulus_mpa=_f32(solid.modulus_mpa),
        force_n=_f32(force),
        exposure_drift=_f32(0.01 * rng.standard_normal()),
    )
    unit = _session(_unit(config.seed, order, serial), rng)
    time_ns = _times(config, index, order, sensor, target)
    return Sequence(
        key=ContactKey(object_id=_object_id(index // config.sites), site=index % config.sites, motion="press", trial=0),
        sensor=sensor.name,
        serial=f"generated-{sensor.name}-{serial}",
        calibration=f"generated-{GENERATOR}",
        contact_region_px=_region(config, sensor, site),
        mm_per_px=sensor.window_mm / config.image_px if sensor.render is not None else None,
        force_n=measured,
        target_force_n=target,
        host_time_ns=time_ns,
        force_time_ns=time_ns - _FORCE_LEAD_NS,
        phase=np.full(config.frames, LOAD, np.uint8),
        **_measured(config, sensor, press, unit, rng),
    )


def _measured(
    config: SceneConfig, sensor: SensorModel, press: Press, unit: Unit, rng: np.random.Generator
) -> dict[str, Any]:
    """Pictures, fields and flags of a press, as the arrays of a `Sequence`."""
    grid = Grid(contact_grid=config.contact_grid, image_px=config.image_px)
    noise = draw_noise(rng, config.frames, sensor, config.image_px)
    limits = (config.solver_tolerance, config.solver_max_iterations)
    made = jax.device_get(record(press, unit, make_kernels(sensor, grid), noise, sensor, grid, *limits))
    markers = sensor.marker_depth_mm is not None
    return {
        "frames": made.frames,
        "deformation_mm": made.deformation_mm if markers else None,
        "shear_mm": made.shear_mm if markers else None,
        "depth_mm": made.depth_mm,
        "valid": made.valid,
        "flags": _flags(made),
    }


def _flags(made: Recording) -> np.ndarray:
    """What is wrong with each frame, [F] uint32."""
    flags = np.zeros(made.strain.shape, np.uint32)
    flags[made.strain > _STRAIN_LIMIT] |= np.uint32(Flag.STRAIN_LIMIT)
    flags[~made.converged] |= np.uint32(Flag.NOT_CONVERGED)
    flags[made.border] |= np.uint32(Flag.BORDER_CONTACT)
    return flags


def _ramp(config: SceneConfig, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force applied [F], measured [F, 3] (on the gel: pressing is Fz < 0) and targeted [F]; N, float32."""
    target = np.geomspace(config.min_force_n, config.max_force_n, config.frames)
    force = target * (1 + config.force_jitter * np.clip(rng.standard_normal(config.frames), -3, 3))
    gain = 1 + config.force_gain_error * rng.standard_normal()
    crosstalk = 0.01 * rng.standard_normal(2)
    noise = config.force_noise_n * rng.standard_normal((config.frames, 3))
    measured = np.stack([crosstalk[0] * force, crosstalk[1] * force, -gain * force], -1) + noise
    return force, measured.astype(np.float32), target.astype(np.float32)


def _pose(turn: float, rng: np.random.Generator) -> surface.Pose:
    """The site's direction with this sensor's error of placement: 0.3 mm, 2°, tilt 0.3°."""
    return surface.Pose(
        offset_mm=_f32(rng.normal(0, 0.3, 2)),
        turn_rad=_f32(turn + rng.normal(0, np.deg2rad(2))),
        tilt=_f32(rng.normal(0, np.deg2rad(0.3), 2)),
    )


@functools.lru_cache(maxsize=64)
def _unit(seed: int, order: int, serial: int) -> Unit:
    """One physical unit: gel 5 % off its model, its own lamps, print and calibration."""
    rng = stream(seed, "unit", order, serial)
    sensor = MODELS[order]
    dense = sensor.render is optics.speckle
    texture = optics.speckle_texture(rng, 288, 5.0) if dense else np.zeros((2, 2))
    light = optics.Light(
        exposure=_f32(np.exp(0.05 * rng.standard_normal())),
        led_gain=_f32(np.exp(0.06 * rng.standard_normal(3))),
        pattern_shift_mm=_f32(rng.uniform(-0.5, 0.5, 2)),
        texture=_f32(texture),
    )
    return Unit(
        modulus_factor=_f32(np.exp(0.05 * rng.standard_normal())),
        light=light,
        lateral_gain=_f32(1 + 0.02 * rng.standard_normal()),
        depth_gain=_f32(1 + 0.03 * rng.standard_normal()),
    )


def _session(unit: Unit, rng: np.random.Generator) -> Unit:
    """The unit on the day of this press: exposure 3 % off."""
    exposure = unit.light.exposure * float(np.exp(0.03 * rng.standard_normal()))
    return dataclasses.replace(unit, light=dataclasses.replace(unit.light, exposure=exposure))


def _times(config: SceneConfig, index: int, order: int, sensor: SensorModel, target: np.ndarray) -> np.ndarray:
    """Host stamps: the sensors press one after another, 10 s apart; force rises linearly; frames come on the camera's
    clock, each on a tick of its own.
    """
    begin_ms = 10_000.0 * (index * len(MODELS) + order)
    ideal = target.astype(np.float64) / config.max_force_n * config.ramp_s * 1000 / sensor.frame_period_ms
    tick = np.maximum.accumulate(np.round(ideal) - np.arange(len(ideal))) + np.arange(len(ideal))
    return np.round((begin_ms + tick * sensor.frame_period_ms) * 1e6).astype(np.int64)


def _region(config: SceneConfig, sensor: SensorModel, site: np.ndarray) -> tuple[int, int, int, int]:
    """The sensing window on the view, clipped to it: x, y, width, height."""
    scale = config.view_px / appearance.VIEW_MM
    low = np.round(np.clip(config.view_px / 2 + (site - sensor.window_mm / 2) * scale, 0, config.view_px - 1)).astype(
        int
    )
    side = max(1, round(sensor.window_mm * scale))
    width, height = np.minimum(side, config.view_px - low)
    return int(low[0]), int(low[1]), int(width), int(height)


def _card(config: SceneConfig, index: int, split: str) -> ObjectCard:
    solid = _solid(config, index)
    picture, depth = appearance.view(solid.looks_like, config.view_px, stream(config.seed, "view", index))
    return ObjectCard(
        object_id=_object_id(index),
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


@functools.lru_cache(maxsize=32)
def _solid(config: SceneConfig, index: int) -> objects.Solid:
    return objects.sample(stream(config.seed, "object", index), config.visual_lie_share, config.shortest_wave_mm)


def _f32(value: float | np.ndarray) -> jax.Array:
    return jnp.asarray(value, jnp.float32)


def _object_id(index: int) -> str:
    return f"g{index:06d}"
