"""Can a million four-sensor records with physics behind them be made on one laptop, fed or written, and resumed?

    python -m experiments throughput_scenes
    python -m experiments throughput_scenes --scale full      (feeds all 1.32 million records: about twenty minutes)

Measures records a second, one record being one frame of one sensor with its picture and fields: as a feed without
disk, at 112² and 448², over the protocol's mix of presses and motions; as a written set, which is then made again by a
process that is killed five times at random moments, and compared entry by entry, bit for bit.  Clock rates depend on
who else uses the machine, processor times hardly.  Says where the time goes, what the machine's floor is, what the
protocol left out, and what force alone tells.

Cost: about four minutes on two cores; `--scale smoke` a minute and a half on one.

Expected: some 800 records a second at 112², so that the paper's 1.32 million records take half an hour and 36 GB.
"""

import dataclasses
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.context import Context
from experiments.core.look import SHARED
from experiments.core.results import Cell, Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.scenes import force_leaks, killed_writer, throughput_rates
from experiments.scenes.killed_writer import ResumedSet
from experiments.scenes.throughput_rates import RecordRate
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.press import padded_size
from sensors_io.scenes.sensors import MODELS
from sensors_io.schema import SENSORS, Flag

PAPER_OBJECTS, PAPER_SEQUENCES, PAPER_FRAMES = 1000, 14_700, 90
PAPER_RECORDS = PAPER_SEQUENCES * PAPER_FRAMES
FEED_RATE, LARGE_RATE, WRITTEN_HOURS = 400, 150, 1.5
"""Requirements: records a second as a feed of ordinary and of large pictures; hours to write the paper's set."""

KILLS, KILLED_RECORDS = 5, 20_000
"""Requirements on the killed writer: kills, records."""

