"""Which lossless codec should records use, and how fast do clips come from them?

    python -m experiments pareto_storage --data-dir DIR [--scale smoke]

Compares raw frames, zstd and its kin, byte shuffle, differences in time, along rows and columns, the records' own codec
(the difference with the smallest residual, then zstd-1), PNG, WebP, HuffYUV and FFV1, on generated scenes and, where
DIR holds the folders physiclear and gelslam, on real videos and on stills of a real camera: bytes a frame against
frames written and read a second, on one core, in interleaved rounds.  A codec counts only where every bit comes back.
Then measures the feed: the time of each part of making a clip, the cost of each augmentation, and the rate with reading
processes.

The rule for the default was set in advance.  Training needs 1600 frames a second (50 clips of 8 frames of 4 sensors).
Of the codecs that read them on at most 15 % of a core, for generated and imported frames, the rule selects the codec
with the lowest mean ratio of bytes to raw frames.

Cost: four minutes on one core; `--scale smoke` under one, without recordings.

Expected: the records' own codec, at half to two thirds of the bytes of zstd-1, read as fast.
"""

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.context import Context
from experiments.core.look import SHARED
from experiments.core.results import Picture, Requirement, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.core.timing import median_ms
from experiments.scenes.storage_codecs import (
    OWN,
    PLAIN,
    Codec,
    CodecMeasurement,
    all_codecs,
    chosen_filters,
    measure,
)
from sensors_io.augment import AugmentConfig
from sensors_io.codec import decode_sequence, encode_sequence
from sensors_io.generate import generate_records
from sensors_io.importers.keep import Keep
from sensors_io.importers.pictures import numbered, read_picture
from sensors_io.importers.video import read_video
from sensors_io.live import LiveScenes
from sensors_io.pipeline import ClipConfig, clip_batches, make_clip
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig

GENERATED, IMPORTED, WHOLE, STILLS = "generated", "videos as imported", "videos, whole frames", "camera stills"
"""Kinds of clips; recordings are in `<data_dir>/physiclear/videos` and `<data_dir>/gelslam/6.310mm`."""

TRAINING_FPS, CORE_SHARE = 1600, 0.15
NEED_FPS = TRAINING_FPS / CORE_SHARE
"""The rule for the default: frames a second that training reads, on this share of a core."""

WHOLE_FRAMES = 48  # frames of each video that are kept in full size

_MIRROR, _LIGHT = {"mirror": 0.5, "turn": 0.75}, {"exposure_stops": 0.5, "white_balance_stops": 0.2}
CHANGES: Mapping[str, AugmentConfig | None] = {
    "as recorded": None,
    "mirrored, turned": AugmentConfig(**_MIRROR),
    "exposure, white balance": AugmentConfig(**_LIGHT),
    "frames dropped": AugmentConfig(frame_dropout=0.2),
    "all of these": AugmentConfig(**_MIRROR, **_LIGHT, frame_dropout=0.2),
}
"""Augmentations whose time is measured."""

_AHEAD = 3  # batches that a feed reads ahead in this process; each worker holds two more

Rows = Mapping[str, Sequence[CodecMeasurement]]  # kind of clips → codecs measured on them


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeedConfig:
    """Records and batches of the feed.

    Args:
      scenes: the records.
      contacts: number of those that are timed one by one.
      batch_size: clips of a batch.
      batches: timed in each round.
      workers: numbers of reading processes that are tried, 0 for none.
    """

    scenes: SceneConfig = SceneConfig(objects=32, sites=1)
    contacts: int = 8
    batch_size: int = 16
    batches: int = 8
    workers: tuple[int, ...] = (0, 1, 2)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StorageConfig:
    """Clips to store, and the feed to time.

    Args:
      data_dir: folder of recordings; None for generated scenes alone.
      scenes: generated clips.
      contacts: number of generated contacts.
      videos: number of real ones.
      rounds: of timing.
      feed: the feed.
    """

    data_dir: Path | None = None
    scenes: SceneConfig = SceneConfig(objects=4, sites=1, frames=90)
    contacts: int = 2
    videos: int = 6
    rounds: int = 3
    feed: FeedConfig = FeedConfig()


