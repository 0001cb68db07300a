"""Finished and unfinished runs, read from their directories."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.core import runs
from experiments.core.artifacts import read_json
from experiments.core.text import duration

FIELDS = frozenset({"experiment", "scale", "config", "git", "command"})
"""Fields in `config.json` of a run; that of a model has others."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PastRun:
    """A run, read from its directory.

    Attributes:
      directory: `runs/NAME/STAMP`.
      description: content of `config.json`.
      seconds: wall time of all its sessions; `None` before the first one ended.
      results: content of `results.json`; `None` while it is unfinished.
      in_use: a process is working in it.
    """

    directory: Path
    description: Mapping[str, Any]
    seconds: float | None
    results: Mapping[str, Any] | None
    in_use: bool

    @property
    def name(self) -> str:
        """The experiment's."""
        return self.description["experiment"]

    @property
    def state(self) -> str:
        """`finished`, `running`, or `unfinished`."""
        if self.results is not None:
            return "finished"
        return "running" if self.in_use else "unfinished"

    @property
    def code(self) -> str:
        """Short commit, with a plus where files differed from it; the version of a package without a checkout."""
        git = self.description["git"]
        if git["commit"] == runs.UNKNOWN:
            return f"version {self.description['versions'].get(runs.PACKAGES[0], runs.UNKNOWN)}"
        return git["commit"][:7] + ("+" if git["dirty"] else "")

    @property
    def outcome(self) -> tuple[str, ...]:
        """The number of requirements met and the verdict; of an unfinished run the command that continues it."""
        if self.results is None:
            return (
                (f"to continue: {runs.continuing(self.description['command'])}",) if self.state == "unfinished" else ()
            )
        kept = [r["met"] for r in self.results.get("requirements", ())]  # older runs of trained arms have none
        met = [f"{sum(kept)} of {len(kept)} requirements met."] if kept else []
        return (*met, *self.results["verdict"])


def read_run(directory: Path) -> PastRun:
    """Read the directory of a run.

    Raises:
      FileNotFoundError: no `config.json`, or not that of a run.
      DamagedFileError: a damaged file.
    """
    if not (directory / "config.json").exists():
        raise FileNotFoundError(f"{directory} holds no config.json: must be the directory of a run; correct the path")
    description = read_json(directory / "config.json")
    if not isinstance(description, Mapping) or not description.keys() >= FIELDS:
        raise FileNotFoundError(
            f"{directory / 'config.json'} is not that of a run: must be its directory; correct the path"
        )
    times = directory / "timing.json"
    results = directory / "results.json"
    return PastRun(
        directory=directory,
        description=description,
        seconds=read_json(times).get("total") if times.exists() else None,  # stages come before the total
        results=read_json(results) if results.exists() else None,
        in_use=runs.in_use(directory),
    )


def runs_of(home: Path) -> list[PastRun]:
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
    """Find the directory of a run by its path, by `NAME/STAMP`, or by `NAME` for the latest of an experiment.

    Raises:
      FileNotFoundError: there is none.
    """
    choices = (Path(name), Path(name) / "latest", runs_dir / name, runs_dir / name / "latest")
    for directory in choices:
        if (directory / "config.json").exists():
            return directory.resolve()
    raise FileNotFoundError(
        f"{name!r} is no run: must be a directory with config.json, NAME/STAMP or NAME under {runs_dir}; "
        "`python -m experiments list` shows all runs"
    )


def summary(run: PastRun) -> str:
    """Stamp, scale, code, state and cost of a run."""
    cost = "" if run.seconds is None else f", {duration(run.seconds)}"
    return f"{run.directory.name}  {run.description['scale']}, code {run.code}: {run.state}{cost}"
