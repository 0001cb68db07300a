"""The commands beside the experiments: list them with their runs, start a new one, compare two runs."""

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from experiments.core.artifacts import DamagedFileError
from experiments.core.catalogue import Entry, find, listing
from experiments.core.history import listing_of_runs, listing_with_runs, locate, read_run
from experiments.core.new import FAMILY, NewError, write_new
from experiments.core.runs import ROOT

PROG = "python -m experiments"

USAGE = f"""usage: {PROG} NAME [--scale smoke|default|…] [--fresh] [--tensorboard] [--distributed] [overrides]
       {PROG} list [NAME]            what ran, its cost, its result
       {PROG} new NAME [--reward]    a template that runs
       {PROG} compare RUN_A RUN_B    two runs, figure by figure
"""

COMMANDS = ("list", "new", "compare")
"""Names that no experiment can have."""

ANSWER = "<perceive> xense soft </perceive> <compare> soft </compare> <conclude> soft </conclude>"
"""An answer to try a reward on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class List:
    """Show every experiment, its newest run, what that cost and what came out; with a name, every run of it."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = ""
    """An experiment."""
    runs_dir: Path = Path("runs")
    """Where runs are kept."""

    def run(self, package: str) -> int:
        """Print the list and return the exit status."""
        questions = find(package)
        if self.name and self.name not in questions:
            complain(unknown(self.name, questions))
            return 2
        if self.name:
            say(listing_of_runs(self.name, questions[self.name].question, self.runs_dir))
        else:
            say(listing_with_runs(questions, self.runs_dir))
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class New:
    """Start an ablation from a template; with `--reward` also a reward and its test.  They run as they are."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Of the experiment, and of the reward."""
    reward: bool = False
    """Make a reward of that name, and let the experiment try it."""
    root: Path = ROOT
    """The checkout to write in."""

    def run(self, package: str) -> int:
        """Write the files, say what comes next, and return the exit status."""
        folders = (path.name for path in (self.root / "experiments").glob("*/"))
        try:
            written = write_new(self.root, self.name, reward=self.reward, taken={*COMMANDS, *folders, *find(package)})
        except (NewError, OSError) as error:
            complain(f"{type(error).__name__}: {error}")
            return 1
        say(*(f"made     {path}" for path in written.made), *(f"changed  {path}" for path in written.changed))
        say("", "It runs as it stands.  Next:", *(f"  {step}" for step in self._next()))
        return 0

    def _next(self) -> Sequence[str]:
        run = [f'make experiment EXP={self.name} ARGS="--scale smoke"', f"make experiment EXP={self.name}"]
        if not self.reward:
            return [f"edit {FAMILY}/{self.name}.py: its question, its arms, what you expect", *run]
        return [
            f"edit touchr1_jax/rewards/{self.name}.py: the formula, in its docstring and below",
            f"edit tests/touchr1_jax/rewards/test_{self.name}.py: its hand values",
            f"python -m pytest tests/touchr1_jax/rewards/test_{self.name}.py",
            f'python -m touchr1_jax.rewards explain --weights {self.name} 1 --text "{ANSWER}"',
            *run,
        ]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compare:
    """Hold two finished runs against each other: what was set, the code, every figure.

    A run is its directory, `NAME/STAMP`, or `NAME` for the latest of an experiment.
    """

    run_a: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_A")]
    run_b: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_B")]
    runs_dir: Path = Path("runs")
    """Where runs are kept."""
    most: int = 40
    """Differing figures to show."""

    def run(self, package: str) -> int:
        """Print the comparison and return the exit status."""
        del package
        from experiments.core.compare import ComparisonError, compare_runs  # SciPy, which no other command needs

        try:
            a, b = (read_run(locate(name, self.runs_dir)) for name in (self.run_a, self.run_b))
            say(compare_runs(a, b, self.most))
        except (ComparisonError, DamagedFileError, FileNotFoundError) as error:
            complain(f"{type(error).__name__}: {error}")
            return 1
        return 0


Command = (
    Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[New, tyro.conf.subcommand("new")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
)


def answer(arguments: Sequence[str], package: str) -> int | None:
    """Run one of `COMMANDS`, give help or name what there is; the exit status, `None` where an experiment is named."""
    if arguments and arguments[0] in COMMANDS:
        return tyro.cli(Command, args=arguments, prog=PROG, config=(tyro.conf.OmitArgPrefixes,)).run(package)
    questions = find(package)
    if not arguments or arguments[0] in ("-h", "--help"):
        say(USAGE, listing(questions))
        return 0 if arguments else 2
    if arguments[0] in questions:
        return None
    complain(f"{unknown(arguments[0], questions)}\n{listing(questions)}")
    return 2


def unknown(name: str, questions: Mapping[str, Entry]) -> str:
    """The answer to a name that no experiment has."""
    close = difflib.get_close_matches(name, questions)
    return f"There is no experiment {name!r}." + (f" Did you mean {' or '.join(close)}?" if close else "")


def say(*texts: str) -> None:
    """Print lines as they are."""
    Console(soft_wrap=True, highlight=False).print(*texts, sep="\n", markup=False)


def complain(text: str) -> None:
    """The same, on standard error."""
    Console(stderr=True, soft_wrap=True, highlight=False).print(text, markup=False)