def run(config: StorageConfig, context: Context) -> Results:
    """Store, feed, compare."""
    clips = {GENERATED: generated_clips(config.scenes, context.each("making scenes", range(config.contacts)))}
    if config.data_dir is not None:
        clips |= recorded_clips(config.data_dir, config.videos, WHOLE_FRAMES, context)
    rows: dict[str, list[CodecMeasurement]] = {}
    missing: dict[str, str] = {}
    for kind, group in clips.items():
        context.print(f"{kind}: {len(group)} clips, {sum(map(len, group))} frames")
        rows[kind], absent = measure(all_codecs(), group, config.rounds, context)
        missing |= absent
    with context.progress_callback("making records") as report:
        generate_records(config.feed.scenes, context.directory / "records", progress=report)
    store = RecordStore(context.directory / "records")
    parts = part_ms(config.feed, store, context.rounds("timing the parts of a clip", config.rounds))
    rates = feed_rates(config.feed, store, config.rounds, context)
    best = fastest_small(rows, NEED_FPS)
    filters = {kind: chosen_filters(context.each(f"filters, {kind}", group)) for kind, group in clips.items()}
    sizes = [f"{_bytes(g, OWN) / _bytes(g, 'raw'):.2f} ({kind})" for kind, g in rows.items()]
    return Results(
        verdict=(
            f"Of the codecs that read {NEED_FPS:,.0f} frames/s the rule chooses {best.name}; records use {OWN}, which "
            f"takes {', '.join(sizes)} of the bytes of raw frames.",
            f"A clip of 8 frames of 4 sensors costs {sum(list(parts.values())[:3]):.1f} ms of one core; the feed gives "
            f"{rates[0, 'as recorded']:.0f} clips/s without reading processes.",
        ),
        requirements=_requirements(rows, best),
        tables=(*(_codec_table(kind, r) for kind, r in rows.items()), *_other_tables(filters, parts, rates)),
        pictures=tuple(_picture(n, *row) for n, row in context.each("drawing", enumerate(rows.items()))),
        settings={
            "rule": f"reads {NEED_FPS:,.0f} frames/s: {TRAINING_FPS:,.0f} on {CORE_SHARE:.0%} of a core",
            "not available here": "; ".join(missing.values()) or "nothing",
        },
    )


def generated_clips(config: SceneConfig, contacts: Iterable[int]) -> list[np.ndarray]:
    """Camera frames of each sensor of some contacts, uint8 [N, H, W, 3]."""
    scenes = LiveScenes(config)
    sequences = [sequence for i in contacts for sequence in scenes.contact(i).values()]
    return [sequence.frames for sequence in sequences if sequence.frames is not None]


def recorded_clips(data_dir: Path, videos: int, frames: int, context: Context) -> dict[str, list[np.ndarray]]:
    """Clips of recordings by kind; a kind that is not there is left out.

    Videos are evenly spread over the folder, at most `frames` of each in whole frames.  They were compressed with loss
    before; the stills were not.
    """
    found: dict[str, list[np.ndarray]] = {}
    files = sorted((data_dir / "physiclear" / "videos").glob("*.mov"))
    if files:
        chosen = [files[i] for i in np.linspace(0, len(files) - 1, videos).astype(int)]
        found |= {IMPORTED: [], WHOLE: []}
        for file in context.each("reading videos", chosen):
            found[IMPORTED].append(read_video(file, Keep()).frames)
            found[WHOLE].append(read_video(file, Keep(height=0, max_frames=0)).frames[:frames])
    folders = (data_dir / "gelslam" / "6.310mm").glob("*")
    stills = [picture for folder in sorted(folders) for picture in numbered(folder)]
    if stills:
        found[STILLS] = [read_picture(picture)[None] for picture in context.each("reading stills", stills)]
    return found


