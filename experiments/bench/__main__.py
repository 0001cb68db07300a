"""`python -m experiments.bench`: make, annotate, audit and score the questions of the touch bench."""

from sensors_io.signals import end_as_interrupted, leave_interrupted

if __name__ == "__main__":
    end_as_interrupted()  # first: the other imports take seconds

import contextlib
import dataclasses
import itertools
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from experiments.bench.contacts import measure_split, read_source
from experiments.bench.score_units import score_units
from experiments.core.artifacts import DamagedFileError, fitting, read_json, write_json
from experiments.core.text import number
from sensors_io.commands.console import complain, print_in_any_encoding, progress_bar
from sensors_io.commands.values import require_possible
from sensors_io.errors import UserError
from sensors_io.records import RecordStore
from sensors_io.units import HERE, Launcher, finish
from touchr1_jax.bench.items import ItemError, read_items, write_items
from touchr1_jax.bench.json_lines import LinesError, read_lines, write_lines
from touchr1_jax.bench.people import annotate, audit
from touchr1_jax.bench.people.sheets import SheetError
from touchr1_jax.bench.questions import card
from touchr1_jax.bench.questions.contacts import ContactError
from touchr1_jax.bench.questions.draw import Quota, QuotaError
from touchr1_jax.bench.questions.generate import (
    BenchSource,
    author_requests,
    draw_questions,
    generate,
    read_candidates,
    rejected_rows,
)
from touchr1_jax.bench.questions.rules import FilteredItems, apply_rules
from touchr1_jax.bench.scoring import BENCH_METRICS

OUT = Console(highlight=False, emoji=False, markup=False)

KNOWN_ERRORS = (
    card.CardError, QuotaError, ContactError, ItemError, LinesError, SheetError, DamagedFileError, UserError, OSError,
)  # fmt: skip
"""Errors that are shown as their message, without a traceback."""

