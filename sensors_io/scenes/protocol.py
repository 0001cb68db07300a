"""The generated data set: which objects there are, how each is pressed, and the records that come of it.

Every object is pressed at `sites` places, at each by all four sensors, 0→20 N.  Contact i depends on (config, i) alone,
so that generation may stop and go on anywhere.  Small strain is assumed; frames beyond it are flagged, not removed.
"""

import collections
import concurrent.futures
import dataclasses
import functools
import hashlib
import itertools
import json
from collections.abc import Iterator

import jax
import numpy as np

from sensors_io.scenes import appearance, objects, optics, surface
from sensors_io.scenes.press import Grid, Press, Recording, Unit, draw_noise, make_kernels, record
from sensors_io.scenes.sensors import MODELS, SensorModel
from sensors_io.schema import ContactKey, Flag, ObjectCard, Sequence

GENERATOR = 1
"""Version of the generator: part of the hash, raised whenever the same config would give other records."""

UNITS = 3
"""Physical units of every sensor type."""

LOAD = 1
"""Phase of every frame of a press: loading."""

_STRAIN_LIMIT = 0.3  # of the gel's thickness, past which small strain is off by more than the label noise
_WORKERS = 2
_LOOKAHEAD = 3  # contacts in flight


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """What to generate.

    `split_shares` are the shares of objects in train, val and test.  Forces are `frames` geometric levels between
    `min_force_n` and `max_force_n`; the ramp misses its targets by `force_jitter` (relative), the force sensor has a gain
    error and noise on each axis.  `solver_tolerance` and `solver_max_iterations` are those of the contact solver.
    """

    objects: int = 600
    sites: int = 3
    frames: int = 8
    image_px: int = 112
    contact_grid: int = 64
    view_px: int = 64
    visual_lie_share: float = 0.3
    min_force_n: float = 0.2
    max_force_n: float = 20.0
    force_jitter: float = 0.03
    force_gain_error: float = 0.01
    force_noise_n: float = 0.03
    ramp_s: float = 3.0
    split_shares: tuple[float, float, float] = (0.7, 0.1, 0.2)
    solver_tolerance: float = 1e-3
    solver_max_iterations: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("objects", 3), ("sites", 1), ("frames", 1), ("contact_grid", 24), ("image_px", 16), ("view_px", 16)):
            value = getattr(self, name)
            _require(value >= least, name, value, f"must be ≥ {least}")
        _require(self.contact_grid % 2 == 0, "contact_grid", self.contact_grid, "must be even")
        _require(0 <= self.visual_lie_share <= 1, "visual_lie_share", self.visual_lie_share, "must lie in [0, 1]")
        ok = 0 < self.min_force_n <= self.max_force_n
        _require(ok, "min_force_n", self.min_force_n, f"must lie in (0, max_force_n = {self.max_force_n}]")
        _require(0 <= self.force_jitter <= 0.1, "force_jitter", self.force_jitter, "must lie in [0, 0.1]")
        ok = min(self.split_shares) >= 0 and abs(sum(self.split_shares) - 1) < 1e-6
        _require(ok, "split_shares", self.split_shares, "must be ≥ 0 and sum to 1")
        _require(self.solver_tolerance > 0, "solver_tolerance", self.solver_tolerance, "must be > 0")

    @property
    def contact_count(self) -> int:
        """Contacts of the data set; each gives one sequence per sensor."""
        return self.objects * self.sites

    @property
    def shortest_wave_mm(self) -> float:
        """Shortest wave of the roughness: 2.5 pixels of the coarsest contact grid."""
        return max(0.8, 2.5 * max(m.window_mm for m in MODELS) / self.contact_grid)


def config_hash(config: SceneConfig) -> str:
    """Hash of everything that decides the records: the config and the version of the generator."""
    payload = json.dumps({"generator": GENERATOR, **dataclasses.asdict(config)}, sort_keys=True)
    return hashlib.sha256(payload.encode()).hexdigest()[:16]


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
    _require(0 <= start <= config.contact_count, "start", start, f"must lie in [0, {config.contact_count}]")
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
    rng = _rng(config, "contact", index)
    site = rng.uniform(-8, 8, 2)
    turn = rng.uniform(0, 2 * np.pi)
    return solid, surface.make_skin(solid, site, float(np.exp(0.15 * rng.standard_normal()))), site, turn


