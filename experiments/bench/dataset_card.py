"""Is the benchmark valid: no leak between splits, no gain for constant answers, every rationale supported?

    make experiment EXP=dataset_card
    make experiment EXP=dataset_card ARGS="--data records --data-dir RECORDS"

Makes the bench of 4,800 questions about the 200 test objects of a thousand, in four tiers and seven kinds, writes the
rationales from the measurements, filters the questions by the rules and checks them against the data card.  A failed
check ends the run with an error.  The rules must then detect injected errors of every kind, and making the bench a
second time must give the same questions.  The run contains it as `items.jsonl`; `python -m experiments.bench --help`
lists the commands that make, word, annotate and audit other benches.

Cost: about three minutes on one core, most of it for the scenes; `--scale smoke` a few seconds.

Expected: all checks pass; no constant is three points above chance.  Thresholds on the sensors' measurements answer
about half of the questions right, those about material least often.
"""

import collections
import dataclasses
import itertools
from collections.abc import Mapping, Sequence

from experiments.bench.contacts import read_source
from experiments.core.charts import Panel, Series, draw
from experiments.core.context import Context
from experiments.core.look import PALETTE, SHARED
from experiments.core.results import Cell, Picture, Results, Table, at_least, at_most, named_table
from experiments.core.runner import Experiment
from experiments.study.sources import SourceConfig, prepare_records
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.items import KINDS, Item, write_items
from touchr1_jax.bench.questions import card
from touchr1_jax.bench.questions.draw import Quota
from touchr1_jax.bench.questions.generate import BenchSource, generate, share_at_odds
from touchr1_jax.bench.questions.rules import FilteredItems, count_found_errors


@dataclasses.dataclass(frozen=True, kw_only=True)
class DatasetCardConfig(SourceConfig):
    """The records, the number of questions, and `faulty`, the number of items in which errors are planted."""

    scenes: SceneConfig = SceneConfig(objects=1000, sites=2)
    quota: Quota = Quota()
    seed: int = 0
    faulty: int = 700

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.drop_odd:
            raise ValueError("drop_odd is True: the bench asks about all contacts that can be measured; leave it out")