Records = tyro.conf.Positional[Path]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FromRecords:
    """Questions about records; the same records, quota and seed give the same questions."""

    records: Records  # directory of the records; the questions are about objects of their test split
    out: Path  # file to write, JSON Lines
    quota: Quota = Quota()
    seed: int = 0

    def source(self) -> BenchSource:
        """The measured records."""
        store = RecordStore(self.records)
        with _contact_bar(store, "test", "train") as advance:
            return read_source(store, advance)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GenerateItems(FromRecords):
    """Make a bench of questions worded by rule; it is written only if every check of the data card passes."""

    def run(self) -> int:
        source = self.source()
        return _publish(self.out, generate(source, self.quota, self.seed), source)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Propose(FromRecords):
    """Write requests from which another author, such as a language model, can word the same questions."""

    def run(self) -> int:
        source = self.source()
        asks = draw_questions(source, self.quota, self.seed)
        write_lines(self.out, author_requests(asks, source.bench.by_touch()))
        OUT.print(f"{len(asks)} requests in {self.out}; candidates go to `accept` with the same quota and seed")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Accept(FromRecords):
    """Make a bench of another author's candidates that pass the rules and the data card.

    Removed candidates are written next to it, to a file that ends in .rejected.jsonl.
    """

    candidates: tyro.conf.Positional[Path]  # file of the candidates, JSON Lines

    def run(self) -> int:
        rejected = self.out.with_suffix(".rejected.jsonl")
        if rejected.resolve() == self.candidates.resolve():
            raise ItemError(f"candidates are {rejected}: would be replaced by those that are removed; rename the file")
        source = self.source()
        asks, contacts = draw_questions(source, self.quota, self.seed), source.bench.by_touch()
        found = apply_rules(read_candidates(read_lines(self.candidates), asks), contacts)
        write_lines(rejected, rejected_rows(found.removed))
        return _publish(self.out, found, source)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Score:
    """Score anybody's answers: every metric with its interval over objects, and the average if all parts are there.

    An answer is {"id", "text"}, the text in the three segments; a question without an answer counts as unparsable.
    What was scored before is not scored again.
    """

    items: tyro.conf.Positional[Path]
    answers: tyro.conf.Positional[tuple[Path, ...]]  # files of answers, JSON Lines, one for each model
    by_sight: Path | None = None
    """File of the answers given the picture alone, which define which questions are a conflict."""
    cache_dir: Path = Path("data")  # folder that keeps the scores
    launcher: Annotated[Launcher, tyro.conf.arg(name="")] = HERE

    def run(self) -> int:
        units = score_units(self.items, self.answers, self.by_sight, self.cache_dir)
        tuple(finish([unit for unit, _ in units.values()], self.launcher, OUT.print))
        for path, (_, scores) in units.items():
            table, found = Table("metric", "", "95 %, over objects", "values", "meaning"), read_json(scores)
            with fitting(scores):
                if found.get("of", scores.stem) != scores.stem:
                    raise DamagedFileError(
                        f"{scores} holds the scores of {found['of']}: put its own copy back, or remove it"
                    )
                for name, row in found["rows"].items():
                    metric = BENCH_METRICS[name]
                    mean, low, high = (format(row[end], metric.format) for end in ("mean", "low", "high"))
                    table.add_row(metric.title, mean, f"{low} – {high}", str(row["values"]), metric.meaning)
                summary = found["said"]
            OUT.print(*([path] if len(units) > 1 else []), table, summary, sep="\n")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class AnnotateSheets:
    """Write a blank sheet for each of two annotators, the objects in an order of its own."""

    records: Records
    out: Path  # folder for the sheets, a.csv and b.csv
    seed: int = 0

    def run(self) -> int:
        objects = sorted(RecordStore(self.records).objects)
        annotate.write_blank([self.out / name for name in ("a.csv", "b.csv")], objects, self.seed)
        OUT.print(f"{len(objects)} objects in {self.out / 'a.csv'} and b.csv; fill them in independently")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Annotate:
    """Join two sheets: agreement, disagreements, final labels, and labels that the measurements contradict.

    While disagreements are open they are written to FOLDER/open.csv and the exit status is 1.
    """

    records: Records
    folder: tyro.conf.Positional[Path]  # folder of the sheets; the labels are written to labels.json in it

    def run(self) -> int:
        store = RecordStore(self.records)
        a, b = (annotate.read_labels(self.folder / name, sorted(store.objects)) for name in ("a.csv", "b.csv"))
        table = Table("attribute", "objects", "κ", "κ, quadratic", "equal")
        for row in annotate.agreement(a, b):
            kappas = [number(k, ".2f") for k in (row.kappa, row.weighted)]
            table.add_row(row.attribute, str(row.objects), *kappas, f"{100 * row.exact:.1f} %")
        OUT.print(table)
        sheet, cases = self.folder / "open.csv", annotate.open_cases(a, b)
        if cases and not sheet.exists():
            annotate.write_open(sheet, a, b)
            OUT.print(f"{len(cases)} labels differ: decide them in {sheet}")
            return 1
        labels = annotate.adjudicate(a, b, annotate.read_decisions(sheet, a, b) if cases else {})
        splits = ("train", "val", "test", "unlabelled")
        with _contact_bar(store, *splits) as advance:
            contacts = [c for split in splits for c in measure_split(store, split, advance).contacts]
        for doubt in annotate.doubtful_labels(labels, contacts):
            label, against = f"{doubt.object}, {doubt.attribute} {doubt.label}", ", ".join(doubt.sensors)
            OUT.print(f"check again: {label}, contradicted by {against}")
        for (name, sensor), rho in annotate.rank_correlations(labels, contacts).items():
            OUT.print(f"{name} and {annotate.PHYSICAL[name]} by {sensor}: ρ = {rho:.2f}")
        write_json(self.folder / "labels.json", labels)
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class AuditSheet:
    """Draw a sample of items for a blind audit: a sheet to fill in, and a key that the judge does not see."""

    items: tyro.conf.Positional[Path]
    records: Records
    out: Path  # file for the sheet; its key is written next to it, to a file that ends in .key.json
    count: int = 2000
    seed: int = 0

    def run(self) -> int:
        key_file = self.out.with_suffix(".key.json")
        if key_file.exists():  # its sheet may be with a judge
            raise SheetError(f"{key_file} exists, and its sheet needs it; move it away, or choose another place")
        items, store = read_items(self.items), RecordStore(self.records)
        key = audit.sample(items, min(self.count, len(items)), self.seed)
        with _contact_bar(store, "test") as advance:
            contacts = measure_split(store, "test", advance).by_touch()
        audit.write_blank(self.out, items, key, contacts)
        write_json(key_file, key)
        OUT.print(f"{len(key)} items in {self.out}: answer yes or no in {', '.join(audit.AXES)}")
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Audit:
    """Score filled-in sheets: the pass rates with intervals, and κ if two judges filled in the same sample."""

    items: tyro.conf.Positional[Path]
    key: tyro.conf.Positional[Path]  # the key of the sample
    sheets: tyro.conf.Positional[tuple[Path, ...]]  # one or two filled-in sheets

    def run(self) -> int:
        if not 1 <= len(self.sheets) <= 2:
            raise SheetError(f"sheets holds {len(self.sheets)}: must be one or two; score judges in pairs")
        if len({sheet.resolve() for sheet in self.sheets}) < len(self.sheets):
            raise SheetError(f"sheets are {self.sheets[0]} twice: must be of two judges; name the other one")
        items = read_items(self.items)
        key = audit.read_key(self.key, items)
        judged = [audit.read_judgement(sheet, key) for sheet in self.sheets]
        for sheet, judgement in zip(self.sheets, judged, strict=True):
            table = Table("axis", "items", "passed", "95 %", "95 %, by object", title=sheet.name)
            for row in audit.pass_rates(judgement, key, items):
                spans = [f"{100 * i.low:.1f}–{100 * i.high:.1f}" for i in (row.rate, row.by_object)]
                table.add_row(row.axis, str(row.items), f"{100 * row.rate.mean:.1f} %", *spans)
            OUT.print(table)
        if len(judged) == 2:
            for axis, kappa in audit.judge_agreement(*judged).items():
                OUT.print(f"{axis}: κ = {'undefined' if kappa is None else f'{kappa:.2f}'}")
        return 0


