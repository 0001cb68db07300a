"""Rate at which clips are read from records, and the time of each part of the work."""

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.core.context import Context
from experiments.core.timing import interleaved
from sensors_io.augment import AugmentConfig
from sensors_io.codec import decode_sequence, encode_sequence
from sensors_io.generate import generate_records
from sensors_io.pipeline import ClipConfig, clip_batches, make_clip
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig

CHANGES: Mapping[str, AugmentConfig | None] = {
    "as recorded": None,
    "mirrored, turned": AugmentConfig(mirror=0.5, turn=0.75),
    "exposure, white balance": AugmentConfig(exposure_stops=0.5, white_balance_stops=0.2),
    "frames dropped": AugmentConfig(frame_dropout=0.2),
    "all of these": AugmentConfig(
        mirror=0.5, turn=0.75, exposure_stops=0.5, white_balance_stops=0.2, frame_dropout=0.2
    ),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeedConfig:
    """Records and batches of the feed.

    Args:
      scenes: the records.
      contacts: of them that are timed one by one.
      batch_size: clips of a batch.
      batches: timed in each round.
      workers: numbers of reading processes that are tried, 0 for none.
    """

    scenes: SceneConfig
    contacts: int = 8
    batch_size: int = 16
    batches: int = 8
    workers: tuple[int, ...] = (0, 1, 2)


def stage_ms(config: FeedConfig, store: RecordStore, rounds: Iterable[object]) -> dict[str, float]:
    """Milliseconds of one core that each part of making one clip takes, by subtraction where parts are nested."""
    clip = clip_config(config)
    rows = range(min(config.contacts, len(store)))
    contacts = [store.contact(i, fields=False) for i in rows]
    cards = [store.objects[store.contacts[i].object_id] for i in rows]
    entries = [encode_sequence(sequence) for i in rows for sequence in store.contact(i).values()]
    rng = np.random.default_rng(0)

    def clips(augment: AugmentConfig | None) -> Callable[[], Any]:
        source = rng if augment else None
        return lambda: [
            make_clip(contact, card, clip, augment=augment, rng=source)
            for contact, card in zip(contacts, cards, strict=True)
        ]

    calls: dict[str, Callable[[], Any]] = {
        "contact": lambda: [store.contact(i, fields=False) for i in rows],
        "decode": lambda: [decode_sequence(entry, fields=False) for entry in entries],
        **{name: clips(augment) for name, augment in CHANGES.items()},
    }
    for call in calls.values():
        call()
    ms = {name: 1e3 * float(np.median(s)) / len(rows) for name, s in interleaved(calls, rounds).items()}
    changes = {name: max(0.0, ms[name] - ms["as recorded"]) for name in CHANGES if CHANGES[name]}
    return {
        "read, decompress": max(0.0, ms["contact"] - ms["decode"]),
        "verify, decode": ms["decode"],
        "choose, resize": ms["as recorded"],
        **changes,
    }


def feed_rates(config: FeedConfig, store: RecordStore, rounds: int, context: Context) -> dict[tuple[int, str], float]:
    """Clips a second by number of workers and by change, median over rounds.

    One feed after the other: the workers of one that waits would read ahead in the time of another.  What a feed read
    ahead before its own time begins is drawn first.
    """
    rates = {}
    for workers, name in itertools.product(config.workers, _EXTREMES):
        feed, seconds = iter(_batches(config, store, workers, _EXTREMES[name])), []
        title = f"timing the feed {name}, {workers} processes"
        with contextlib.closing(feed):
            for _ in context.rounds(title, rounds):
                _draw(feed, _AHEAD + 2 * workers)
                began = time.perf_counter()
                _draw(feed, config.batches)
                seconds.append(time.perf_counter() - began)
        rates[workers, name] = config.batches * config.batch_size / float(np.median(seconds))
    return rates


def make_store(config: FeedConfig, directory: Path, context: Context) -> RecordStore:
    """The records, made first where they are not there."""
    with context.progress_callback("making records") as tell:
        generate_records(config.scenes, directory, progress=tell)
    return RecordStore(directory)


def clip_config(config: FeedConfig) -> ClipConfig:
    """Clips of eight frames at the size of the records."""
    return ClipConfig(image_px=config.scenes.image_px)


_AHEAD = 3
"""Batches that a feed reads ahead in this process; each worker holds two more."""

_EXTREMES = {name: CHANGES[name] for name in ("as recorded", "all of these")}


def _batches(config: FeedConfig, store: RecordStore, workers: int, augment: AugmentConfig | None) -> Any:
    return clip_batches(
        store,
        np.arange(len(store)),
        clip_config(config),
        batch_size=config.batch_size,
        seed=0,
        augment=augment,
        workers=workers,
    )


def _draw(feed: Iterator[Any], batches: int) -> None:
    for _ in range(batches):
        next(feed)