def fastest_small(rows: Rows, need_fps: float) -> Codec:
    """The codec that the rule picks; the fastest one where none is fast enough."""
    kinds = [kind for kind in (GENERATED, IMPORTED) if kind in rows]
    by_name = {kind: {row.codec.name: row for row in rows[kind] if row.exact} for kind in kinds}
    names = [name for name in by_name[kinds[0]] if all(name in by_name[kind] for kind in kinds)]
    slowest = {name: min(by_name[kind][name].read_fps for kind in kinds) for name in names}
    fast = [name for name in names if slowest[name] >= need_fps] or [max(names, key=lambda name: slowest[name])]
    size = {n: float(np.mean([by_name[k][n].bytes / by_name[k]["raw"].bytes for k in kinds])) for n in fast}
    return by_name[kinds[0]][min(fast, key=lambda name: size[name])].codec


# Feed ----------------------------------------------------------------------------------------------------------------


def part_ms(config: FeedConfig, store: RecordStore, rounds: Iterable[object]) -> dict[str, float]:
    """Milliseconds of one core that each part of making one clip takes, by subtraction where parts are nested."""
    clip = ClipConfig(image_px=config.scenes.image_px)
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
    ms = {name: time / len(rows) for name, time in median_ms(calls, rounds).items()}
    return {
        "read, decompress": max(0.0, ms["contact"] - ms["decode"]),
        "verify, decode": ms["decode"],
        "choose, resize": ms["as recorded"],
        **{name: max(0.0, ms[name] - ms["as recorded"]) for name in CHANGES if CHANGES[name]},
    }


def feed_rates(config: FeedConfig, store: RecordStore, rounds: int, context: Context) -> dict[tuple[int, str], float]:
    """Clips a second by number of workers and by change, median over rounds.

    One feed after the other: the workers of one that waits would read ahead in the time of another.  What a feed read
    ahead before its own time begins is drawn first.
    """
    rates, clip = {}, ClipConfig(image_px=config.scenes.image_px)
    for workers, name in itertools.product(config.workers, ("as recorded", "all of these")):
        options: dict[str, Any] = {"batch_size": config.batch_size, "augment": CHANGES[name], "workers": workers}
        feed = iter(clip_batches(store, np.arange(len(store)), clip, seed=0, **options))
        seconds = []
        with contextlib.closing(feed):
            for _ in context.rounds(f"timing the feed {name}, {workers} processes", rounds):
                _skip(feed, _AHEAD + 2 * workers)
                began = time.perf_counter()
                _skip(feed, config.batches)
                seconds.append(time.perf_counter() - began)
        rates[workers, name] = config.batches * config.batch_size / float(np.median(seconds))
    return rates


def _skip(feed: Iterator[Any], batches: int) -> None:
    for _ in range(batches):
        next(feed)


# Report --------------------------------------------------------------------------------------------------------------


def _requirements(rows: Rows, best: Codec) -> tuple[Requirement, ...]:
    inexact = sum(not row.exact for group in rows.values() for row in group if row.codec.name == OWN)
    excess = max(_bytes(rows[k], OWN) / _bytes(rows[k], best.name) for k in (GENERATED, IMPORTED) if k in rows)
    against = max(_bytes(group, OWN) / _bytes(group, PLAIN) for group in rows.values())
    return (
        at_most("kinds of clips that the records' codec changes", inexact, 0),
        at_most("its bytes against those of the rule's choice", excess, 1.02, note=f"the rule chooses {best.name}"),
        at_most(f"its bytes against {PLAIN}, worst kind", against, 1.0),
    )


def _of(rows: Sequence[CodecMeasurement], name: str) -> CodecMeasurement:
    return next(row for row in rows if row.codec.name == name)


def _bytes(rows: Sequence[CodecMeasurement], name: str) -> float:
    return _of(rows, name).bytes


