"""Can one laptop make a million four-sensor records with physics, in memory or on disk, and resume when killed?

    python -m experiments throughput_scenes
    python -m experiments throughput_scenes --scale full      (feeds all 1.32 million records: about twenty minutes)

A record is one frame of one sensor with its picture and fields.  They are fed without disk, at 112² and 448², and
written; the set is made again by a process that is killed five times at random moments, and compared bit for bit.
Clock rates depend on other load on the machine, processor times hardly.  The report also has the time of each part of a
record, the machine's lower bound, the frames left out, and labels predicted from force alone.

Cost: about four minutes on two cores; `--scale smoke` a minute and a half on one.

Expected: some 800 records a second at 112², so that the paper's 1.32 million records take half an hour and 36 GB.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Requirement, Results, Table, at_least, at_most, named_table
from experiments.core.runner import Experiment
from experiments.scenes import throughput_rates
from experiments.scenes.throughput_rates import RecordRate
from sensors_io.scenes import schedule
from sensors_io.scenes.cards import object_cards
from sensors_io.scenes.config import SceneConfig, stream
from sensors_io.scenes.press import padded_size
from sensors_io.scenes.protocol import plan
from sensors_io.scenes.sensors import MODELS
from sensors_io.schema import MATERIALS, PRESS_FORCE_N, SENSORS
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.validation import some_of

PAPER_OBJECTS, PAPER_SEQUENCES, PAPER_FRAMES = 1000, 14_700, 90
PAPER_RECORDS = PAPER_SEQUENCES * PAPER_FRAMES
FEED_RATE, LARGE_RATE, WRITTEN_HOURS = 400, 150, 1.5
"""Requirements: records a second as a feed of ordinary and of large pictures; hours to write the paper's set."""

KILLS, KILLED_RECORDS = 5, 20_000  # requirements on the killed writer: kills, records

Parts = Mapping[str, Mapping[str, float]]  # sensor → part of the work → milliseconds of one core a record


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThroughputConfig:
    """Sizes of the measurements."""

    image_px: int = 112  # side of the ordinary pictures
    large_px: int = 448  # side of the large ones
    frames: int = PAPER_FRAMES  # of a sequence
    contact_grid: int = 64  # of the contact solver
    feed_contacts: int = 56  # fed at `image_px`; a contact is 360 records
    large_contacts: int = 8  # fed at `large_px`
    written_contacts: int = 56  # written, and written again under kills
    kills: int = 5  # of the second writer, at random moments; it must write more shards than that
    stage_objects: int = 2  # over which the parts are timed, per sensor
    stage_sensors: tuple[str, ...] = SENSORS  # whose parts are timed
    leak_objects: int = PAPER_OBJECTS  # whose labels are predicted from force alone
    threads: int = 2  # that generate

    def __post_init__(self) -> None:
        some_of(self, "stage_sensors", SENSORS)

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


def run(config: ThroughputConfig, context: Context) -> Results:
    """Feed, write, kill, time the parts; what was measured before an interruption is not measured again."""
    feed = _feed(config, context, "feed/0", config.feed_contacts, config.image_px)
    large = _feed(config, context, "large/0", config.large_contacts, config.large_px)
    to_write = config.scenes(config.written_contacts, config.image_px)
    write = lambda: throughput_rates.write_and_kill(to_write, context, config.kills)
    written = context.once("written/0", write)
    rate = RecordRate(**written["rate"])
    scenes = config.scenes(config.feed_contacts, config.image_px)
    parts = {
        name: throughput_rates.part_costs(scenes, SENSORS.index(name), config.stage_objects)
        for name in context.each("timing parts", config.stage_sensors, still=True)
    }
    paper = SceneConfig(
        objects=config.leak_objects,
        sequences=len(SENSORS) * round(config.leak_objects * PAPER_SEQUENCES / len(SENSORS) / PAPER_OBJECTS),
    )
    with context.progress("planning the paper's set", 1) as advance:
        leaks = force_leaks(paper)
        advance()
    lost = sum(n for name, n in written["kept"].items() if name != "records")
    return Results(
        verdict=(
            f"A feed makes {feed.per_second:.0f} records/s ({feed.cpu_ms:.2f} ms of one core each), "
            f"{large.per_second:.0f} with the large pictures.",
            f"{lost} contacts are missing, repeated, damaged or different after {written['kills']} kills.",
        ),
        requirements=_requirements(feed, large, rate, written, max(leaks[-1][name] for name in ORDINAL)),
        tables=(
            _rate_table(config, feed, large, rate, written["bytes"]),
            _part_table(config, parts),
            _floor_table(config),
            left_out_table(paper),
            _leak_table(leaks),
        ),
        settings={"threads": config.threads, "frames": config.frames, "contact_grid": config.contact_grid},
        data={"feed_records": feed.records, "large_records": large.records, "written_records": rate.records},
        timing={"feeding": feed.seconds, "feeding large": large.seconds, "writing": rate.seconds},
    )