@contextlib.contextmanager
def _contact_bar(store: RecordStore, *splits: str) -> Iterator[Callable[[], None]]:
    """A progress bar over the contacts of some splits; yields the function to call after each."""
    total, done = sum(len(store.contacts_of_split(split)) for split in splits), itertools.count(1)
    with progress_bar("contacts") as show:
        yield lambda: show(next(done), total)


def _publish(path: Path, found: FilteredItems, source: BenchSource) -> int:
    """Print the removed candidates and the data card, and write the items if all checks pass."""
    OUT.print("removed: " + ", ".join(f"{rule} {count}" for rule, count in found.counts.items()))
    if not found.kept:
        raise card.CardError("no item is left: must be one at least; read the rules that removed them above")
    checks = card.checks(found.kept, source.bench, source.train)
    table = Table("check", "measured", "bound", "")
    for c in checks:
        table.add_row(c.name, f"{c.measured:.3g} {c.unit}", f"{c.bound:g}", "ok" if c.met else "FAILED")
    OUT.print(table)
    card.require(checks)
    write_items(path, found.kept)
    OUT.print(f"{len(found.kept)} items in {path}")
    return 0


Command = (
    Annotated[GenerateItems, tyro.conf.subcommand("generate")]
    | Annotated[Propose, tyro.conf.subcommand("propose")]
    | Annotated[Accept, tyro.conf.subcommand("accept")]
    | Annotated[Score, tyro.conf.subcommand("score")]
    | Annotated[AnnotateSheets, tyro.conf.subcommand("annotate-sheets")]
    | Annotated[Annotate, tyro.conf.subcommand("annotate")]
    | Annotated[AuditSheet, tyro.conf.subcommand("audit-sheet")]
    | Annotated[Audit, tyro.conf.subcommand("audit")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, by default the process's; known errors become one line on stderr and exit status 1."""
    print_in_any_encoding()
    command = tyro.cli(Command, args=arguments, prog="experiments.bench", config=(tyro.conf.OmitArgPrefixes,))
    try:
        try:
            require_possible(command)
        except ValueError as error:
            complain(error)
            return 2
        return command.run()
    except KNOWN_ERRORS as error:
        complain(error)
        return 1
    except KeyboardInterrupt as error:
        return leave_interrupted(error, "interrupted: run the same command again")


if __name__ == "__main__":
    sys.exit(main())