def run(config: DatasetCardConfig, context: Context) -> Results:
    """Make the bench, check it, report."""
    store = RecordStore(prepare_records(config, context))
    contacts = sum(len(store.contacts_of_split(split)) for split in ("test", "train"))
    with context.timed("measure"), context.progress("measuring contacts", contacts) as advance:
        source = read_source(store, advance)
    with context.timed("generate"):
        found, again = (
            generate(source, config.quota, config.seed) for _ in context.each("making the bench twice", range(2))
        )
    items, checks = found.kept, card.checks(found.kept, source.bench, source.train)
    card.require(checks)
    write_items(context.directory / "items.jsonl", items)
    with context.timed("faults"):
        sound = items[:: max(1, len(items) // config.faulty)]
        counts = count_found_errors(context.each("planted errors", sound), source.bench.by_touch())
    caught = {rule: 100 * (n / len(sound)) for rule, n in counts.items()}
    least = min(caught.values())
    shown = {touch.object for item in items for touch in item.ask.touches}
    return Results(
        verdict=(
            f"{len(items):,} questions about {len(shown)} objects that no training contact shows pass all "
            f"{len(checks)} checks; the rules removed {len(found.removed)}.",
            f"Of {len(sound)} items with a planted error each rule finds at least {least:.1f} %.",
            f"In {100 * share_at_odds(items):.0f} % of them a threshold on each number does not give the answer.",
        ),
        requirements=(
            at_least("questions", len(items), config.quota.total, note="of the quota"),
            at_least("made twice, the same bytes", again == found, 1),
            at_least("planted faults caught, the worst rule", least, 100, "%"),
            *(at_most(c.name, c.measured, c.bound, c.unit, c.note) for c in checks),
        ),
        tables=(
            _question_table(items),
            _answer_table(card.shares(items)),
            _rule_table(found, caught),
            _threshold_table(source),
            _object_table(source),
            _sample_table(items),
        ),
        pictures=(
            Picture(
                name="answers",
                title="Answers",
                caption="Each bar is a kind and an attribute; colours are levels in their order, from the left.",
                content=_answer_chart(card.shares(items)),
            ),
        ),
        data={
            "test_objects": len(source.bench.objects()),
            "test_contacts": len(source.bench.contacts),
            "training_objects": len(source.train.objects()),
            "training_contacts": len(source.train.contacts),
            "recordings_without_contact": sum(source.bench.skipped.values()) + sum(source.train.skipped.values()),
        },
    )


def _object_table(source: BenchSource) -> Table:
    labels = {contact.touch.object: contact.labels for contact in source.bench.contacts}.values()
    rows = []
    for name in ATTRIBUTES:
        counts = collections.Counter(of[name] for of in labels if name in of)
        levels = ", ".join(f"{level}: {n}" for level, n in sorted(counts.items()))
        rows.append({"attribute": name, "objects by level": levels})
    return named_table("Objects of the bench", rows)


def _question_table(items: Sequence[Item]) -> Table:
    rows: list[dict[str, Cell]] = [
        {
            "kind": kind,
            "tier": about.tier,
            "questions": len(of),
            "objects": len({touch.object for item in of for touch in item.ask.touches}),
            "picture shown": about.view,
            "at odds": 100 * share_at_odds(of),
            "asks for": about.meaning,
        }
        for kind, about in KINDS.items()
        if (of := [item for item in items if item.ask.kind == kind])
    ]
    meaning = "questions whose answer the sensors' numbers, each read by its thresholds, do not give together"
    return named_table(
        "Questions", rows, formats={"at odds": ".0f"}, units={"at odds": "%"}, meanings={"at odds": meaning}
    )


def _answer_table(shares: Sequence[card.AnswerShare]) -> Table:
    rows: list[dict[str, Cell]] = [
        {
            "kind": share.kind,
            "attribute": share.attribute,
            "questions": sum(share.counts),
            "answers": " ".join(map(str, share.counts)),
            "commonest": 100 * max(share.counts) / sum(share.counts),
        }
        for share in shares
    ]
    meanings = {"answers": "how often each level is right, in the order of the levels"}
    return named_table("Answers", rows, formats={"commonest": ".1f"}, units={"commonest": "%"}, meanings=meanings)


def _rule_table(found: FilteredItems, caught: Mapping[str, float]) -> Table:
    share = "planted faults caught"
    rows = [{"rule": rule, "removed": n, share: caught[rule]} for rule, n in found.counts.items()]
    meanings = {"removed": "of the questions worded by rule"}
    return named_table("Rules", rows, formats={share: ".1f"}, units={share: "%"}, meanings=meanings)


def _threshold_table(source: BenchSource) -> Table:
    rows: list[dict[str, Cell]] = []
    for (sensor, attribute), thresholds in sorted(source.reader.thresholds.items()):
        right: dict[int, list[bool]] = {}
        for contact in source.bench.contacts:
            if attribute in contact.labels and source.reader.can_read(contact, sensor, attribute):
                label = contact.labels[attribute]
                right.setdefault(label, []).append(source.reader.level(contact, sensor, attribute) == label)
        unseen = sum(sum(hits) / len(hits) for hits in right.values()) / len(right) if right else None
        cuts = " and ".join(f"{cut:.3g}" for cut in thresholds.cuts)
        rows.append(
            {
                "attribute and sensor": f"{attribute}, {sensor}",
                "quantity": thresholds.quantity,
                "cuts": f"{'rises' if thresholds.rising else 'falls'}, {cuts}",
                "training": 100 * thresholds.accuracy,
                "bench": None if unseen is None else 100 * unseen,
            }
        )
    return named_table(
        "Levels read from one number",
        rows,
        formats={"training": ".1f", "bench": ".1f"},
        units={"training": "%", "bench": "%"},
        meanings={
            "quantity": "the one of the best accuracy on training contacts, of those that the attribute may be read "
            "from",
            "training": "balanced accuracy; chance 33.3",
            "bench": "the same on objects that fitted nothing",
        },
        note="Two cuts on one number of one sensor, fitted on training objects: rationales cite them.",
    )


def _sample_table(items: Sequence[Item]) -> Table:
    first = {item.ask.kind: item for item in reversed(items)}
    samples = ((kind, first[kind]) for kind in KINDS if kind in first)
    rows = [{"kind": kind, "question": item.question, "rationale": item.rationale} for kind, item in samples]
    return named_table("One of each", rows)


def _answer_chart(shares: Sequence[card.AnswerShare]) -> bytes:
    """Share of every answer of every kind and attribute as stacked bars, with marks where equal shares would end."""
    parts = [[100 * count / sum(share.counts) for count in share.counts] for share in shares]
    levels = list(itertools.zip_longest(*parts, fillvalue=0.0))
    bars = [Series(x=x, bar=True, alpha=0.75, colour=PALETTE[k % len(PALETTE)]) for k, x in enumerate(levels)]
    ends = [(100 * k / len(s.counts), row) for row, s in enumerate(shares) for k in range(1, len(s.counts))]
    x, y = zip(*ends, strict=True)
    panel = Panel(
        [*bars, Series(x=x, y=y, marker="$|$", size=90.0, colour=SHARED)],
        rows=[f"{share.kind}, {share.attribute}" for share in shares],
        x_label="share of the answers, %; marks: equal shares",
        x_limits=(0, 100),
        stacked=True,
    )
    return draw([panel])


SMOKE = DatasetCardConfig(
    scenes=SceneConfig(objects=60, sites=1),
    quota=Quota(identify=96, scale=36, compose=32, compare=24, order=18, one_sensor=32, conflict=16),
    faulty=60,
)

EXPERIMENT = Experiment(name="dataset_card", config=DatasetCardConfig(), scales={"smoke": SMOKE}, run=run)
