"""Which lossless codec should records use, and how fast do clips come from them?

    python -m experiments pareto_storage --data-dir DIR [--scale smoke]

Raw frames, zstd and its kin, byte shuffle, differences in time, along rows and columns, the records' own codec (the
difference that a clip wants, then zstd-1), PNG, WebP, HuffYUV and FFV1, on generated scenes and, where DIR holds the
folders physiclear and gelslam, on real videos and on stills of a real camera: bytes a frame against frames written and
read a second, on one core, every codec in turn within each round.  A codec counts only where every bit comes back.
Then the feed: where the time of a clip goes, what each augmentation adds, and the rate with reading processes.

The rule for the default, set before looking: of the codecs that read what training asks for (`training_fps` frames a
second) on at most `core_share` of a core, generated and as imported, the one of fewest bytes in the mean of their
ratios to raw frames.

Cost: four minutes on one core; `--scale smoke` under one, without recordings.

Expected: the records' own codec, at half to two thirds of the bytes of zstd-1, read as fast.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.context import Context
from experiments.core.look import SHARED
from experiments.core.results import Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.scenes.storage_codecs import (
    OWN,
    PLAIN,
    Codec,
    CodecMeasurement,
    all_codecs,
    chosen_filters,
    front,
    measure,
)
from experiments.scenes.storage_feed import FeedConfig, feed_rates, make_store, stage_ms
from sensors_io.importers.keep import Keep
from sensors_io.importers.pictures import numbered, read_picture
from sensors_io.importers.video import read_video
from sensors_io.live import LiveScenes
from sensors_io.scenes.config import SceneConfig

GENERATED, IMPORTED, WHOLE, STILLS = "generated", "videos as imported", "videos, whole frames", "camera stills"
"""Kinds of clips, and what is found where: `<data_dir>/physiclear/videos`, `<data_dir>/gelslam/6.310mm`."""


Rows = Mapping[str, Sequence[CodecMeasurement]]
"""Kind of clips → codecs measured on them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StorageConfig:
    """Clips to store, and the feed to time.

    Args:
      data_dir: folder of recordings; None for generated scenes alone.
      scenes: generated clips.
      contacts: of them.
      videos: real ones.
      frames: of a real one in whole frames.
      rounds: of timing.
      feed: the feed.
      training_fps: what training reads, frames a second: clips of 8 frames of 4 sensors, 50 a second.
      core_share: of a core that reading them may take.
    """

    data_dir: Path | None = None
    scenes: SceneConfig = dataclasses.field(default_factory=lambda: SceneConfig(objects=4, sites=1, frames=90))
    contacts: int = 2
    videos: int = 6
    frames: int = 48
    rounds: int = 3
    feed: FeedConfig = dataclasses.field(default_factory=lambda: FeedConfig(scenes=SceneConfig(objects=32, sites=1)))
    training_fps: float = 1600
    core_share: float = 0.15


