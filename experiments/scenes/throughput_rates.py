"""Rates of the generator: feeds without disk, written sets, the parts of a record, and the machine's own rates."""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sensors_io.generate import generate_records
from sensors_io.live import LiveScenes
from sensors_io.pipeline import ClipConfig, clip_batches
from sensors_io.scenes import contact, surface
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.draws import draw
from sensors_io.scenes.press import GridSizes, Kernels, Press, make_kernels, record
from sensors_io.scenes.protocol import make_contact
from sensors_io.scenes.schedule import Slot
from sensors_io.scenes.sensors import MODELS, SensorModel
from sensors_io.schema import FORCES_N, SENSORS


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordRate:
    """Records, and the seconds of the clock and of the processors that they took."""

    records: int
    seconds: float
    cpu_seconds: float

    @property
    def per_second(self) -> float:
        """Records per second of the clock."""
        return self.records / self.seconds

    @property
    def cpu_ms(self) -> float:
        """Milliseconds of one core per record, which hardly depends on who shares the machine."""
        return 1e3 * self.cpu_seconds / self.records


class Stopwatch:
    """Wall and processor time of this process since it was made."""

    def __init__(self) -> None:
        self._begin = (time.perf_counter(), time.process_time())

    def rate(self, records: int) -> RecordRate:
        """The rate of `records` made since then."""
        wall, cpu = time.perf_counter() - self._begin[0], time.process_time() - self._begin[1]
        return RecordRate(records=records, seconds=wall, cpu_seconds=cpu)


def feed_rate(config: SceneConfig, contacts: int, threads: int, advance: Callable[[int], None]) -> RecordRate:
    """Rate of a feed without disk whose clips hold every frame; compiling and looking at objects are left out."""
    clip = ClipConfig(frames=config.frame_count, image_px=config.image_px, view_px=config.view_px)
    scenes = LiveScenes(config)
    for row in _one_of_each_program(config):
        make_contact(config, row)
    order = np.arange(contacts) % len(scenes)
    batches = clip_batches(scenes, order, clip, batch_size=1, seed=0, repeat=False, threads=threads)
    watch = Stopwatch()
    for batch in batches:
        advance(len(batch["contact"]))
    return watch.rate(contacts * len(SENSORS) * config.frame_count)


def write_rate(config: SceneConfig, out: Path, advance: Callable[[int], None]) -> tuple[RecordRate, float]:
    """Rate of a written set and its bytes per record; compiling and looking at objects are left out."""
    for row in _one_of_each_program(config):
        make_contact(config, row)
    watch, seen = Stopwatch(), [0]

    def report(done: int, total: int) -> None:
        advance(done - seen[0])
        seen[0] = done

    generate_records(config, out, progress=report)
    records = config.contact_count * len(SENSORS) * config.frame_count
    return watch.rate(records), sum(f.stat().st_size for f in out.iterdir()) / records


def _one_of_each_program(config: SceneConfig) -> Iterator[int]:
    """A contact for every program that is compiled: one that stands, one that moves."""
    moves = [key.motion.startswith("slide") for key in LiveScenes(config).contacts]
    yield moves.index(False)
    if True in moves:
        yield moves.index(True)


_Scene = tuple[Press, Any, np.ndarray]  # object, sensor unit, key of the noise


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageCosts:
    """Milliseconds of one core per record of one sensor: of the contact solver, of friction, of fields, of pictures."""

    normal: float
    friction: float
    fields: float
    picture: float


def stage_costs(config: SceneConfig, order: int, objects: int) -> StageCosts:
    """Costs of the parts of the compiled program, by timing it with and without them, over `objects` objects."""
    sensor = MODELS[order]
    blind = dataclasses.replace(sensor, render=None)
    still = [_scene(config, i, order, "hold") for i in range(objects)]
    moved = [_scene(config, i, order, "slide_x") for i in range(objects)]
    normal = _cpu_ms(config, sensor, still, _pressures)
    fields = _cpu_ms(config, blind, still, _record)
    whole = _cpu_ms(config, sensor, still, _record) if sensor.render is not None else fields
    slid = _cpu_ms(config, blind, moved, functools.partial(_record, moving=True))
    return StageCosts(normal=normal, friction=slid - fields, fields=fields - normal, picture=whole - fields)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MachineRates:
    """Measured rates of one core: float32 operations of matrix products, bytes copied, a pair of padded transforms."""

    flops_per_s: float
    bytes_per_s: float
    transform_s: float


def measure_machine(padded: int, grid: int, image_px: int) -> MachineRates:
    """Rates at the sizes that records have: cubic resampling products, copies of a picture in floats, transforms."""
    left, field = jnp.ones((image_px, grid)), jnp.ones((grid, grid))
    product = jax.jit(lambda a, b: a @ b @ a.T)
    flops = 2 * (image_px * grid * grid + image_px * grid * image_px)
    picture = np.ones((image_px, image_px, 3), np.float32)
    forth = jax.jit(lambda p: jnp.fft.irfft2(jnp.fft.rfft2(p, s=(padded, padded)), s=(padded, padded))[:grid, :grid])
    return MachineRates(
        flops_per_s=flops / _seconds(lambda: product(left, field)),
        bytes_per_s=2 * picture.nbytes / _seconds(picture.copy),
        transform_s=_seconds(lambda: forth(field)),
    )


def _seconds(call: Callable[[], Any], times: int = 40) -> float:
    """Least time of one call, which other load does not affect."""
    found = []
    for _ in range(times):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        found.append(time.perf_counter() - begin)
    return min(found)


def _scene(config: SceneConfig, index: int, order: int, motion: str) -> _Scene:
    slot = Slot(object_index=index, site=0, motion=motion, force_n=FORCES_N[1])
    drawn = draw(config, index, slot, order)
    return drawn.press, drawn.unit, drawn.key


def _cpu_ms(config: SceneConfig, sensor: SensorModel, scenes: list[_Scene], run: Callable[..., Any]) -> float:
    grid = GridSizes(contact_grid=config.contact_grid, image_px=config.image_px)
    kernels = make_kernels(sensor, grid)
    jax.block_until_ready(run(*scenes[0], kernels, sensor, grid))
    watch = Stopwatch()
    for scene in scenes:
        jax.block_until_ready(run(*scene, kernels, sensor, grid))
    return watch.rate(len(scenes) * config.frame_count).cpu_ms


def _record(
    press: Press,
    unit: Any,
    key: np.ndarray,
    kernels: Kernels,
    sensor: SensorModel,
    grid: GridSizes,
    moving: bool = False,
) -> Any:
    return record(press, unit, kernels, key, sensor, grid, moving=moving)


@functools.partial(jax.jit, static_argnames=("sensor", "grid"))
def _pressures(
    press: Press, unit: Any, key: np.ndarray, kernels: Kernels, sensor: SensorModel, grid: GridSizes
) -> tuple[jax.Array, jax.Array]:
    """Pressure and displacement of every frame with load, one of force 1 N in place of the others."""
    spacing = sensor.window_mm / grid.contact_grid
    x = (jnp.arange(grid.contact_grid, dtype=jnp.float32) + 0.5) * spacing - sensor.window_mm / 2
    gap = surface.gap(press.skin, press.pose, x)
    gel, body = kernels.gel / unit.modulus_factor, kernels.body / press.modulus_mpa

    def solve(force: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = contact.solve(gap, jnp.where(force > 0, force, 1.0), gel, body, spacing)
        return found.pressure_mpa, found.displacement_mm

    return jax.lax.map(solve, press.path.force_n)
