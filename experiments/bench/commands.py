"""The commands of the bench over records and files."""

import contextlib
import dataclasses
import itertools
import pathlib
from collections.abc import Callable, Iterator, Sequence

import tyro
from rich.console import Console
from rich.table import Table

from experiments.bench import adapter, annotate, audit, card
from experiments.bench import scoring as examine
from experiments.bench.contacts import measure_split
from experiments.bench.draw import Quota
from experiments.bench.generate import BenchSource, ask_about, generate, read_source
from experiments.bench.rules import FilteredItems, apply_rules
from experiments.bench.sheets import SheetError
from experiments.core.artifacts import write_json
from sensors_io.commands.console import progress_bar
from sensors_io.records import RecordStore
from touchr1_jax.bench.items import read_items, write_items
from touchr1_jax.bench.json_lines import read_lines, write_lines

OUT = Console(highlight=False)

Records = tyro.conf.Positional[pathlib.Path]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FromRecords:
    """Which questions are asked of which records; the same three give the same questions."""

    records: Records
    """Directory of the records; objects of their test split are asked about."""
    quota: Quota = dataclasses.field(default_factory=Quota)
    seed: int = 0

    def source(self) -> BenchSource:
        """The records, measured."""
        store = RecordStore(self.records)
        with _contacts(store, "test", "train") as tell:
            return read_source(store, tell=tell)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GenerateItems(FromRecords):
    """Make a bench of questions, worded by rule; nothing is written unless every check of the data card passes."""

    out: pathlib.Path
    """File of the items, JSON Lines."""

    def run(self) -> int:
        source = self.source()
        return _publish(self.out, generate(source, self.quota, self.seed), source)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Propose(FromRecords):
    """Write what another author, such as a language model, needs to word the same questions."""

    out: pathlib.Path
    """File of the requests, JSON Lines."""

    def run(self) -> int:
        source = self.source()
        asks = ask_about(source, self.quota, self.seed)
        write_lines(self.out, adapter.requests(asks, source.bench.by_touch()))
        OUT.print(f"{len(asks)} requests in {self.out}; candidates go to `accept` with the same quota and seed")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Accept(FromRecords):
    """Sift what another author worded, and make a bench of what passes the rules and the data card."""

    candidates: tyro.conf.Positional[pathlib.Path]
    """File of the candidates, JSON Lines."""
    out: pathlib.Path
    """File of the items; what was removed lies beside it, ending in .rejected.jsonl."""

    def run(self) -> int:
        source = self.source()
        asks, contacts = ask_about(source, self.quota, self.seed), source.bench.by_touch()
        found = apply_rules(adapter.candidates(read_lines(self.candidates), asks), contacts)
        write_lines(self.out.with_suffix(".rejected.jsonl"), adapter.rejected(found.removed))
        return _publish(self.out, found, source)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Score:
    """Score anybody's answers: every metric with its interval over objects, and the average where all parts are there.

    An answer is {"id", "text"}, the text in the three segments; a question without an answer counts as unparsable.
    """

    items: tyro.conf.Positional[pathlib.Path]
    answers: tyro.conf.Positional[pathlib.Path]
    """File of the answers, JSON Lines."""
    by_sight: pathlib.Path | None = None
    """File of the answers given the picture alone, which tell what is a conflict."""

    def run(self) -> int:
        items = read_items(self.items)
        said = examine.understood(read_lines(self.answers), items, str(self.answers))
        seen = None
        if self.by_sight is not None:
            seen = examine.understood(read_lines(self.by_sight), items, str(self.by_sight))
        table = Table("metric", "", "95 %, over objects", "values", "meaning")
        for row in examine.table(items, said, seen):
            spec, span = row.metric.format, row.interval
            table.add_row(
                row.metric.title,
                format(span.mean, spec),
                f"{span.low:{spec}} – {span.high:{spec}}",
                str(row.values),
                row.metric.meaning,
            )
        OUT.print(table)
        OUT.print(f"parsed {100 * examine.parsed(said):.1f} %; " + examine.average_line(items, said))
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class AnnotateSheets:
    """Write a blank sheet for each of two annotators, the objects in an order of its own."""

    records: Records
    out: pathlib.Path
    """Folder of the sheets, a.csv and b.csv."""
    seed: int = 0

    def run(self) -> int:
        objects = sorted(RecordStore(self.records).objects)
        annotate.write_blank([str(self.out / name) for name in ("a.csv", "b.csv")], objects, self.seed)
        OUT.print(f"{len(objects)} objects in {self.out / 'a.csv'} and b.csv; fill them in apart")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Annotate:
    """Join two sheets: agreement, disagreements, final labels, and labels that force and deformation speak against.

    While disagreements are open they are written to FOLDER/open.csv and the exit status is 1.
    """

    records: Records
    folder: tyro.conf.Positional[pathlib.Path]
    """Folder of the sheets; the labels go to labels.json in it."""

    def run(self) -> int:
        store = RecordStore(self.records)
        a, b = (annotate.read_labels(str(self.folder / name), sorted(store.objects)) for name in ("a.csv", "b.csv"))
        OUT.print(_agreements(annotate.agreement(a, b)))
        cells = self.folder / "open.csv"
        if annotate.open_cells(a, b) and not cells.exists():
            annotate.write_open(str(cells), a, b)
            OUT.print(f"{sum(map(len, annotate.open_cells(a, b).values()))} labels differ: decide them in {cells}")
            return 1
        decided = annotate.read_decisions(str(cells), a, b) if annotate.open_cells(a, b) else {}
        labels = annotate.adjudicate(a, b, decided)
        splits = ("train", "val", "test", "unlabelled")
        with _contacts(store, *splits) as tell:
            contacts = [c for split in splits for c in measure_split(store, split, tell).contacts]
        for doubt in annotate.doubts(labels, contacts):
            told = f"{doubt.object}: {doubt.attribute} {doubt.label} against {', '.join(doubt.sensors)}"
            OUT.print(f"look again at {told}")
        for (name, sensor), rho in annotate.rank_correlations(labels, contacts).items():
            OUT.print(f"{name} and {annotate.PHYSICAL[name]} by {sensor}: ρ = {rho:.2f}")
        write_json(self.folder / "labels.json", labels)
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class AuditSheet:
    """Draw a sample of items for a blind audit: a sheet to fill in, and a key that the judge does not see."""

    items: tyro.conf.Positional[pathlib.Path]
    records: Records
    out: pathlib.Path
    """The sheet; its key lies beside it, ending in .key.json."""
    count: int = 2000
    seed: int = 0

    def run(self) -> int:
        items, store = read_items(self.items), RecordStore(self.records)
        key = audit.sample(items, min(self.count, len(items)), self.seed)
        with _contacts(store, "test") as tell:
            contacts = measure_split(store, "test", tell).by_touch()
        audit.write_blank(str(self.out), items, key, contacts)
        write_json(self.out.with_suffix(".key.json"), key)
        OUT.print(f"{len(key)} items in {self.out}: answer yes or no in {', '.join(audit.AXES)}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Audit:
    """Score filled-in sheets: the share that passes with its interval, and κ where two judges saw the same sample."""

    items: tyro.conf.Positional[pathlib.Path]
    key: tyro.conf.Positional[pathlib.Path]
    """The key of the sample."""
    sheets: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    """One or two filled-in sheets."""

    def run(self) -> int:
        if not 1 <= len(self.sheets) <= 2:
            raise SheetError(f"sheets holds {len(self.sheets)}: must be one or two; score judges in pairs")
        items = read_items(self.items)
        key = audit.read_key(self.key, items)
        judged = [audit.read_judgement(str(sheet), key) for sheet in self.sheets]
        for sheet, judgement in zip(self.sheets, judged, strict=True):
            OUT.print(_rates(sheet.name, audit.pass_rates(judgement, key, items)))
        if len(judged) == 2:
            for axis, kappa in audit.judges_agree(*judged).items():
                OUT.print(f"{axis}: κ = {'undefined' if kappa is None else f'{kappa:.2f}'}")
        return 0


@contextlib.contextmanager
def _contacts(store: RecordStore, *splits: str) -> Iterator[Callable[[], None]]:
    """A progress bar for contacts that are read; what it yields is called after each."""
    total, done = sum(len(store.contacts_of_split(split)) for split in splits), itertools.count(1)
    with progress_bar("contacts") as show:
        yield lambda: show(next(done), total)


def _publish(path: pathlib.Path, found: FilteredItems, source: BenchSource) -> int:
    """Print what was removed and the card, and write the items if all of it passes."""
    OUT.print("removed: " + ", ".join(f"{rule} {count}" for rule, count in found.counts.items()))
    if not found.kept:
        raise card.CardError("no item is left; look at the rules that removed them")
    results = card.checks(found.kept, source.bench, source.train)
    table = Table("check", "measured", "bound", "")
    for check in results:
        table.add_row(
            check.name, f"{check.measured:.3g} {check.unit}", f"{check.bound:g}", "ok" if check.passed else "FAILED"
        )
    OUT.print(table)
    card.require(results)
    write_items(path, found.kept)
    OUT.print(f"{len(found.kept)} items in {path}")
    return 0


def _agreements(rows: Sequence[annotate.AnnotatorAgreement]) -> Table:
    table = Table("attribute", "objects", "κ", "κ, quadratic", "equal")
    for row in rows:
        kappas = ["–" if k is None else f"{k:.2f}" for k in (row.kappa, row.weighted)]
        table.add_row(row.attribute, str(row.objects), *kappas, f"{100 * row.exact:.1f} %")
    return table


def _rates(title: str, rows: Sequence[audit.PassRate]) -> Table:
    table = Table("axis", "items", "passed", "95 %", "95 %, by object", title=title)
    for row in rows:
        spans = [f"{100 * i.low:.1f}–{100 * i.high:.1f}" for i in (row.rate, row.by_object)]
        table.add_row(row.axis, str(row.items), f"{100 * row.rate.mean:.1f} %", *spans)
    return table