def run(config: StorageConfig, context: Context) -> Results:
    """Store, feed, compare."""
    clips = {GENERATED: generated_clips(config.scenes, context.each("making scenes", range(config.contacts)))}
    if config.data_dir is not None:
        clips |= recorded_clips(config.data_dir, config.videos, config.frames, context)
    rows: dict[str, list[CodecMeasurement]] = {}
    missing: dict[str, str] = {}
    for kind, group in clips.items():
        context.print(f"{kind}: {len(group)} clips, {sum(map(len, group))} frames")
        rows[kind], absent = measure(all_codecs(), group, config.rounds, context)
        missing |= absent
    store = make_store(config.feed, context.directory / "records", context)
    stages = stage_ms(config.feed, store, context.rounds("timing the parts of a clip", config.rounds))
    rates = feed_rates(config.feed, store, config.rounds, context)
    need = config.training_fps / config.core_share
    best = fastest_small(rows, need)
    filters = {kind: chosen_filters(context.each(f"filters, {kind}", group)) for kind, group in clips.items()}
    return Results(
        verdict=verdict(rows, best, need, stages, rates),
        requirements=requirements(rows, best),
        tables=(*(_table(kind, r) for kind, r in rows.items()), _filters(filters), _stages(stages), _rates(rates)),
        pictures=tuple(_picture(n, *row, need) for n, row in context.each("drawing", enumerate(rows.items()))),
        settings={
            "rule": f"reads {need:,.0f} frames/s: {config.training_fps:,.0f} on {config.core_share:.0%} of a core",
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

    Videos are evenly spread over the folder.  They were compressed with loss before; the stills were not.

    Args:
      data_dir: folder of recordings.
      videos: how many are read.
      frames: at most so many of each video in whole frames.
      context: shows how far it is.
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


def requirements(rows: Rows, best: Codec) -> tuple[Requirement, ...]:
    """That records lose nothing, and that no other codec should take their place."""
    inexact = sum(not row.exact for group in rows.values() for row in group if row.codec.name == OWN)
    kinds = [kind for kind in (GENERATED, IMPORTED) if kind in rows]
    excess = max(_of(rows[kind], OWN).bytes / _of(rows[kind], best.name).bytes for kind in kinds)
    against = max(_of(group, OWN).bytes / _of(group, PLAIN).bytes for group in rows.values())
    return (
        Requirement(name="kinds of clips that the records' codec changes", measured=inexact, bound=0, better="lower"),
        Requirement(
            name="its bytes against those of the rule's choice",
            measured=excess,
            bound=1.02,
            better="lower",
            note=f"the rule chooses {best.name}",
        ),
        Requirement(name=f"its bytes against {PLAIN}, worst kind", measured=against, bound=1.0, better="lower"),
    )


def verdict(
    rows: Rows, best: Codec, need_fps: float, stages: Mapping[str, float], rates: Mapping[tuple[int, str], float]
) -> tuple[str, ...]:
    """The answer in sentences."""
    sizes = ", ".join(
        f"{kind} {_of(group, OWN).bytes / _of(group, 'raw').bytes:.2f} ({PLAIN} {_ratio(group):.2f})"
        for kind, group in rows.items()
    )
    lossy = sorted({row.codec.name for group in rows.values() for row in group if not row.exact})
    slowest = max(("read, decompress", "verify, decode", "choose, resize"), key=lambda part: stages[part])
    own = min(_of(group, OWN).read_fps for kind, group in rows.items() if kind in (GENERATED, IMPORTED))
    return (
        f"Of the codecs that read {need_fps:,.0f} frames/s the rule chooses {best.name}; records use {OWN}, which "
        f"reads {own:,.0f}.",
        f"Its bytes as a share of the raw frames: {sizes}.",
        f"Not lossless through OpenCV, and left out: {', '.join(lossy)}."
        if lossy
        else "Every codec gave every bit back.",
        f"A clip of 8 frames of 4 sensors costs {sum(list(stages.values())[:3]):.1f} ms of one core, most of it to "
        f"{slowest}; the feed gives {rates[0, 'as recorded']:.0f} clips/s without reading processes, "
        f"{rates[0, 'all of these']:.0f} with every augmentation.",
    )


def _of(rows: Sequence[CodecMeasurement], name: str) -> CodecMeasurement:
    return next(row for row in rows if row.codec.name == name)


def _ratio(rows: Sequence[CodecMeasurement]) -> float:
    return _of(rows, PLAIN).bytes / _of(rows, "raw").bytes


def _table(kind: str, rows: Sequence[CodecMeasurement]) -> Table:
    raw = _of(rows, "raw").bytes
    return Table(
        title=f"Codecs: {kind}",
        columns=(
            Column(name="codec"),
            Column(name="size", unit="bytes a frame", format=",.0f"),
            Column(name="of raw", format=".3f"),
            Column(name="written", unit="frames/s", format=",.0f"),
            Column(name="read", unit="frames/s", format=",.0f"),
            Column(name="exact", meaning="every bit of every frame came back"),
        ),
        rows=tuple((r.codec.name, r.bytes, r.bytes / raw, r.write_fps, r.read_fps, r.exact) for r in rows),
        note="Medians over rounds that visit every codec in turn, one core, files in the page cache.",
    )


def _filters(filters: Mapping[str, Mapping[str, int]]) -> Table:
    names = list(next(iter(filters.values())))
    return Table(
        title="The difference that clips want",
        columns=(Column(name="clips"), *(Column(name=name, format="d") for name in names)),
        rows=tuple((kind, *(counts[name] for name in names)) for kind, counts in filters.items()),
        note="Chosen by the smallest mean of |residual|, as in the PNG specification.",
    )


def _stages(stages: Mapping[str, float]) -> Table:
    return Table(
        title="Where the time of a clip goes",
        columns=(Column(name="part"), Column(name="time", unit="ms of one core", format=".2f")),
        rows=tuple(stages.items()),
        note="The first three make a clip; each of the others is what an augmentation adds to it.",
    )


def _rates(rates: Mapping[tuple[int, str], float]) -> Table:
    changes = list(dict.fromkeys(name for _, name in rates))
    return Table(
        title="Clips a second from the feed",
        columns=(Column(name="reading processes"), *(Column(name=name, unit="/s", format=".0f") for name in changes)),
        rows=tuple((str(w), *(rates[w, name] for name in changes)) for w in dict.fromkeys(w for w, _ in rates)),
        note="One feed after the other; reading processes share the cores that the run has.",
    )


def _picture(number: int, kind: str, rows: Sequence[CodecMeasurement], need_fps: float) -> Picture:
    return Picture(
        name=f"pareto_storage_{number}",
        title=f"Size against rate: {kind}",
        caption="Ringed: what records use. The line joins those that no other one beats in size and read rate; the "
        "dotted line is the read rate that the rule asks for. Codecs that lose bits are left out.",
        content=_size_against_rates([row for row in rows if row.exact], need_fps),
    )


def _size_against_rates(rows: Sequence[CodecMeasurement], need_fps: float) -> bytes:
    """Bytes per frame over the read and over the write rate."""
    kinds: dict[str, list[CodecMeasurement]] = {}
    for row in rows:
        kinds.setdefault(row.codec.kind, []).append(row)
    best, own = front(rows), _of(rows, OWN)
    panels = []
    for label, rate in (("read", lambda row: row.read_fps), ("written", lambda row: row.write_fps)):
        codecs = [
            Series(
                kind,
                x=[rate(row) for row in group],
                y=[row.bytes for row in group],
                labels=[row.codec.name.removesuffix(" zstd-1") for row in group],
                line="",
            )
            for kind, group in kinds.items()
        ]
        ring = Series(x=[rate(own)], y=[own.bytes], marker="o", hollow=True, size=130, colour="black")
        beaten_by_none = Series(
            x=[rate(r) for r in best], y=[r.bytes for r in best], marker="", colour=SHARED, width=0.8
        )
        panels.append(
            Panel(
                [*codecs, ring, *([beaten_by_none] if label == "read" else [])],
                x_label=f"frames {label} a second of one core",
                y_label="bytes a frame" if label == "read" else "",
                x_scale="log",
                y_scale="log",
                y_format="{x:,.0f}",
                rules=[Rule(x=need_fps, colour=SHARED)] if label == "read" else [],
            )
        )
    return draw(panels, share_y=True, size=(11.0, 6.4))


DEFAULT = StorageConfig()
SMOKE = StorageConfig(
    scenes=SceneConfig(objects=4, sites=1, frames=8),
    contacts=1,
    rounds=2,
    feed=FeedConfig(scenes=SceneConfig(objects=4, sites=1), contacts=2, batch_size=4, batches=2, workers=(0,)),
)

EXPERIMENT = Experiment(name="pareto_storage", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
"""The experiment."""
