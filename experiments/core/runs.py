"""Run directories `runs/NAME/STAMP`: creating, locking, finding and reading them, and the provenance of the code.

    runs/NAME/latest -> STAMP
    runs/NAME/STAMP/{config.json, metrics.jsonl, timing.json, stages/, checkpoints/, plots/, report.html, results.json}

`results.json` is written last: a run without one is unfinished.
"""

import contextlib
import dataclasses
import datetime
import fcntl
import functools
import hashlib
import importlib.metadata
import json
import operator
import os
import platform
import shlex
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from experiments.core.artifacts import (
    DamagedFileError,
    fitting,
    make_folder,
    no_place,
    point_link,
    read_json,
    write_sealed,
)
from experiments.core.text import MEANINGLESS, SMOKE, duration

PACKAGES = ("touchr1-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "chex", "numpy")
"""Packages whose versions are kept with a run."""

FIELDS = frozenset({"experiment", "scale", "config", "git", "command"})
"""Fields in `config.json` of a run; that of a model has others."""

LATEST = "latest"  # link to the newest run that computes, in the folder of the runs
UNKNOWN = "unknown"  # commit of code outside a checkout
ROOT = Path(__file__).resolve().parents[2]  # the checkout of this code, if there is one


class RunInUse(RuntimeError):
    """Another process is working in the run directory."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Revision:
    """The commit of the code, `unknown` outside a checkout; `dirty`: unignored files differed from it."""

    commit: str
    dirty: bool

    def __str__(self) -> str:
        return f"{self.commit}-dirty" if self.dirty else self.commit


def revision(root: Path = ROOT) -> Revision:
    """The revision of a checkout, `unknown` where there is no git or `root` is not the top of a checkout."""
    top, commit = _git(root, "rev-parse", "--show-toplevel"), _git(root, "rev-parse", "HEAD")
    if top is None or commit is None or Path(top).resolve() != root.resolve():
        return Revision(commit=UNKNOWN, dirty=False)
    return Revision(commit=commit, dirty=bool(_git(root, "status", "--porcelain")))


def _git(root: Path, *arguments: str) -> str | None:
    """The output of a git command, `None` without git or a checkout."""
    try:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


@functools.cache
def code_digest(root: Path = ROOT) -> str:
    """Sixteen digits of the hash of all source files, which also counts what no commit holds."""
    sum_ = hashlib.sha256()
    for folder in ("touchr1_jax", "sensors_io", "experiments"):
        for path in sorted((root / folder).rglob("*.py")):
            sum_.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return sum_.hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide what a run computes."""
    found = {"python": platform.python_version()} | dict.fromkeys(PACKAGES, "not installed")
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def create(home: Path, description: dict[str, Any]) -> Path:
    """Make `runs/NAME/STAMP` with its `config.json`; the stamp is the time in UTC, made unique by a suffix."""
    make_folder(home, "runs-dir", home.parent)
    stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%d-%H%M%S")
    for suffix in ("", *(f"-{i:02d}" for i in range(2, 100))):
        directory = home / f"{stamp}{suffix}"
        try:
            directory.mkdir()
        except FileExistsError:
            continue
        except OSError as error:
            raise no_place("runs-dir", home.parent, error) from error
        write_sealed(directory / "config.json", description)
        return directory
    raise RuntimeError(f"{home / stamp} and 98 more were made within this second; wait for the next second")


def describe(
    name: str, scale: str, config: Any, command: str, *, settings: Mapping[str, Any], devices: Mapping[str, Any]
) -> dict[str, Any]:
    """The content of `config.json`: the resolved configuration and everything needed to run it again."""
    return {
        "experiment": name,
        "scale": scale,
        "config": config,
        "git": dataclasses.asdict(revision()),
        "source": code_digest(),
        "versions": versions(),
        "settings": settings,
        "machine": {"system": platform.system(), "machine": platform.machine(), "cpus": os.cpu_count(), **devices},
        "command": command,
    }


def point_latest(directory: Path) -> None:
    """Let `runs/NAME/latest` point to a run."""
    point_link(directory.parent / LATEST, directory.name)


@contextlib.contextmanager
def locked(directory: Path, otherwise: str = "start a new run with --fresh") -> Iterator[None]:
    """Lock the directory of a run for this process, until it ends; `RunInUse` if another process has locked it."""
    with (directory / ".lock").open("w") as file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if _in_use(directory):  # else somebody looks whether it is, and is done in a moment
                    raise RunInUse(
                        f"{directory} is in use by another process: two would overwrite each other; "
                        f"wait for it, stop it, or {otherwise}"
                    ) from None
        yield


def continuing(command: str) -> str:
    """The command that continues the run of a command."""
    return shlex.join(part for part in shlex.split(command) if part != "--fresh")


def started(home: Path) -> list[Path]:
    """The run directories under `runs/NAME`, the newest first; one without `config.json` never started."""
    found = home.iterdir() if home.is_dir() else ()
    return sorted((p for p in found if not p.is_symlink() and _has_config(p)), reverse=True)


def _has_config(directory: Path) -> bool:
    """True also where permissions hide the answer: who reads such a run learns that."""
    try:
        (directory / "config.json").stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True
    return True


def is_finished(directory: Path) -> bool:
    """True of a run whose report and results are written."""
    return (directory / "results.json").exists()


def newest(home: Path, config: Any, *, finished: bool) -> Path | None:
    """The newest finished, or unfinished, run of NAME under `runs/NAME` with this configuration in JSON's types."""
    of_kind = (run for run in started(home) if is_finished(run) == finished)
    about = lambda run: [read_description(run)[name] for name in ("experiment", "config")]
    return next((run for run in of_kind if about(run) == [home.name, config]), None)


def read_description(directory: Path) -> dict[str, Any]:
    """The content of `config.json` of a run; `DamagedFileError` if it is damaged, or not that of a run."""
    path = directory / "config.json"
    found = read_json(path)
    if not _describes_run(found):
        raise DamagedFileError(
            f"{path} is not that of a run (must hold {', '.join(sorted(FIELDS))}): put a copy back, or move its run "
            "away and start a new one"
        )
    return found


def labelled(directory: Path, name: str) -> str:
    """Name, experiment and configuration that a file of a run states, so that one of another run is not taken for it.

    A folder without `config.json`, such as a unit of work, is distinguished from others by its own name; one in the
    folder of a run, such as a part of it, by the run too.
    """
    about: Any = directory.name
    kind, above = operator.itemgetter("experiment", "config"), directory.parent / "config.json"
    if (directory / "config.json").exists():
        about = kind(read_description(directory))
    elif above.exists() and _describes_run(found := read_json(above)):
        about = [*kind(found), directory.name]
    return f"{name} {hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:8]}"


def _describes_run(found: Any) -> bool:
    """True of what `describe` makes, by its names and the types of what is shown of it."""
    if not isinstance(found, dict) or not found.keys() >= FIELDS:
        return False
    git, parts = found["git"], (found["config"], found.get("versions", {}), found.get("machine", {}))
    if not isinstance(git, dict) or git.keys() != {f.name for f in dataclasses.fields(Revision)}:
        return False
    words = (*(found[name] for name in ("experiment", "scale", "command")), git["commit"])
    return all(isinstance(part, dict) for part in parts) and all(isinstance(word, str) for word in words)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PastRun:
    """A run, read from its directory."""

    directory: Path  # `runs/NAME/STAMP`
    description: Mapping[str, Any]  # content of `config.json`
    seconds: float | None  # wall time of all its sessions; `None` before the first one ended
    results: Mapping[str, Any] | None  # content of `results.json`; `None` while it is unfinished
    in_use: bool  # a process is working in it

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
        if git["commit"] == UNKNOWN:
            return f"version {self.description['versions'].get(PACKAGES[0], UNKNOWN)}"
        return git["commit"][:7] + ("+" if git["dirty"] else "")

    @property
    def outcome(self) -> tuple[str, ...]:
        """The number of requirements met and the verdict; of an unfinished run the command that continues it."""
        if self.state == "unfinished":
            return (f"to continue: {continuing(self.description['command'])}",)
        if self.results is not None and self.description["scale"] == SMOKE:
            return (f"{MEANINGLESS}.",)
        results = self.results or {"verdict": ()}
        kept = [r["met"] for r in results.get("requirements", ())]  # older runs of trained arms have none
        met = [f"{sum(kept)} of {len(kept)} requirements met."] if kept else []
        return (*met, *results["verdict"])

    @property
    def summary(self) -> str:
        """Stamp, scale, code, state and cost."""
        cost = "" if self.seconds is None else f", {duration(self.seconds)}"
        return f"{self.directory.name}  {self.description['scale']}, code {self.code}: {self.state}{cost}"


def read_run(directory: Path) -> PastRun:
    """Read the directory of a run; `FileNotFoundError` without a `config.json`, `DamagedFileError` if damaged."""
    path, times, results = (directory / f"{name}.json" for name in ("config", "timing", "results"))
    if not path.exists():
        raise FileNotFoundError(f"{directory} holds no config.json: must be the directory of a run; correct the path")
    description = read_description(directory)
    run = PastRun(
        directory=directory,
        description=description,
        seconds=_object(times).get("total") if times.exists() else None,  # stages come before the total
        results=read_results(results, description) if results.exists() else None,
        in_use=_in_use(directory),
    )
    with fitting(times):  # what `list` shows is made once here, so that a file of another shape is named at once
        _ = run.summary
    with fitting(results):
        " ".join(run.outcome)
    return run


def read_results(path: Path, description: Mapping[str, Any]) -> dict[str, Any]:
    """The content of `results.json`; `DamagedFileError` if it is damaged, or of another run than its `config.json`."""
    found, git = _object(path, "verdict"), description.get("git")
    own = dict(description) | ({"git": str(Revision(**git))} if git else {})
    about = [name for name in ("git", "experiment", "scale", "config") if name in own]
    if other := [name for name in about if found.get(name, own[name]) != own[name]]:
        raise DamagedFileError(
            f"{path} is of another run, with another {', '.join(other)}: put its own copy back, or move it away and "
            "continue the run"
        )
    return found


def _object(path: Path, *lists: str) -> dict[str, Any]:
    """A JSON object of a run, in which some names hold lists.

    Raises:
      DamagedFileError: it is none.
    """
    found = read_json(path)
    if not isinstance(found, dict) or not all(isinstance(found.get(name), list) for name in lists):
        raise DamagedFileError(f"{path} is not that of a run: put a copy back, or move its run away")
    return found


def _in_use(directory: Path) -> bool:
    """True if a process works in a run directory; one that begins waits until this has checked."""
    lock = directory / ".lock"
    if not lock.is_file():
        return False
    with lock.open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def locate(name: str, runs_dir: Path) -> Path:
    """Directory of a run by `NAME/STAMP`, `NAME` for the latest, or its path; `FileNotFoundError` without one."""
    for directory in (runs_dir / name, runs_dir / name / LATEST, Path(name), Path(name) / LATEST):
        if (directory / "config.json").exists():
            return directory.resolve()
    raise FileNotFoundError(
        f"{name!r} is no run: must be a directory with config.json, NAME/STAMP or NAME under {runs_dir}; "
        "`python -m experiments list` shows all runs"
    )
