"""The commands next to the experiments: list them with their runs, start a new one, compare two runs."""

import ast
import dataclasses
import difflib
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from experiments.core import runs
from experiments.core.artifacts import DamagedFileError
from experiments.core.history import PastRun, locate, read_run, summary
from experiments.core.new import FAMILY, NewError, write_new

PROG = "python -m experiments"

USAGE = f"""usage: {PROG} NAME [--scale smoke|default|…] [--fresh] [--tensorboard] [--distributed] [overrides]
       {PROG} list [NAME]            experiments, their runs, cost and results
       {PROG} new NAME [--reward]    a template that runs
       {PROG} compare RUN_A RUN_B    two runs, figure by figure
"""

COMMANDS = ("list", "new", "compare")
"""Names that no experiment can have."""

ANSWER = "<perceive> xense soft </perceive> <compare> soft </compare> <conclude> soft </conclude>"
"""An answer to try a reward on."""


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
            family = parts[0] if len(parts) > 1 else ""
            found[path.stem] = CatalogueEntry(module=module, family=family, question=question)
    return dict(sorted(found.items(), key=lambda item: (item[1].family, item[0])))


def _defines_experiment(tree: ast.Module) -> bool:
    targets = [t for node in tree.body if isinstance(node, ast.Assign) for t in node.targets]
    targets += [node.target for node in tree.body if isinstance(node, ast.AnnAssign)]
    return any(isinstance(t, ast.Name) and t.id == "EXPERIMENT" for t in targets)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ListCommand:
    """List every experiment by family with the cost and the result of its newest run; with a name, all its runs."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = ""
    """An experiment."""
    runs_dir: Path = Path("runs")
    """Folder of all runs."""

    def run(self, package: str) -> int:
        """Print the list and return the exit status."""
        entries = find(package)
        if self.name and self.name not in entries:
            print_error(unknown_name(self.name, entries))
            return 2
        if self.name:
            print_lines(listing_of_runs(self.name, entries[self.name].question, self.runs_dir))
        else:
            print_lines(listing(entries, self.runs_dir))
        return 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewCommand:
    """Start an ablation from a template; with `--reward` also a reward and its test.  All of them run."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Of the experiment, and of the reward."""
    reward: bool = False
    """Make a reward of that name for the experiment to try."""
    root: Path = runs.ROOT
    """The checkout to write in."""

    def run(self, package: str) -> int:
        """Write the files, print the next steps, and return the exit status."""
        folders = (path.name for path in (self.root / "experiments").glob("*/"))
        try:
            made, changed = write_new(
                self.root, self.name, reward=self.reward, taken={*COMMANDS, *folders, *find(package)}
            )
        except (NewError, OSError) as error:
            print_error(f"{type(error).__name__}: {error}")
            return 1
        lines = [f"made     {path}" for path in made] + [f"changed  {path}" for path in changed]
        print_lines(*lines, "", "The experiment runs as it is.  Next:", *(f"  {step}" for step in self._next_steps()))
        return 0

    def _next_steps(self) -> Sequence[str]:
        run = [
            f"edit {FAMILY}/{self.name}.py: its question, its arms, the result that you expect",
            f'make experiment EXP={self.name} ARGS="--scale smoke"',
            f"make experiment EXP={self.name}",
        ]
        if not self.reward:
            return run
        return [
            f"edit touchr1_jax/rewards/{self.name}.py: the formula, in its docstring and below",
            f"edit tests/touchr1_jax/rewards/test_{self.name}.py: its hand values",
            f"python -m pytest tests/touchr1_jax/rewards/test_{self.name}.py",
            f'python -m touchr1_jax.rewards explain --weights {self.name} 1 --text "{ANSWER}"',
            *run,
        ]


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareCommand:
    """Compare two finished runs: settings, code, every figure.

    A run is its directory, `NAME/STAMP`, or `NAME` for the latest of an experiment.
    """

    run_a: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_A")]
    run_b: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_B")]
    runs_dir: Path = Path("runs")
    """Folder of all runs."""
    most: int = 40
    """Differing figures to show."""

    def run(self, package: str) -> int:
        """Print the comparison and return the exit status."""
        del package
        from experiments.core.compare import ComparisonError, compare_runs  # SciPy, which no other command needs

        try:
            a, b = (read_run(locate(name, self.runs_dir)) for name in (self.run_a, self.run_b))
            print_lines(compare_runs(a, b, self.most))
        except (ComparisonError, DamagedFileError, FileNotFoundError) as error:
            print_error(f"{type(error).__name__}: {error}")
            return 1
        return 0


