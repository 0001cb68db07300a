"""Rates of the generator (fed, written, by part), the machine's own rates, and a writer that is killed and resumed."""

import dataclasses
import functools
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.timing import interleaved
from sensors_io.generate import generate_records
from sensors_io.live import LiveScenes
from sensors_io.pipeline import ClipConfig, clip_batches
from sensors_io.records import CorruptRecordsError, RecordStore
from sensors_io.scenes import contact, surface
from sensors_io.scenes.config import SceneConfig, require
from sensors_io.scenes.draws import draw
from sensors_io.scenes.press import GridSizes, Kernels, Press, make_kernels, record
from sensors_io.scenes.protocol import make_contact
from sensors_io.scenes.schedule import Slot
from sensors_io.scenes.sensors import MODELS, SensorModel
from sensors_io.schema import FORCES_N, SENSORS, Flag, Sequence


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


def start_clock() -> Callable[[int], RecordRate]:
    """A function that gives the rate of some records made since the clock was started."""
    wall, cpu = time.perf_counter(), time.process_time()
    return lambda records: RecordRate(
        records=records, seconds=time.perf_counter() - wall, cpu_seconds=time.process_time() - cpu
    )


def feed_rate(config: SceneConfig, contacts: int, threads: int, advance: Callable[[int], None]) -> RecordRate:
    """Rate of a feed without disk whose clips hold every frame; compiling and looking at objects are left out."""
    clip = ClipConfig(frames=config.frame_count, image_px=config.image_px, view_px=config.view_px)
    scenes = LiveScenes(config)
    for row in _one_of_each_program(config):
        make_contact(config, row)
    order = np.arange(contacts) % len(scenes)
    batches = clip_batches(scenes, order, clip, batch_size=1, seed=0, repeat=False, threads=threads)
    rate_of = start_clock()
    for batch in batches:
        advance(len(batch["contact"]))
    return rate_of(contacts * len(SENSORS) * config.frame_count)


def write_rate(config: SceneConfig, out: Path, report: Callable[[int, int], None]) -> tuple[RecordRate, float]:
    """Rate of a written set and its bytes per record; compiling and looking at objects are left out."""
    for row in _one_of_each_program(config):
        make_contact(config, row)
    rate_of = start_clock()
    generate_records(config, out, progress=report)
    records = config.contact_count * len(SENSORS) * config.frame_count
    return rate_of(records), sum(f.stat().st_size for f in out.iterdir()) / records


def _one_of_each_program(config: SceneConfig) -> Iterator[int]:
    """A contact for every compiled program: one that stands, one that moves."""
    moves = [key.motion.startswith("slide") for key in LiveScenes(config).contacts]
    yield moves.index(False)
    if True in moves:
        yield moves.index(True)


_Scene = tuple[Press, Any, np.ndarray]  # object, sensor unit, key of the noise


def part_costs(config: SceneConfig, order: int, objects: int) -> dict[str, float]:
    """Milliseconds of one core per record of sensor number `order`, by part of the compiled program.

    The program is timed with and without each part, over `objects` objects.
    """
    sensor = MODELS[order]
    blind = dataclasses.replace(sensor, render=None)
    still = [_scene(config, i, order, "hold") for i in range(objects)]
    moved = [_scene(config, i, order, "slide_x") for i in range(objects)]
    normal = _cpu_ms(config, sensor, still, _pressures)
    fields = _cpu_ms(config, blind, still, _record)
    whole = _cpu_ms(config, sensor, still, _record) if sensor.render is not None else fields
    slid = _cpu_ms(config, blind, moved, functools.partial(_record, moving=True))
    return {"pressure": normal, "friction": slid - fields, "fields": fields - normal, "picture": whole - fields}


def picture_floor(padded: int, grid: int, image_px: int) -> dict[str, float]:
    """Lower bound of the time of a picture, ms, from its operations and bytes at measured rates of one core.

    The rates are those of float32 matrix products (cubic resampling), GFLOP/s, and of copies of a picture, GB/s; also
    given is the time of a pair of padded transforms, ms.
    """
    left, field = jnp.ones((image_px, grid)), jnp.ones((grid, grid))
    product = jax.jit(lambda a, b: a @ b @ a.T)
    flops = 2 * (image_px * grid * grid + image_px * grid * image_px)
    picture = np.ones((image_px, image_px, 3), np.float32)
    forth = jax.jit(lambda p: jnp.fft.irfft2(jnp.fft.rfft2(p, s=(padded, padded)), s=(padded, padded))[:grid, :grid])
    flops_per_s = flops / _seconds(lambda: product(left, field))
    bytes_per_s = 2 * picture.nbytes / _seconds(picture.copy)
    size = image_px * image_px * 3 * 5  # each float of the picture written once, one byte of the result
    return {
        "products": flops_per_s / 1e9,
        "copies": bytes_per_s / 1e9,
        "pair of transforms": 1e3 * _seconds(lambda: forth(field)),
        "floor": 1e3 * (4 * flops / flops_per_s + size / bytes_per_s),
    }


def _seconds(call: Callable[[], Any]) -> float:
    """Least time of one call of forty, which other load does not affect."""
    return float(interleaved({"": call}, range(40))[""].min())


