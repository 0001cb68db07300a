"""`python -m sensors_io`: import recordings, generate scenes, check and list records."""

import contextlib
import dataclasses
import pathlib
import sys
from collections.abc import Callable, Iterator
from typing import Annotated

import rich.console
import rich.progress
import tyro

from sensors_io import overview
from sensors_io.generate import generate_records
from sensors_io.importers.physiclear import ImportSourceError, PhysiclearConfig, import_physiclear
from sensors_io.records import CorruptRecordsError, IncompleteRecordsError, RecordsError, RecordStore
from sensors_io.scenes import SceneConfig
from sensors_io.schema import SENSORS, SchemaError

OUT = rich.console.Console()
ERR = rich.console.Console(stderr=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Physiclear:
    """Import the PhysiCLeAR videos.  An interrupted import goes on where it stopped."""

    source: tyro.conf.Positional[pathlib.Path]
    """Directory with labels.json and videos/."""
    out: pathlib.Path
    """Directory of the records."""
    config: PhysiclearConfig = dataclasses.field(default_factory=PhysiclearConfig)

    def run(self) -> int:
        with _progress("videos") as progress:
            report = import_physiclear(self.source, self.out, config=self.config, progress=progress)
        OUT.print(overview.import_table(report))
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Import:
    """Import published recordings."""

    dataset: Annotated[Physiclear, tyro.conf.subcommand("physiclear")] | Annotated[None, tyro.conf.Suppress]

    def run(self) -> int:
        return self.dataset.run() if self.dataset else 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Generate:
    """Generate scenes.  An interrupted generation goes on where it stopped.

    `--objects 1000 --sequences 14700` is the set of the paper's size: 1.32 million records.
    """

    out: pathlib.Path
    """Directory of the records."""
    config: SceneConfig = dataclasses.field(default_factory=SceneConfig)

    def run(self) -> int:
        each = len(SENSORS) * self.config.frame_count
        with _progress("records") as progress:
            generate_records(self.config, self.out, progress=lambda done, total: progress(done * each, total * each))
        OUT.print(overview.summary_table(RecordStore(self.out)))
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """Read every entry, verify its checksum, count quality flags; exit status 1 if anything is damaged or missing."""

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""

    def run(self) -> int:
        store = RecordStore(self.records, allow_incomplete=True)
        counts = overview.FlagCounts()
        problems: list[RecordsError] = []
        with _progress("contacts") as progress:
            for i in range(len(store)):
                try:
                    counts.add(store.contact(i).values())
                except CorruptRecordsError as damage:
                    problems.append(damage)
                progress(i + 1, len(store))
        OUT.print(overview.summary_table(store))
        OUT.print(overview.flag_table(counts))
        if not store.complete:
            problems.append(IncompleteRecordsError(f"{self.records}: its writing has not ended; run its command again"))
        for problem in problems:
            _complain(problem)
        return 1 if problems else 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class List:
    """Print the objects with their split, labels and number of contacts."""

    records: tyro.conf.Positional[pathlib.Path]
    """Directory of the records."""

    def run(self) -> int:
        store = RecordStore(self.records, allow_incomplete=True)
        OUT.print(overview.object_table(store))
        OUT.print(overview.summary_table(store))
        return 0


Command = (
    Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Generate, tyro.conf.subcommand("generate")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[List, tyro.conf.subcommand("list")]
)


def main(args: list[str] | None = None) -> int:
    """Run one command; known errors become one line on stderr and exit status 1.

    Args:
      args: the command line; None takes that of the process.
    """
    command = tyro.cli(Command, args=args, prog="sensors_io", config=(tyro.conf.OmitArgPrefixes,))
    try:
        return command.run()
    except (RecordsError, SchemaError, ImportSourceError, OSError) as error:
        _complain(error)
        return 1
    except KeyboardInterrupt:
        ERR.print("interrupted: run the same command again to go on")
        return 130


def _complain(error: Exception) -> None:
    ERR.print(f"{type(error).__name__}: {error}", markup=False, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar with rate and time left on stderr; nothing where stderr is no terminal."""
    columns = (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.MofNCompleteColumn(),
        rich.progress.TextColumn("{task.fields[rate]}"),
        rich.progress.TimeRemainingColumn(),
    )
    with rich.progress.Progress(*columns, console=ERR, disable=not ERR.is_terminal) as bar:
        task = bar.add_task(what, total=None, rate="")

        def show(done: int, total: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, completed=done, total=total, rate=f"{speed:.1f}/s" if speed else "")

        yield show


if __name__ == "__main__":
    sys.exit(main())