Command = (
    Annotated[ListCommand, tyro.conf.subcommand("list")]
    | Annotated[NewCommand, tyro.conf.subcommand("new")]
    | Annotated[CompareCommand, tyro.conf.subcommand("compare")]
)


def run_command(arguments: Sequence[str], package: str) -> int | None:
    """Run one of `COMMANDS`, print help, or correct a name; the exit status, `None` where an experiment is named."""
    if arguments and arguments[0] in COMMANDS:
        return tyro.cli(Command, args=arguments, prog=PROG, config=(tyro.conf.OmitArgPrefixes,)).run(package)
    entries = find(package)
    if not arguments or arguments[0] in ("-h", "--help"):
        print_lines(USAGE, listing(entries))
        return 0 if arguments else 2
    if arguments[0] in entries:
        return None
    print_error(f"{unknown_name(arguments[0], entries)}\n{listing(entries)}")
    return 2


def unknown_name(name: str, entries: Mapping[str, CatalogueEntry]) -> str:
    """The error for a name that no experiment has."""
    close = difflib.get_close_matches(name, entries)
    return f"There is no experiment {name!r}." + (f" Did you mean {' or '.join(close)}?" if close else "")


def listing(entries: Mapping[str, CatalogueEntry], runs_dir: Path | None = None) -> str:
    """Experiments by family; with a folder of runs, below each one its newest run and the start of its verdict."""
    lines: list[str] = []
    width = max(map(len, entries), default=0)
    for family in dict.fromkeys(entry.family for entry in entries.values()):
        lines += ["", f"{family}:"] if family else []
        for name in (name for name, entry in entries.items() if entry.family == family):
            lines.append(f"  {name:<{width}}  {entries[name].question}")
            past, damaged = _readable(runs_dir / name) if runs_dir else ([], [])
            for run in past[:1]:
                more = f" (and {len(past) - 1} more)" if len(past) > 1 else ""
                lines.append(f"  {'':<{width}}    {summary(run)}{more}  {' '.join(run.outcome[:1])}".rstrip())
            lines += [f"  {'':<{width}}    {complaint}" for complaint in damaged]
    return "\n".join(lines).strip("\n")


def listing_of_runs(name: str, question: str, runs_dir: Path) -> str:
    """Every run of one experiment with its whole verdict, the newest first."""
    past, damaged = _readable(runs_dir / name)
    lines = [f"{name}: {question}"]
    for run in past:
        report = run.directory / "report.html"
        lines += [f"  {summary(run)}", *(f"      {sentence}" for sentence in run.outcome)]
        lines += [f"      report: {report}"] if report.exists() else []
    lines += [f"  {complaint}" for complaint in damaged]
    return "\n".join(lines if len(lines) > 1 else [*lines, f"  has not run under {runs_dir}"])


def _readable(home: Path) -> tuple[list[PastRun], list[str]]:
    """The readable runs under `runs/NAME`, the newest first, and the errors of the others."""
    past, damaged = [], []
    for directory in sorted(runs.started(home), reverse=True):
        try:
            past.append(read_run(directory))
        except (DamagedFileError, FileNotFoundError) as error:
            damaged.append(str(error))
    return past, damaged


def print_lines(*texts: str) -> None:
    """Print lines as they are."""
    Console(soft_wrap=True, highlight=False).print(*texts, sep="\n", markup=False)


def print_error(text: str) -> None:
    """Print to standard error."""
    Console(stderr=True, soft_wrap=True, highlight=False).print(text, markup=False)