def _codec_table(kind: str, rows: Sequence[CodecMeasurement]) -> Table:
    raw = _bytes(rows, "raw")
    return named_table(
        f"Codecs: {kind}",
        [
            {
                "codec": r.codec.name,
                "size": r.bytes,
                "of raw": r.bytes / raw,
                "written": r.write_fps,
                "read": r.read_fps,
                "exact": r.exact,
            }
            for r in rows
        ],
        formats={"size": ",.0f", "of raw": ".3f", "written": ",.0f", "read": ",.0f"},
        units={"size": "bytes a frame", "written": "frames/s", "read": "frames/s"},
        meanings={"exact": "every bit of every frame came back"},
        note="Medians over interleaved rounds, one core, files in the page cache.",
    )


def _other_tables(
    filters: Mapping[str, Mapping[str, int]], parts: Mapping[str, float], rates: Mapping[tuple[int, str], float]
) -> tuple[Table, ...]:
    changes = list(dict.fromkeys(name for _, name in rates))
    by_workers = {w: {name: rates[w, name] for name in changes} for w in dict.fromkeys(w for w, _ in rates)}
    return (
        named_table(
            "The difference with the smallest residual",
            [{"clips": kind, **counts} for kind, counts in filters.items()],
            formats=dict.fromkeys(next(iter(filters.values())), "d"),
            note="Smallest mean of |residual|, as in the PNG specification.",
        ),
        named_table(
            "Time of the parts of a clip",
            [{"part": part, "time": ms} for part, ms in parts.items()],
            formats={"time": ".2f"},
            units={"time": "ms of one core"},
            note="The first three make a clip; each of the others is the cost of an augmentation.",
        ),
        named_table(
            "Clips a second from the feed",
            [{"reading processes": str(workers), **row} for workers, row in by_workers.items()],
            formats=dict.fromkeys(changes, ".0f"),
            units=dict.fromkeys(changes, "/s"),
            note="One feed after the other; reading processes share the cores that the run has.",
        ),
    )


def _picture(number: int, kind: str, every: Sequence[CodecMeasurement]) -> Picture:
    rows = [row for row in every if row.exact]
    own = _of(rows, OWN)
    panels = []
    for label, rate in (("read", lambda row: row.read_fps), ("written", lambda row: row.write_fps)):
        series = []
        for codecs in dict.fromkeys(row.codec.kind for row in rows):
            group = [row for row in rows if row.codec.kind == codecs]
            names = [row.codec.name.removesuffix(" zstd-1") for row in group]
            series.append(Series(codecs, x=[*map(rate, group)], y=[r.bytes for r in group], labels=names, line=""))
        series.append(Series(x=[rate(own)], y=[own.bytes], marker="o", hollow=True, size=130, colour="black"))
        panels.append(
            Panel(
                series,
                x_label=f"frames {label} a second of one core",
                y_label="bytes a frame" if label == "read" else "",
                x_scale="log",
                y_scale="log",
                y_format="{x:,.0f}",
                rules=[Rule(x=NEED_FPS, colour=SHARED)] if label == "read" else [],
                better=("higher", "lower"),
            )
        )
    return Picture(
        name=f"pareto_storage_{number}",
        title=f"Size against rate: {kind}",
        caption="Ringed: the records' codec. The dotted line is the read rate that the rule requires. Codecs that lose "
        "bits are left out.",
        content=draw(panels, share_y=True, size=(11.0, 6.4)),
    )


SMOKE = StorageConfig(
    scenes=SceneConfig(objects=4, sites=1, frames=8),
    contacts=1,
    rounds=2,
    feed=FeedConfig(scenes=SceneConfig(objects=4, sites=1), contacts=2, batch_size=4, batches=2, workers=(0,)),
)

EXPERIMENT = Experiment(name="pareto_storage", config=StorageConfig(), scales={"smoke": SMOKE}, run=run)
