"""The commands next to the experiments: list them with their runs, start a new one, compare and show runs."""

import ast
import dataclasses
import difflib
import importlib.util
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from experiments.core import new, runs
from experiments.core.artifacts import DamagedFileError

PROG = "python -m experiments"

USAGE = f"""usage: {PROG} NAME [--scale smoke|default|…] [--fresh] [--tensorboard] [--distributed] [overrides]
       {PROG} list [NAME]            experiments, their runs, cost and results
       {PROG} new NAME [--reward]    a template that runs
       {PROG} compare RUN RUN […]     runs, figure by figure
       {PROG} sweep NAME --vary OPTION=VALUE,VALUE   a run for each value
       {PROG} show NAME              the recorded result of an experiment as its report
       {PROG} ask [POLICY] INPUT     ask a trained policy about a touch
       {PROG} export POLICY FOLDER   a trained policy as a folder for others
       {PROG} demo [POLICY]          ask in the browser
"""

ASKING = ("ask", "export", "demo")  # commands on trained policies, which `experiments.ask` defines
SWEEP = "sweep"  # command that `experiments.core.sweep` defines
COMMANDS = ("list", "new", "compare", SWEEP, "show", *ASKING)  # names that no experiment can have


@dataclasses.dataclass(frozen=True, kw_only=True)
class CatalogueEntry:
    """An experiment of a package: its module, its family (the folder it lies in) and its question."""

    module: str
    family: str
    question: str


def find(package: str) -> dict[str, CatalogueEntry]:
    """Find every experiment of a package and its families by reading sources; nothing is imported.

    Raises:
      ModuleNotFoundError: no such package.
      ValueError: two modules define an experiment of one name.
    """
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"package is {package!r}: no such package; give the one that holds the experiments")
    found: dict[str, CatalogueEntry] = {}
    for root in map(Path, spec.submodule_search_locations):
        for path in sorted([*root.glob("*.py"), *root.glob("*/*.py")]):
            source = path.read_text(encoding="utf-8")
            if "EXPERIMENT" not in source or not _defines_experiment(tree := ast.parse(source)):
                continue
            parts = path.relative_to(root).with_suffix("").parts
            module = ".".join((package, *parts))
            if path.stem in found:
                raise ValueError(f"{module} has the name of {found[path.stem].module}: names are unique; rename one")
            question = (ast.get_docstring(tree) or "").partition("\n")[0]
            found[path.stem] = CatalogueEntry(module=module, family="/".join(parts[:-1]), question=question)
    return dict(sorted(found.items(), key=lambda item: (item[1].family, item[0])))