def _feed(config: ThroughputConfig, context: Context, stage: str, contacts: int, image_px: int) -> RecordRate:
    def measure() -> RecordRate:
        with context.progress(f"feeding {image_px}²", contacts) as advance:
            return throughput_rates.feed_rate(config.scenes(contacts, image_px), contacts, config.threads, advance)

    return RecordRate(**context.once(stage, measure))


# Force alone ---------------------------------------------------------------------------------------------------------


def force_leaks(config: SceneConfig) -> list[dict[str, Any]]:
    """Accuracy of labels predicted from the peak force of a press alone, by design of the protocol.

    The designs are frames past the limit dropped, dropped by shape alone, all kept, and matched (the default).  The
    accuracy is balanced, in percent, of the likeliest level given the force; chance is 33.3.
    """
    labels = np.array([[card.labels[name] for name in ORDINAL] for card in object_cards(config)])
    made = plan(config)
    matched = np.zeros(config.objects)
    for slot in made.slots:
        if slot.motion == "press":
            matched[slot.object_index] = slot.force_n
    designs = {
        "frames past the limit dropped": np.minimum(made.limits.actual_n, PRESS_FORCE_N),
        "dropped as if objects were rigid": np.minimum(made.limits.rigid_n, PRESS_FORCE_N),
        'all kept, flagged (past_limit="flag")': np.full(config.objects, PRESS_FORCE_N),
        "matched (the default)": matched,
    }
    jitter = 1 + config.force_jitter * stream(config.seed, "schedule").standard_normal(config.objects)
    return [
        {
            "design": name,
            **{label: 100 * _accuracy(np.log(peak * jitter), labels[:, a]) for a, label in enumerate(ORDINAL)},
            "median peak": float(np.median(peak)),
            "presses that reach 20 N": 100 * float(np.mean(peak >= PRESS_FORCE_N - 1e-6)),
        }
        for name, peak in designs.items()
    ]


def _accuracy(value: np.ndarray, label: np.ndarray, bins: int = 12, folds: int = 5) -> float:
    """Balanced accuracy of the likeliest level in bins of equal count, cross-validated; unknown labels are left out.

    Levels are weighted by the inverse of their share, so that a value without information scores a third.
    """
    value, label = value[label >= 0], label[label >= 0]
    rank = np.argsort(np.argsort(value)) * bins // len(value)
    fold = np.arange(len(value)) % folds
    hit = np.zeros(len(value))
    for k in range(folds):
        votes = np.zeros((bins, 3))
        np.add.at(votes, (rank[fold != k], label[fold != k]), 1)
        guess = (votes / np.maximum(votes.sum(0), 1)).argmax(1)
        hit[fold == k] = guess[rank[fold == k]] == label[fold == k]
    return float(np.mean([hit[label == level].mean() for level in np.unique(label)]))


def left_out_table(config: SceneConfig) -> Table:
    """Frames asked for, past the strain limit and replaced by material; those past the limit also by force band."""
    counts = plan(config).left_out
    material = np.array([card.labels["material"] for card in object_cards(config)])
    bands = [f"past, {low:g}–{high:g} N" for low, high in itertools.pairwise((0.0, *schedule.BANDS_N))]
    rows: list[dict[str, Cell]] = []
    groups = [*((name, material == i) for i, name in enumerate(MATERIALS)), ("all", np.ones(len(material), bool))]
    for name, chosen in groups:
        asked, past, replaced = (a[chosen].sum(0) for a in (counts.asked, counts.past_limit, counts.replaced))
        sums = {"asked": int(asked.sum()), "past the limit": int(past.sum()), "replaced": int(replaced.sum())}
        rows.append({"material": name, **sums, **{band: int(n) for band, n in zip(bands, past, strict=True)}})
    return named_table(
        "Frames past the strain limit, by material and force",
        rows,
        formats=dict.fromkeys(list(rows[0])[1:], "d"),
        note="Of one sensor of every contact.  Frames that only matching leaves out are also replaced.",
    )