def _press(config: SceneConfig, index: int, order: int) -> Sequence:
    """Contact `index` by sensor number `order`."""
    solid, skin, site, turn = _site(config, index)
    sensor = MODELS[order]
    rng = _rng(config, "press", index, order)
    serial = int(rng.integers(UNITS))
    force, measured, target = _ramp(config, rng)
    press = Press(
        skin=skin,
        pose=_pose(turn, rng),
        modulus_mpa=np.float32(solid.modulus_mpa),
        force_n=force,
        exposure_drift=np.float32(0.01 * rng.standard_normal()),
    )
    grid = _grid(config)
    unit = _session(_unit(config.seed, order, serial), rng)
    noise = draw_noise(rng, config.frames, sensor, config.image_px)
    made = jax.device_get(record(press, unit, make_kernels(sensor, grid), noise, sensor, grid))
    time_ns = _times(config, index, order, sensor, target)
    markers = sensor.marker_depth_mm is not None
    return Sequence(
        key=ContactKey(object_id=_object_id(index // config.sites), site=index % config.sites, motion="press", trial=0),
        sensor=sensor.name,
        serial=f"generated-{sensor.name}-{serial}",
        calibration=f"generated-{GENERATOR}",
        contact_region_px=_region(config, sensor, site),
        mm_per_px=sensor.window_mm / config.image_px if sensor.render is not None else None,
        frames=made.frames,
        deformation_mm=made.deformation_mm if markers else None,
        shear_mm=made.shear_mm if markers else None,
        depth_mm=made.depth_mm,
        valid=made.valid,
        force_n=measured,
        target_force_n=target,
        host_time_ns=time_ns,
        force_time_ns=time_ns - 2_000_000,
        phase=np.full(config.frames, LOAD, np.uint8),
        flags=_flags(made),
    )


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
    return force.astype(np.float32), measured.astype(np.float32), target.astype(np.float32)


def _pose(turn: float, rng: np.random.Generator) -> surface.Pose:
    """The site's direction with this sensor's error of placement: 0.3 mm, 2°, tilt 0.3°."""
    return surface.Pose(
        offset_mm=rng.normal(0, 0.3, 2).astype(np.float32),
        turn_rad=np.float32(turn + rng.normal(0, np.deg2rad(2))),
        tilt=rng.normal(0, np.deg2rad(0.3), 2).astype(np.float32),
    )


@functools.lru_cache(maxsize=64)
def _unit(seed: int, order: int, serial: int) -> Unit:
    """One physical unit: gel 5 % off its model, its own lamps, print and calibration."""
    rng = np.random.default_rng([seed, _STREAMS["unit"], order, serial])
    sensor = MODELS[order]
    dense = sensor.render is optics.speckle
    texture = optics.speckle_texture(rng, 288, 5.0) if dense else np.zeros((2, 2), np.float32)
    light = optics.Light(
        exposure=np.float32(np.exp(0.05 * rng.standard_normal())),
        led_gain=np.exp(0.06 * rng.standard_normal(3)).astype(np.float32),
        pattern_shift_mm=rng.uniform(-0.5, 0.5, 2).astype(np.float32),
        texture=texture,
    )
    return Unit(
        modulus_factor=np.float32(np.exp(0.05 * rng.standard_normal())),
        light=light,
        lateral_gain=np.float32(1 + 0.02 * rng.standard_normal()),
        depth_gain=np.float32(1 + 0.03 * rng.standard_normal()),
    )


def _session(unit: Unit, rng: np.random.Generator) -> Unit:
    """The unit on the day of this press: exposure 3 % off."""
    exposure = np.float32(unit.light.exposure * np.exp(0.03 * rng.standard_normal()))
    return unit.replace(light=unit.light.replace(exposure=exposure))


def _times(config: SceneConfig, index: int, order: int, sensor: SensorModel, target: np.ndarray) -> np.ndarray:
    """Host stamps: the sensors press one after another, 10 s apart, force rises linearly, frames come on the camera's clock."""
    begin_ms = 10_000.0 * (index * len(MODELS) + order)
    ideal = target.astype(np.float64) / config.max_force_n * config.ramp_s * 1000 / sensor.frame_period_ms
    tick = np.maximum.accumulate(np.round(ideal) - np.arange(len(ideal))) + np.arange(len(ideal))
    return np.round((begin_ms + tick * sensor.frame_period_ms) * 1e6).astype(np.int64)


def _region(config: SceneConfig, sensor: SensorModel, site: np.ndarray) -> tuple[int, int, int, int]:
    """The sensing window on the view, clipped to it: x, y, width, height."""
    scale = config.view_px / appearance.VIEW_MM
    low = np.round(np.clip(config.view_px / 2 + (site - sensor.window_mm / 2) * scale, 0, config.view_px - 1)).astype(int)
    side = max(1, round(sensor.window_mm * scale))
    width, height = np.minimum(side, config.view_px - low)
    return int(low[0]), int(low[1]), int(width), int(height)


def _grid(config: SceneConfig) -> Grid:
    return Grid(
        contact_grid=config.contact_grid,
        image_px=config.image_px,
        tolerance=config.solver_tolerance,
        max_iterations=config.solver_max_iterations,
    )


def _card(config: SceneConfig, index: int, split: str) -> ObjectCard:
    solid = _solid(config, index)
    picture, depth = appearance.view(solid.looks_like, config.view_px, _rng(config, "view", index))
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
    order = _rng(config, "split").permutation(config.objects)
    names[order[: edges[0]]] = "train"
    names[order[edges[0] : edges[1]]] = "val"
    return list(names)


@functools.lru_cache(maxsize=32)
def _solid(config: SceneConfig, index: int) -> objects.Solid:
    return objects.sample(_rng(config, "object", index), config.visual_lie_share, config.shortest_wave_mm)


_STREAMS = {"object": 1, "view": 2, "split": 3, "unit": 4, "contact": 5, "press": 6}


def _rng(config: SceneConfig, stream: str, *index: int) -> np.random.Generator:
    return np.random.default_rng([config.seed, _STREAMS[stream], *index])


def _object_id(index: int) -> str:
    return f"g{index:06d}"


def _require(ok: bool, field: str, value: object, constraint: str) -> None:
    if not ok:
        raise ValueError(f"{field} is {value!r}: {constraint}; change {field}")