def _defines_experiment(tree: ast.Module) -> bool:
    targets = [t for node in tree.body if isinstance(node, ast.Assign) for t in node.targets]
    targets += [node.target for node in tree.body if isinstance(node, ast.AnnAssign)]
    return any(isinstance(t, ast.Name) and t.id == "EXPERIMENT" for t in targets)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ListCommand:
    """List every experiment by family with the cost and the result of its newest run; with a name, all its runs."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = ""  # an experiment
    runs_dir: Path = Path("runs")  # folder of all runs

    def run(self, package: str) -> int:
        """Print the list and return the exit status."""
        entries = find(package)
        if self.name and self.name not in entries:
            print_error(unknown_name(self.name, entries))
            return 2
        begun = self.runs_dir != ListCommand.runs_dir or os.path.lexists(self.runs_dir)  # the first run makes it
        if begun and not self.runs_dir.is_dir():
            print_error(f"runs-dir is {self.runs_dir}: must be a folder of this machine; correct the path")
            return 2
        if self.name:
            print_lines(*_listing_of_runs(self.name, entries[self.name].question, self.runs_dir))
        else:
            print_lines(_listing(entries, self.runs_dir))
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewCommand:
    """Start an ablation from a template; with `--reward` also a reward and its test.  All of them run."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]  # of the experiment, and of the reward
    reward: bool = False  # make a reward of that name for the experiment to try
    root: Path = runs.ROOT  # the checkout to write in

    def run(self, package: str) -> int:
        """Write the files, print the next steps, and return the exit status."""
        folders = (path.name for path in (self.root / "experiments").glob("*/"))
        taken = {*COMMANDS, *folders, *find(package)}
        try:
            made, changed = new.write_new(self.root, self.name, reward=self.reward, taken=taken)
        except (new.NewError, OSError) as error:
            print_error(f"{type(error).__name__}: {error}")
            return 1
        print_lines(*(f"made     {path}" for path in made), *(f"changed  {path}" for path in changed))
        print_lines("", "The experiment runs as it is.  Next:", *new.next_steps(self.name, reward=self.reward))
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareCommand:
    """Compare two or more finished runs: settings, code, every figure, those that all of them have first.

    A run is its directory, `NAME/STAMP`, or `NAME` for the latest of an experiment.
    """

    runs: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN RUN [RUN ...]")]
    runs_dir: Path = Path("runs")  # folder of all runs
    most: int = 40  # differing figures to show

    def run(self, package: str) -> int:
        """Print the comparison and return the exit status."""
        del package
        if self.most < 0:
            print_error(f"most is {self.most}: must be at least 0; raise it")
            return 2
        from experiments.core.compare import ComparisonError, compare_runs  # SciPy, which no other command needs

        try:
            found = [runs.read_run(runs.locate(name, self.runs_dir)) for name in self.runs]
            print_lines(compare_runs(found, self.most))
        except (ComparisonError, DamagedFileError, OSError) as error:
            print_error(f"{type(error).__name__}: {error}")
            return 1
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShowCommand:
    """Render the recorded result of an experiment as its report, in RUNS/NAME/recorded/report.html."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """An experiment with a run in experiments/recorded."""
    runs_dir: Path = Path("runs")  # folder of all runs

    def run(self, package: str) -> int:
        """Write the report, print its path and its verdict, and return the exit status."""
        entries = find(package)
        if self.name not in entries:
            print_error(unknown_name(self.name, entries))
            return 2
        from experiments.core.recorded import FigureError, show_recorded  # charts, which no other command needs

        try:
            lines = show_recorded(self.name, entries[self.name].module, self.runs_dir)
        except (FigureError, DamagedFileError, OSError) as error:
            print_error(f"{type(error).__name__}: {error}")
            return 1
        print_lines(*lines)
        return 0


Command = (
    Annotated[ListCommand, tyro.conf.subcommand("list")]
    | Annotated[NewCommand, tyro.conf.subcommand("new")]
    | Annotated[CompareCommand, tyro.conf.subcommand("compare")]
    | Annotated[ShowCommand, tyro.conf.subcommand("show")]
)


def run_command(arguments: Sequence[str], package: str) -> int | None:
    """Run one of `COMMANDS`, print help, or correct a name; the exit status, `None` where an experiment is named."""
    if arguments and arguments[0] in COMMANDS and arguments[0] not in (*ASKING, SWEEP):
        return tyro.cli(Command, args=arguments, prog=PROG, config=(tyro.conf.OmitArgPrefixes,)).run(package)
    entries = find(package)
    if not arguments or arguments[0] in ("-h", "--help"):
        print_lines(USAGE, _listing(entries))
        return 0 if arguments else 2
    if arguments[0] in entries:
        return None
    print_error(f"{unknown_name(arguments[0], entries)}\n{_listing(entries)}")
    return 2


def unknown_name(name: str, entries: Mapping[str, CatalogueEntry]) -> str:
    """The answer to a name that no experiment has, with those that resemble it."""
    close = difflib.get_close_matches(name, entries)
    return f"There is no experiment {name!r}." + (f" Did you mean {' or '.join(close)}?" if close else "")


def _listing(entries: Mapping[str, CatalogueEntry], runs_dir: Path | None = None) -> str:
    """Experiments by family; with a folder of runs, below each one its newest run and the start of its verdict."""
    lines: list[str] = []
    width, family = max(map(len, entries), default=0), ""
    for name, entry in entries.items():
        lines += ["", f"{entry.family}:"] if entry.family != family else []
        lines.append(f"  {name:<{width}}  {entry.question}")
        family, (past, damaged) = entry.family, _past_runs(runs_dir / name) if runs_dir else ([], [])
        more = f" (and {len(past) - 1} more)" if len(past) > 1 else ""
        newest = [f"{run.summary}{more}  {' '.join(run.outcome[:1])}".rstrip() for run in past[:1]]
        lines += [f"  {'':<{width}}    {line}" for line in newest + damaged]
    return "\n".join(lines).strip("\n")


def _listing_of_runs(name: str, question: str, runs_dir: Path) -> list[str]:
    """Every run of one experiment with its whole verdict, the newest first."""
    past, damaged = _past_runs(runs_dir / name)
    lines = [f"{name}: {question}"]
    for run in past:
        report = run.directory / "report.html"
        lines += [f"  {run.summary}", *(f"      {sentence}" for sentence in run.outcome)]
        lines += [f"      report: {report}"] if report.exists() else []
    lines += [f"  {complaint}" for complaint in damaged]
    return lines if len(lines) > 1 else [*lines, f"  has not run under {runs_dir}"]


def _past_runs(home: Path) -> tuple[list[runs.PastRun], list[str]]:
    """The readable runs under `runs/NAME`, the newest first, and what is wrong with the others."""
    past: list[runs.PastRun] = []
    try:
        begun = runs.started(home)
    except OSError as error:
        return [], [_unread(error)]
    finished = sorted(path.parent for path in home.glob("*/results.json") if not path.parent.is_symlink())
    damaged = [
        f"{path} lacks its config.json: put a copy back, or move it away" for path in finished if path not in begun
    ]
    for directory in begun:
        try:
            run = runs.read_run(directory)
            if run.name == home.name:
                past.append(run)
            else:
                damaged.append(f"{directory} is a run of {run.name}: move it to {home.with_name(run.name)}")
        except DamagedFileError as error:
            damaged.append(str(error))
        except OSError as error:
            damaged.append(_unread(error))
    return past, damaged


def _unread(error: OSError) -> str:
    return f"{error}: must be readable; correct its permissions, or move its run away"


def print_lines(*texts: str) -> None:
    """Print lines as they are."""
    Console(soft_wrap=True, highlight=False, emoji=False).print(*texts, sep="\n", markup=False)


def print_error(text: str) -> None:
    """Print to standard error."""
    Console(stderr=True, soft_wrap=True, highlight=False, emoji=False).print(text, markup=False)
