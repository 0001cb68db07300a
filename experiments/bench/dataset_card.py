"""Is the bench of questions fit to score anybody on: no leak, no free answers, every rationale borne out?

    make experiment EXP=dataset_card
    make experiment EXP=dataset_card ARGS="--data records --data-dir RECORDS"

Makes the bench of 4,800 questions about the 200 test objects of a thousand, four tiers and seven kinds, words it from
what was measured, sifts it by the rules, and holds it to the data card.  A check that fails ends the run with an error.
Faults of every kind are then planted, which the rules must catch, and the bench is made twice.  It lies in the run as
`items.jsonl`; `python -m experiments.bench --help` makes, words, annotates and audits others.

Cost: some three minutes on one core, most of it for the scenes; `--scale smoke` a few seconds.

Expected: all checks pass; no constant beats chance by three points.  The sensors' numbers, read by one threshold each,
say what the label says for about half of the questions, material least.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.bench import card
from experiments.bench.card_charts import answer_shares
from experiments.bench.draw import Quota
from experiments.bench.generate import BenchSource, generate, read_source, share_at_odds
from experiments.bench.rules import FilteredItems, count_found_errors
from experiments.core.context import Context
from experiments.core.results import Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.study.sources import Source, SourceConfig, prepare_records
from sensors_io.importers.physiclear import PhysiclearConfig
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.bench.items import KINDS, Item, write_items


@dataclasses.dataclass(frozen=True, kw_only=True)
class DatasetCardConfig:
    """Which records, how many questions, how many of them get faults planted."""

    data: Source = "generated"
    data_dir: Path | None = None
    scenes: SceneConfig = SceneConfig(objects=1000, sites=2)
    physiclear: PhysiclearConfig = PhysiclearConfig()
    quota: Quota = Quota()
    seed: int = 0
    faulty: int = 700


def run(config: DatasetCardConfig, context: Context) -> Results:
    """Make the bench, check it, report."""
    where = SourceConfig(
        kind=config.data, directory=config.data_dir, scenes=config.scenes, physiclear=config.physiclear
    )
    store = RecordStore(prepare_records(where, context))
    with context.timed("measure"), context.progress("measuring contacts", _contacts(store)) as advance:
        source = read_source(store, after_each=advance)
    with context.timed("generate"):
        found, again = (
            generate(source, config.quota, config.seed) for _ in context.each("making the bench twice", range(2))
        )
    checks = card.checks(found.kept, source.bench, source.train)
    card.require(checks)
    write_items(context.directory / "items.jsonl", found.kept)
    with context.timed("faults"):
        step = max(1, len(found.kept) // config.faulty)
        sound = found.kept[::step]
        caught = count_found_errors(context.each("planted faults", sound), source.bench.by_touch())
    return _findings(
        config, source, found, checks, {rule: n / len(sound) for rule, n in caught.items()}, again == found
    )


def _contacts(store: RecordStore) -> int:
    return sum(len(store.contacts_of_split(split)) for split in ("test", "train"))


def _findings(
    config: DatasetCardConfig,
    source: BenchSource,
    found: FilteredItems,
    checks: Sequence[card.CardCheck],
    caught: dict[str, float],
    same: bool,
) -> Results:
    items, odd = found.kept, share_at_odds(found.kept)
    shown = {touch.object for item in items for touch in item.ask.touches}
    return Results(
        verdict=(
            f"{len(items):,} questions about {len(shown)} objects that no training contact shows pass all "
            f"{len(checks)} checks; the rules removed {len(found.removed)}.",
            f"Of {len(items[:: max(1, len(items) // config.faulty)])} items with a planted fault each rule names at "
            f"least {100 * min(caught.values()):.1f} %.",
            f"In {100 * odd:.0f} % of the questions the sensors' numbers, each read by one threshold, do not say the "
            "answer: these stay, or the bench would hold only what a threshold can answer.",
        ),
        requirements=(
            Requirement(
                name="questions", measured=len(items), bound=config.quota.total, better="higher", note="of the quota"
            ),
            Requirement(name="made twice, the same bytes", measured=float(same), bound=1, better="higher"),
            Requirement(
                name="planted faults caught, the worst rule",
                measured=100 * min(caught.values()),
                bound=100,
                better="higher",
                unit="%",
            ),
            *(
                Requirement(
                    name=c.name, measured=c.measured, bound=c.bound, better="lower", unit=c.unit, note=c.meaning
                )
                for c in checks
            ),
        ),
        tables=(
            _kinds(items),
            _shares(items),
            _rules(found, caught),
            _readings(source),
            _coverage(source),
            _samples(items),
        ),
        pictures=(
            Picture(
                name="answers",
                title="Answers",
                caption="Each bar is a kind and an attribute; colours are levels in their order, from the left.",
                content=answer_shares(card.shares(items)),
            ),
        ),
        data=_data(source),
    )


def _data(source: BenchSource) -> dict[str, Any]:
    return {
        "test_objects": len(source.bench.objects()),
        "test_contacts": len(source.bench.contacts),
        "training_objects": len(source.train.objects()),
        "training_contacts": len(source.train.contacts),
        "recordings_without_contact": sum(source.bench.skipped.values()) + sum(source.train.skipped.values()),
    }


def _kinds(items: Sequence[Item]) -> Table:
    rows = []
    for kind, about in KINDS.items():
        of = [item for item in items if item.ask.kind == kind]
        if of:
            objects = {touch.object for item in of for touch in item.ask.touches}
            odd = 100 * share_at_odds(tuple(of))
            rows.append((kind, about.tier, len(of), len(objects), about.view, odd, about.meaning))
    return Table(
        title="Questions",
        columns=(
            Column(name="kind"),
            Column(name="tier"),
            Column(name="questions"),
            Column(name="objects"),
            Column(name="picture shown"),
            Column(name="at odds", unit="%", format=".0f", meaning=_ODD),
            Column(name="asks for"),
        ),
        rows=tuple(rows),
    )


_ODD = "questions whose answer the sensors' numbers, each read by one threshold, do not say together"


def _shares(items: Sequence[Item]) -> Table:
    rows = card.shares(items)
    return Table(
        title="Answers",
        columns=(
            Column(name="kind"),
            Column(name="attribute"),
            Column(name="questions"),
            Column(name="answers", meaning="how often each level is right, in the order of the levels"),
            Column(name="commonest", unit="%", format=".1f"),
        ),
        rows=tuple(
            (r.kind, r.attribute, r.questions, " ".join(map(str, r.counts)), 100 * max(r.counts) / r.questions)
            for r in rows
        ),
    )


def _rules(found: FilteredItems, caught: dict[str, float]) -> Table:
    return Table(
        title="Rules",
        columns=(
            Column(name="rule"),
            Column(name="removed", meaning="of the questions worded by rule"),
            Column(name="planted faults caught", unit="%", format=".1f"),
        ),
        rows=tuple((rule, count, 100 * caught[rule]) for rule, count in found.counts.items()),
    )


def _readings(source: BenchSource) -> Table:
    rows = []
    for (sensor, attribute), scale in sorted(source.reader.thresholds.items()):
        right: dict[int, list[bool]] = {}
        for contact in source.bench.contacts:
            if attribute in contact.labels and source.reader.can_read(contact, sensor, attribute):
                label = contact.labels[attribute]
                right.setdefault(label, []).append(source.reader.level(contact, sensor, attribute) == label)
        held_out = sum(sum(hits) / len(hits) for hits in right.values()) / len(right) if right else None
        cuts = " and ".join(f"{cut:.3g}" for cut in scale.cuts)
        direction = "rises" if scale.rising else "falls"
        rows.append(
            (
                f"{attribute}, {sensor}",
                scale.quantity,
                f"{direction}, {cuts}",
                100 * scale.accuracy,
                None if held_out is None else 100 * held_out,
            )
        )
    return Table(
        title="What one number tells",
        columns=(
            Column(name="attribute and sensor"),
            Column(
                name="quantity", meaning="the one that tells most of training contacts, of those that can speak for it"
            ),
            Column(name="cuts"),
            Column(name="training", unit="%", format=".1f", meaning="balanced accuracy; chance 33.3"),
            Column(name="bench", unit="%", format=".1f", meaning="the same on objects that fitted nothing"),
        ),
        rows=tuple(rows),
        note="Two cuts on one number of one sensor, fitted on training objects: what rationales cite.",
    )


def _coverage(source: BenchSource) -> Table:
    return Table(
        title="Objects of the bench",
        columns=(Column(name="attribute"), Column(name="objects by level")),
        rows=tuple(
            (name, ", ".join(f"{level}: {count}" for level, count in counts.items()))
            for name, counts in card.coverage(source.bench)
        ),
    )


def _samples(items: Sequence[Item]) -> Table:
    first = {item.ask.kind: item for item in reversed(items)}
    rows = [(kind, first[kind].question, first[kind].rationale) for kind in KINDS if kind in first]
    return Table(
        title="One of each",
        columns=(Column(name="kind"), Column(name="question"), Column(name="rationale")),
        rows=tuple(rows),
    )


DEFAULT = DatasetCardConfig()
SMOKE = DatasetCardConfig(
    scenes=SceneConfig(objects=60, sites=1),
    quota=Quota(identify=96, scale=36, compose=32, compare=24, order=18, one_sensor=32, conflict=16),
    faulty=60,
)

EXPERIMENT = Experiment(name="dataset_card", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