Stages = Mapping[str, Mapping[str, float]]
"""Sensor → part of the work → milliseconds of one core a record."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThroughputConfig:
    """Sizes of the measurements.

    Args:
      image_px: side of the ordinary pictures.
      large_px: side of the large ones.
      frames: of a sequence.
      contact_grid: of the contact solver.
      feed_contacts: fed at `image_px`; a contact is 360 records.
      large_contacts: fed at `large_px`.
      written_contacts: written, and written again under kills.
      kills: of the second writer, at random moments; it must write more shards than that.
      stage_objects: over which the stages are timed, per sensor.
      stage_sensors: whose stages are timed.
      leak_objects: pressed in the look at what force tells.
      threads: that generate.
      seed: of the moments of the kills.
    """

    image_px: int = 112
    large_px: int = 448
    frames: int = PAPER_FRAMES
    contact_grid: int = 64
    feed_contacts: int = 56
    large_contacts: int = 8
    written_contacts: int = 56
    kills: int = 5
    stage_objects: int = 2
    stage_sensors: tuple[str, ...] = SENSORS
    leak_objects: int = PAPER_OBJECTS
    threads: int = 2
    seed: int = 0

    def scenes(self, contacts: int, image_px: int) -> SceneConfig:
        """The protocol over so many contacts, with the paper's share of presses."""
        objects = max(4, round(contacts * PAPER_OBJECTS * len(SENSORS) / PAPER_SEQUENCES))
        return SceneConfig(
            objects=objects,
            sequences=len(SENSORS) * max(contacts, objects + len(SENSORS)),
            frames=self.frames,
            image_px=image_px,
            contact_grid=self.contact_grid,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class WrittenSet:
    """The written set: its rate, bytes per record, frames past the strain limit; kills of its second writer, and what
    they left.
    """

    rate: RecordRate
    bytes: float
    past_limit: int
    kills: int
    kept: ResumedSet


def run(config: ThroughputConfig, context: Context) -> Results:
    """Feed, write, kill, take apart; what was measured before an interruption is not measured again."""
    feed = RecordRate(**_once(context, "feed/0", lambda: _feed(config, context, config.feed_contacts, config.image_px)))
    large = RecordRate(
        **_once(context, "large/0", lambda: _feed(config, context, config.large_contacts, config.large_px))
    )
    found = _once(context, "written/0", lambda: _written(config, context))
    written = WrittenSet(**found | {"rate": RecordRate(**found["rate"]), "kept": ResumedSet(**found["kept"])})
    stages = _stages(config, context)
    floor = _floor_table(config)
    paper = SceneConfig(
        objects=config.leak_objects,
        sequences=len(SENSORS) * round(config.leak_objects * PAPER_SEQUENCES / len(SENSORS) / PAPER_OBJECTS),
    )
    with context.progress("planning the paper's set", 1) as advance:
        leaks = force_leaks.leaks(paper)
        advance()
    return Results(
        verdict=_verdict(feed, large, written),
        requirements=_requirements(feed, large, written, leaks),
        tables=(
            _rate_table(config, feed, large, written),
            _stage_table(config, stages),
            floor,
            _left_out_table(paper),
            _leak_table(leaks),
        ),
        pictures=(_picture(config, feed, large, written, stages),),
        settings={"threads": config.threads, "frames": config.frames, "contact_grid": config.contact_grid},
        data={"feed_records": feed.records, "large_records": large.records, "written_records": written.rate.records},
        timing={"feed_s": feed.seconds, "large_s": large.seconds, "written_s": written.rate.seconds},
    )


def _once(context: Context, stage: str, measure: Callable[[], RecordRate | WrittenSet]) -> dict[str, Any]:
    """The fields of a measurement, from the run's directory where it was made before."""
    if not context.done(stage):
        context.save_stage(stage, dataclasses.asdict(measure()))
    found: dict[str, Any] = context.load_stage(stage)
    return found


def _feed(config: ThroughputConfig, context: Context, contacts: int, image_px: int) -> RecordRate:
    with context.progress(f"feeding {image_px}²", contacts) as advance:
        return throughput_rates.feed_rate(config.scenes(contacts, image_px), contacts, config.threads, advance)


def _written(config: ThroughputConfig, context: Context) -> WrittenSet:
    """Write the set once undisturbed and once with kills; the copies are removed after the comparison."""
    scenes = config.scenes(config.written_contacts, config.image_px)
    home = context.directory / "written"
    shutil.rmtree(home, ignore_errors=True)
    whole, killed = home / "whole", home / "killed"
    with context.progress("writing", scenes.contact_count) as advance:
        rate, size = throughput_rates.write_rate(scenes, whole, advance)
    shards = len(list(whole.glob("contacts-*")))
    with context.progress("killing and going on", config.kills + 1) as advance:
        kills = killed_writer.killed_and_resumed(
            _arguments(scenes),
            killed,
            kills=config.kills,
            shards=shards,
            shard_s=rate.seconds / shards,
            seed=config.seed,
            advance=advance,
        )
    with context.progress("comparing", scenes.contact_count) as advance:
        kept = killed_writer.compare(whole, killed, advance)
    past = _past_limit(whole, context)
    shutil.rmtree(home)
    return WrittenSet(rate=rate, bytes=size, past_limit=past, kills=kills, kept=kept)


def _arguments(scenes: SceneConfig) -> list[str]:
    """The command line that makes the same set."""
    named = ("objects", "sequences", "frames", "image_px", "contact_grid")
    return [text for name in named for text in (f"--{name.replace('_', '-')}", str(getattr(scenes, name)))]


def _past_limit(path: Path, context: Context) -> int:
    store = RecordStore(path)
    rows = context.each("reading flags", range(len(store)))
    flags = [s.flags for i in rows for s in store.contact(i, fields=False).values()]
    return int((np.concatenate(flags) & np.uint32(Flag.STRAIN_LIMIT) > 0).sum())


def _verdict(feed: RecordRate, large: RecordRate, written: WrittenSet) -> tuple[str, ...]:
    hours = PAPER_RECORDS / feed.per_second / 3600
    write_hours, size = PAPER_RECORDS / written.rate.per_second / 3600, PAPER_RECORDS * written.bytes / 1e9
    return (
        f"A feed makes {feed.per_second:.0f} records/s ({feed.cpu_ms:.2f} ms of one core each), "
        f"{large.per_second:.0f} with the large pictures ({large.cpu_ms:.2f} ms): 1.32 million in {hours:.2f} h.",
        f"Written, they take {write_hours:.2f} h and {size:.1f} GB, {written.bytes / 1e3:.1f} kB each.",
        f"Kills at random moments: {written.kills}; the writer left {written.kept.records:,} records; "
        f"{_lost(written.kept)} contacts are missing, there twice, damaged, or unlike those of an undisturbed writer.",
    )


def _requirements(
    feed: RecordRate, large: RecordRate, written: WrittenSet, leaks: list[force_leaks.ForceLeak]
) -> tuple[Requirement, ...]:
    def needs(name: str, measured: float, bound: float, better: Literal["lower", "higher"], unit: str) -> Requirement:
        return Requirement(name=name, measured=measured, bound=bound, better=better, unit=unit)

    hours, write_hours = (PAPER_RECORDS / r.per_second / 3600 for r in (feed, written.rate))
    worst = max(leaks[-1].accuracy)
    return (
        needs("feed at 112²", feed.per_second, FEED_RATE, "higher", "records/s"),
        needs("feed at 448²", large.per_second, LARGE_RATE, "higher", "records/s"),
        needs("paper-sized set as a feed", hours, 1, "lower", "h"),
        needs("paper-sized set written", write_hours, WRITTEN_HOURS, "lower", "h"),
        needs("paper-sized set on disk", PAPER_RECORDS * written.bytes / 1e9, 60, "lower", "GB"),
        needs("kills at random moments", written.kills, KILLS, "higher", ""),
        needs("records written over the kills", written.kept.records, KILLED_RECORDS, "higher", ""),
        needs("contacts missing after the kills", written.kept.missing, 0, "lower", ""),
        needs("contacts there twice", written.kept.repeated, 0, "lower", ""),
        needs("contacts damaged, by their checksums", written.kept.damaged, 0, "lower", ""),
        needs("contacts unlike an undisturbed writer's", written.kept.differing, 0, "lower", ""),
        needs("written frames past the strain limit", written.past_limit, 0, "lower", ""),
        needs("ordinal labels from force alone", worst, 40, "lower", "% (chance 33)"),
    )


def _lost(kept: ResumedSet) -> int:
    return kept.missing + kept.repeated + kept.damaged + kept.differing


def _rate_table(config: ThroughputConfig, feed: RecordRate, large: RecordRate, written: WrittenSet) -> Table:
    def row(name: str, rate: RecordRate, size: float | None) -> tuple[Cell, ...]:
        hours = PAPER_RECORDS / rate.per_second / 3600
        return (name, rate.records, rate.per_second, rate.cpu_ms, 2000 / rate.cpu_ms, hours, size)

    return Table(
        title="Rates",
        columns=(
            Column(name="how"),
            Column(name="records", format="d"),
            Column(name="by the clock", unit="records/s", format=".0f"),
            Column(name="one core", unit="ms/record", format=".2f"),
            Column(name="two idle cores", unit="records/s", format=".0f", meaning="2 s over the time of one core"),
            Column(name="1.32 million", unit="h", format=".2f"),
            Column(name="size", unit="bytes/record", format=".0f"),
        ),
        note="The start, a minute of compiling and looking at objects, is left out.",
        rows=(
            row(f"feed {config.image_px}²", feed, None),
            row(f"feed {config.large_px}²", large, None),
            row(f"written {config.image_px}²", written.rate, written.bytes),
        ),
    )


def _picture(
    config: ThroughputConfig, feed: RecordRate, large: RecordRate, written: WrittenSet, stages: Stages
) -> Picture:
    measured: tuple[tuple[Any, ...], ...] = (
        (f"feed {config.image_px}²", feed.per_second, FEED_RATE),
        (f"feed {config.large_px}²", large.per_second, LARGE_RATE),
        (f"written {config.image_px}²", written.rate.per_second, PAPER_RECORDS / WRITTEN_HOURS / 3600),
    )
    names, rates, required = ([row[i] for row in measured] for i in range(3))
    parts = next(iter(stages.values()))
    panels = [
        Panel(
            [
                Series(x=rates, bar=True),
                Series("required", x=required, line="", marker="|", size=300, colour=SHARED),
            ],
            rows=names,
            x_label="records/s by the clock",
            written=".0f",
        ),
        Panel(
            [Series(part, x=[max(costs[part], 0.0) for costs in stages.values()], bar=True) for part in parts],
            rows=list(stages),
            stacked=True,
            x_label="ms of one core a record",
        ),
    ]
    return Picture(
        name="throughput",
        title="How fast, and what takes the time",
        caption=f"Records a second on {config.threads} threads; the work on a record with a picture of "
        f"{config.image_px}², friction where the object moves.",
        content=draw(panels, size=(8.6, 1.1 + 0.34 * max(len(measured), len(stages) + 1))),
    )


def _stages(config: ThroughputConfig, context: Context) -> Stages:
    scenes = config.scenes(config.feed_contacts, config.image_px)
    stages = {}
    for name in context.each("timing stages", config.stage_sensors, still=True):
        cost = throughput_rates.stage_costs(scenes, SENSORS.index(name), config.stage_objects)
        stages[name] = {
            "pressure": cost.normal,
            "friction": cost.friction,
            "fields": cost.fields,
            "picture": cost.picture,
        }
    return stages


def _stage_table(config: ThroughputConfig, stages: Stages) -> Table:
    parts = next(iter(stages.values()))
    return Table(
        title=f"Where the time of a record goes, {config.image_px}²",
        columns=(
            Column(name="sensor"),
            *(Column(name=n, unit="ms", format=".2f") for n in parts),
        ),
        rows=tuple((name, *costs.values()) for name, costs in stages.items()),
        note="Milliseconds of one core, by timing the program with and without each part; friction only when moving.",
    )


def _floor_table(config: ThroughputConfig) -> Table:
    """Time of the counted operations and bytes of a picture and of a solve at the machine's measured rates."""
    sensor, grid = MODELS[1], config.contact_grid
    padded = padded_size(grid, sensor.window_mm, sensor.gel.thickness_mm)
    rows: list[tuple[Cell, ...]] = []
    for px in (config.image_px, config.large_px):
        machine = throughput_rates.measure_machine(padded, grid, px)
        flops = 4 * 2 * (px * grid * grid + px * grid * px)
        size = px * px * 3 * 5  # each float of the picture written once, one byte of the result
        floor = 1e3 * (flops / machine.flops_per_s + size / machine.bytes_per_s)
        rows.append((f"{px}²", machine.flops_per_s / 1e9, machine.bytes_per_s / 1e9, 1e3 * machine.transform_s, floor))
    return Table(
        title="Floor of a picture of markers",
        columns=(
            Column(name="picture"),
            Column(name="products", unit="GFLOP/s", format=".0f"),
            Column(name="copies", unit="GB/s", format=".1f"),
            Column(name="pair of transforms", unit="ms", format=".3f", meaning="one iteration of the contact solver"),
            Column(name="floor", unit="ms", format=".2f", meaning="four resampled planes, one pass over the picture"),
        ),
        rows=tuple(rows),
    )


def _left_out_table(paper: SceneConfig) -> Table:
    bands, rows = force_leaks.left_out_by_material(paper)
    counts = ("asked", "past the limit", "replaced", *(f"past, {band}" for band in bands))
    return Table(
        title="Frames past the strain limit, by material and force",
        columns=(Column(name="material"), *(Column(name=name, format="d") for name in counts)),
        rows=tuple(rows),
        note="Of one sensor of every contact.  Replaced are also frames that only matching leaves out.",
    )


def _leak_table(leaks: list[force_leaks.ForceLeak]) -> Table:
    return Table(
        title="What the peak force of a press tells",
        columns=(
            Column(name="design"),
            *(Column(name=name, unit="%", format=".0f") for name in force_leaks.ORDINAL),
            Column(name="median peak", unit="N", format=".1f"),
            Column(name="presses that reach 20 N", unit="%", format=".0f"),
        ),
        rows=tuple((leak.design, *leak.accuracy, leak.median_n, 100 * leak.full_share) for leak in leaks),
        note="Balanced accuracy of the likeliest level given the force; chance is 33 %.  Flagging frames and then "
        "rejecting them is dropping them.",
    )


SMOKE = ThroughputConfig(
    image_px=32,
    large_px=32,
    frames=20,
    contact_grid=24,
    feed_contacts=4,
    large_contacts=2,
    written_contacts=40,
    kills=1,
    stage_objects=1,
    stage_sensors=("tac3d",),
    leak_objects=40,
)

EXPERIMENT = Experiment(
    name="throughput_scenes",
    config=ThroughputConfig(),
    run=run,
    scales={"smoke": SMOKE, "full": dataclasses.replace(ThroughputConfig(), feed_contacts=PAPER_SEQUENCES // 4)},
)