def _scene(config: SceneConfig, index: int, order: int, motion: str) -> _Scene:
    slot = Slot(object_index=index, site=0, motion=motion, force_n=FORCES_N[1])
    drawn = draw(config, index, slot, order)
    return drawn.press, drawn.unit, drawn.key


def _cpu_ms(config: SceneConfig, sensor: SensorModel, scenes: list[_Scene], run: Callable[..., Any]) -> float:
    grid = GridSizes(contact_grid=config.contact_grid, image_px=config.image_px)
    kernels = make_kernels(sensor, grid)
    jax.block_until_ready(run(*scenes[0], kernels, sensor, grid))
    rate_of = start_clock()
    for scene in scenes:
        jax.block_until_ready(run(*scene, kernels, sensor, grid))
    return rate_of(len(scenes) * config.frame_count).cpu_ms


def _record(press: Press, unit: Any, key: np.ndarray, *given: Any, moving: bool = False) -> Any:
    kernels, sensor, grid = given
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


# A killed writer -----------------------------------------------------------------------------------------------------

_POLL_S = 0.05  # a shard takes seconds
_SIGKILL = -int(signal.SIGKILL)  # return code of a process that it ended


def write_and_kill(scenes: SceneConfig, context: Context, kills: int) -> dict[str, Any]:
    """Write the set once undisturbed and once with kills; the copies are removed after the comparison.

    Its rate, bytes a record and frames past the strain limit; the kills of the second writer, and what it `kept`.
    """
    home = context.directory / "written"
    shutil.rmtree(home, ignore_errors=True)
    whole, killed = home / "whole", home / "killed"
    with context.progress_callback("writing") as report:
        rate, size = write_rate(scenes, whole, report)
    shards = len(list(whole.glob("contacts-*")))
    command = [sys.executable, "-m", "sensors_io", "generate", "--out", str(killed)]
    for name in ("objects", "sequences", "frames", "image_px", "contact_grid"):
        command += [f"--{name.replace('_', '-')}", str(getattr(scenes, name))]
    with context.progress("killing and resuming", kills + 1) as advance:
        killed_times = killed_and_resumed(command, killed, kills, shards, rate.seconds / shards, advance)
    with context.progress("comparing", scenes.contact_count) as advance:
        kept = compare(whole, killed, advance)
    store = RecordStore(whole)
    rows = context.each("reading flags", range(len(store)))
    flags = [s.flags for i in rows for s in store.contact(i, fields=False).values()]
    past = int((np.concatenate(flags) & np.uint32(Flag.STRAIN_LIMIT) > 0).sum())
    shutil.rmtree(home)
    return {"rate": rate, "bytes": size, "past_limit": past, "kills": killed_times, "kept": kept}


def killed_and_resumed(
    command: list[str],
    out: Path,
    kills: int,
    shards: int,
    shard_s: float,
    advance: Callable[[], object] = lambda: None,
) -> int:
    """Run the command that writes records, kill it with SIGKILL at random moments, let the last run finish.

    A moment is a random shard, another each time, and a random part of the time in which it is written (`shard_s` by an
    undisturbed writer); the first shard takes in the start of the process and its compiling.  Returns the number of
    runs that were killed before they ended; `advance` is called after each of them, and after the last run.

    Raises:
      ValueError: as many kills as shards, or more.
    """
    require(kills < shards, "kills", kills, f"must be < {shards}, the shards of the set, or more contacts be written")
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(out.parent / "compiled")}
    rng, killed = np.random.default_rng(0), 0
    for shard in np.sort(rng.choice(shards - 1, kills, replace=False)):
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            while process.poll() is None and len(list(out.glob("contacts-*"))) < shard:
                time.sleep(_POLL_S)
            time.sleep(rng.uniform(0, shard_s))
        finally:
            process.kill()
            killed += process.wait() == _SIGKILL
        advance()
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    advance()
    return killed


def compare(whole: Path, killed: Path, advance: Callable[[], None] = lambda: None) -> dict[str, int]:
    """Records of the killed writer's set that can be read, and contacts that are not as in the whole one.

    They are missing, repeated, damaged by their checksums, or differ in a bit or in their place.
    """
    left, right = RecordStore(whole), RecordStore(killed)
    records = damaged = differing = 0
    for i, key in enumerate(right.contacts):
        advance()
        try:
            contact = right.contact(i)
        except CorruptRecordsError:
            damaged += 1
            continue
        records += sum(len(sequence) for sequence in contact.values())
        differing += i >= len(left) or key != left.contacts[i] or not _same(contact, left.contact(i))
    return {
        "records": records,
        "missing": len(set(left.contacts) - set(right.contacts)),
        "repeated": len(right) - len(set(right.contacts)),
        "damaged": damaged,
        "differing": differing,
    }


def _same(a: Mapping[str, Sequence], b: Mapping[str, Sequence]) -> bool:
    if a.keys() != b.keys():
        return False
    pairs = ((vars(a[name]), vars(b[name])) for name in a)
    return all(np.array_equal(x[field], y[field]) for x, y in pairs for field in x)
