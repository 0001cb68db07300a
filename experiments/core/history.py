"""What ran: the runs of every experiment, what each cost and what came out."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.core import runs
from experiments.core.artifacts import DamagedFileError, read_json
from experiments.core.catalogue import Entry
from experiments.core.text import duration

TOLD = frozenset({"experiment", "scale", "config", "git", "command"})
"""What tells `config.json` of a run from that of a model."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Past:
    """A run as its directory tells it.

    Attributes:
      directory: `runs/NAME/STAMP`.
      description: content of `config.json`.
      seconds: wall time of all its sessions; `None` before the first one ended.
      results: content of `results.json`; `None` while it is unfinished.
      held: a process is working in it.
    """

    directory: Path
    description: Mapping[str, Any]
    seconds: float | None
    results: Mapping[str, Any] | None
    held: bool

    @property
    def name(self) -> str:
        """The experiment's."""
        return self.description["experiment"]

    @property
    def state(self) -> str:
        """`finished`, `going on`, or `unfinished`."""
        if self.results is not None:
            return "finished"
        return "going on" if self.held else "unfinished"

    @property
    def code(self) -> str:
        """Short commit, with a plus where files differed from it; the version of a package without a checkout."""
        git = self.description["git"]
        if git["commit"] == runs.UNKNOWN:
            return f"version {self.description['versions'].get(runs.PACKAGES[0], runs.UNKNOWN)}"
        return git["commit"][:7] + ("+" if git["dirty"] else "")

    @property
    def outcome(self) -> tuple[str, ...]:
        """Sentences of the verdict, led by how many requirements were met; how to go on where there is none."""
        if self.results is None:
            return (f"to go on: {runs.go_on(self.description['command'])}",) if self.state == "unfinished" else ()
        held = [r["met"] for r in self.results.get("requirements", ())]  # older runs of trained arms have none
        met = [f"{sum(held)} of {len(held)} requirements met."] if held else []
        return (*met, *self.results["verdict"])


def read_run(directory: Path) -> Past:
    """What lies in the directory of one run.

    Raises:
      FileNotFoundError: no `config.json` there, or not that of a run.
      DamagedFileError: a file that is not what was written.
    """
    if not (directory / "config.json").exists():
        raise FileNotFoundError(f"{directory} holds no config.json: must be the directory of a run; correct the path")
    description = read_json(directory / "config.json")
    if not isinstance(description, Mapping) or not description.keys() >= TOLD:
        raise FileNotFoundError(
            f"{directory / 'config.json'} is not that of a run: must be its directory; correct the path"
        )
    times = directory / "timing.json"
    results = directory / "results.json"
    return Past(
        directory=directory,
        description=description,
        seconds=read_json(times).get("total") if times.exists() else None,  # stages come before the total
        results=read_json(results) if results.exists() else None,
        held=runs.held(directory),
    )


def runs_of(home: Path) -> list[Past]:
    """Every run under `runs/NAME`, the newest first."""
    return [read_run(directory) for directory in sorted(runs.started(home), reverse=True)]


def seconds_of_last(home: Path, config: Any) -> float | None:
    """Wall seconds of the newest finished run under `runs/NAME` with this configuration, or `None`.

    Args:
      config: the resolved configuration in JSON's types.
    """
    for directory in sorted(runs.started(home), reverse=True):
        finished = (directory / "results.json").exists()
        if finished and read_json(directory / "config.json")["config"] == config:
            return read_run(directory).seconds
    return None


def locate(name: str, runs_dir: Path) -> Path:
    """The directory that a run is meant by: its path, `NAME/STAMP`, or `NAME` for the latest of an experiment.

    Raises:
      FileNotFoundError: none of them.
    """
    choices = (Path(name), Path(name) / "latest", runs_dir / name, runs_dir / name / "latest")
    for directory in choices:
        if (directory / "config.json").exists():
            return directory.resolve()
    raise FileNotFoundError(
        f"{name!r} is no run: must be a directory with config.json, NAME/STAMP or NAME under {runs_dir}; "
        "`python -m experiments list` shows what ran"
    )


def listing_with_runs(entries: Mapping[str, Entry], runs_dir: Path) -> str:
    """Experiments by family, and below each one line for its newest run with the first sentence of its verdict."""
    lines: list[str] = []
    width = max(map(len, entries), default=0)
    for name, entry in sorted(entries.items(), key=lambda item: (item[1].family, item[0])):
        if entry.family and f"{entry.family}:" not in lines:
            lines += ["", f"{entry.family}:"] if lines else [f"{entry.family}:"]
        lines.append(f"  {name:<{width}}  {entry.question}")
        past, damaged = _readable(runs_dir / name)
        for run in past[:1]:
            more = f" (and {len(past) - 1} more)" if len(past) > 1 else ""
            lines.append(f"  {'':<{width}}    {summary(run)}{more}  {' '.join(run.outcome[:1])}".rstrip())
        lines += [f"  {'':<{width}}    {complaint}" for complaint in damaged]
    return "\n".join(lines)


def listing_of_runs(name: str, question: str, runs_dir: Path) -> str:
    """Every run of one experiment, the newest first, with all that it says."""
    past, damaged = _readable(runs_dir / name)
    if not past and not damaged:
        return f"{name}: {question}\n  has not run under {runs_dir}"
    blocks = [[f"  {summary(run)}", *(f"      {s}" for s in run.outcome), f"      {_report(run)}"] for run in past]
    blocks.append([f"  {complaint}" for complaint in damaged])
    return "\n".join([f"{name}: {question}", *(line.rstrip() for block in blocks for line in block if line.strip())])


def summary(run: Past) -> str:
    """Stamp, scale, code, state and cost of a run."""
    cost = "" if run.seconds is None else f", {duration(run.seconds)}"
    return f"{run.directory.name}  {run.description['scale']}, code {run.code}: {run.state}{cost}"


def _readable(home: Path) -> tuple[list[Past], list[str]]:
    """Every run under `runs/NAME` that can be read, the newest first, and what is wrong with the others."""
    past, damaged = [], []
    for directory in sorted(runs.started(home), reverse=True):
        try:
            past.append(read_run(directory))
        except (DamagedFileError, FileNotFoundError) as error:
            damaged.append(str(error))
    return past, damaged


def _report(run: Past) -> str:
    report = run.directory / "report.html"
    return f"report: {report}" if report.exists() else ""