# Report --------------------------------------------------------------------------------------------------------------


def _requirements(
    feed: RecordRate, large: RecordRate, rate: RecordRate, written: Mapping[str, Any], leak: float
) -> tuple[Requirement, ...]:
    hours, write_hours = (PAPER_RECORDS / r.per_second / 3600 for r in (feed, rate))
    kept = written["kept"]
    return (
        at_least("feed at 112²", feed.per_second, FEED_RATE, "records/s"),
        at_least("feed at 448²", large.per_second, LARGE_RATE, "records/s"),
        at_most("paper-sized set as a feed", hours, 1, "h"),
        at_most("paper-sized set written", write_hours, WRITTEN_HOURS, "h"),
        at_most("paper-sized set on disk", PAPER_RECORDS * written["bytes"] / 1e9, 60, "GB"),
        at_least("kills at random moments", written["kills"], KILLS),
        at_least("records written over the kills", kept["records"], KILLED_RECORDS),
        at_most("contacts missing after the kills", kept["missing"], 0),
        at_most("contacts there twice", kept["repeated"], 0),
        at_most("contacts damaged, by their checksums", kept["damaged"], 0),
        at_most("contacts unlike an undisturbed writer's", kept["differing"], 0),
        at_most("written frames past the strain limit", written["past_limit"], 0),
        at_most("ordinal labels from force alone", leak, 40, "% (chance 33)"),
    )


def _rate_table(
    config: ThroughputConfig, feed: RecordRate, large: RecordRate, written: RecordRate, written_bytes: float
) -> Table:
    rates = (
        (f"feed {config.image_px}²", feed, None),
        (f"feed {config.large_px}²", large, None),
        (f"written {config.image_px}²", written, written_bytes),
    )
    return named_table(
        "Rates",
        [
            {
                "how": name,
                "records": rate.records,
                "by the clock": rate.per_second,
                "one core": rate.cpu_ms,
                "two idle cores": 2000 / rate.cpu_ms,
                "1.32 million": PAPER_RECORDS / rate.per_second / 3600,
                "size": size,
            }
            for name, rate, size in rates
        ],
        formats=dict.fromkeys(("by the clock", "two idle cores", "size"), ".0f")
        | {"records": "d", "one core": ".2f", "1.32 million": ".2f"},
        units=dict.fromkeys(("by the clock", "two idle cores"), "records/s")
        | {"one core": "ms/record", "1.32 million": "h", "size": "bytes/record"},
        meanings={"two idle cores": "2 s over the time of one core"},
        note="The start, a minute of compiling and looking at objects, is left out.",
    )


def _part_table(config: ThroughputConfig, parts: Parts) -> Table:
    names = list(next(iter(parts.values())))
    return named_table(
        f"Time of the parts of a record, {config.image_px}²",
        [{"sensor": name, **costs} for name, costs in parts.items()],
        formats=dict.fromkeys(names, ".2f"),
        units=dict.fromkeys(names, "ms"),
        note="Milliseconds of one core, by timing the program with and without each part; friction only when moving.",
    )


def _floor_table(config: ThroughputConfig) -> Table:
    sensor, grid = MODELS[1], config.contact_grid
    padded = padded_size(grid, sensor.window_mm, sensor.gel.thickness_mm)
    sides = (config.image_px, config.large_px)
    rows = [{"picture": f"{px}²", **throughput_rates.picture_floor(padded, grid, px)} for px in sides]
    return named_table(
        "Lower bound for a picture of markers",
        rows,
        formats={"products": ".0f", "copies": ".1f", "pair of transforms": ".3f", "floor": ".2f"},
        units={"products": "GFLOP/s", "copies": "GB/s", "pair of transforms": "ms", "floor": "ms"},
        meanings={
            "pair of transforms": "one iteration of the contact solver",
            "floor": "four resampled planes, one pass over the picture",
        },
    )


def _leak_table(leaks: list[dict[str, Any]]) -> Table:
    reach = "presses that reach 20 N"
    return named_table(
        "Labels predicted from the peak force of a press",
        leaks,
        formats={**dict.fromkeys((*ORDINAL, reach), ".0f"), "median peak": ".1f"},
        units={**dict.fromkeys((*ORDINAL, reach), "%"), "median peak": "N"},
        note="Balanced accuracy of the likeliest level given the force; chance is 33 %.  Rejecting flagged frames is "
        "the same as dropping them.",
    )


SMOKE = ThroughputConfig(
    image_px=32,
    large_px=48,
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
