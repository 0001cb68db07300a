"""How fast scenes are made: clocks, feeds without disk, written sets."""

import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from sensors_io.generate import generate_records
from sensors_io.live import LiveScenes
from sensors_io.pipeline import ClipConfig, clip_batches
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.protocol import make_contact
from sensors_io.schema import SENSORS


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordRate:
    """So many records in so many seconds of the clock and of the processors."""

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
        """The rate of `records` made meanwhile."""
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

    def tell(done: int, total: int) -> None:
        advance(done - seen[0])
        seen[0] = done

    generate_records(config, out, progress=tell)
    records = config.contact_count * len(SENSORS) * config.frame_count
    return watch.rate(records), sum(f.stat().st_size for f in out.iterdir()) / records


def _one_of_each_program(config: SceneConfig) -> Iterator[int]:
    """A contact for every program that is compiled: one that stands, one that moves."""
    moves = [key.motion.startswith("slide") for key in LiveScenes(config).contacts]
    yield moves.index(False)
    if True in moves:
        yield moves.index(True)
