"""Run directories `runs/NAME/STAMP`: creating, finding and locking them, and the provenance of the code.

    runs/NAME/latest -> STAMP
    runs/NAME/STAMP/{config.json, metrics.jsonl, timing.json, stages/, checkpoints/, plots/, report.html, results.json}

`results.json` is written last: a run without one is unfinished.
"""

import contextlib
import dataclasses
import datetime
import fcntl
import importlib.metadata
import os
import platform
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from experiments.core.artifacts import point_link, read_json, write_json

PACKAGES = ("touchr1-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "chex", "numpy")
"""Packages whose versions are kept with a run."""

UNKNOWN = "unknown"
"""Commit of code outside a checkout."""

ROOT = Path(__file__).resolve().parents[2]
"""The checkout of this code, if there is one."""


class RunInUse(RuntimeError):
    """Another process is working in the run directory."""


class NoCheckoutError(FileNotFoundError):
    """The code is installed without a checkout."""


def checkout(root: Path = ROOT) -> Path:
    """The top of the checkout of this code.

    Raises:
      NoCheckoutError: there is none.
    """
    if not (root / "pyproject.toml").exists():
        raise NoCheckoutError(
            f"{root} holds no pyproject.toml: must be a checkout of the project; clone it and work there"
        )
    return root


@dataclasses.dataclass(frozen=True, kw_only=True)
class Revision:
    """The commit of the code, `unknown` outside a checkout; `dirty`: unignored files differed from it."""

    commit: str
    dirty: bool

    def __str__(self) -> str:
        return f"{self.commit}-dirty" if self.dirty else self.commit


def revision(root: Path = ROOT) -> Revision:
    """The revision of a checkout, `unknown` where there is no git or `root` is not the top of a checkout."""
    top = _git(root, "rev-parse", "--show-toplevel")
    commit = _git(root, "rev-parse", "HEAD")
    if top is None or commit is None or Path(top).resolve() != root.resolve():
        return Revision(commit=UNKNOWN, dirty=False)
    return Revision(commit=commit, dirty=bool(_git(root, "status", "--porcelain")))


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide what a run computes."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def newest_unfinished(home: Path, config: Any) -> Path | None:
    """The newest run under `runs/NAME` with this resolved configuration and no results, or `None`.

    Args:
      config: the resolved configuration in JSON's types.
    """
    for directory in sorted(started(home), reverse=True):
        if read_json(directory / "config.json")["config"] == config and not (directory / "results.json").exists():
            return directory
    return None


def started(home: Path) -> list[Path]:
    """The run directories of an experiment; one without `config.json` never started."""
    if not home.is_dir():
        return []
    return [p for p in home.iterdir() if not p.is_symlink() and (p / "config.json").exists()]


def create(home: Path, description: dict[str, Any]) -> Path:
    """Make `runs/NAME/STAMP` with its `config.json`; the stamp is the local time, made unique by a suffix.

    Args:
      description: the resolved `config` and its provenance, in JSON's types.
    """
    home.mkdir(parents=True, exist_ok=True)
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    for suffix in ("", *(f"-{i:02d}" for i in range(2, 100))):
        directory = home / f"{stamp}{suffix}"
        with contextlib.suppress(FileExistsError):
            directory.mkdir()
            write_json(directory / "config.json", description)
            return directory
    raise RuntimeError(f"{home / stamp} and 98 more were made within this second; wait for the next second")


def describe(name: str, scale: str, config: Any, command: str) -> dict[str, Any]:
    """The content of `config.json`: the resolved configuration and everything needed to run it again."""
    return {
        "experiment": name,
        "scale": scale,
        "config": config,
        "git": dataclasses.asdict(revision()),
        "versions": versions(),
        "machine": {"system": platform.system(), "machine": platform.machine(), "cpus": os.cpu_count()},
        "command": command,
    }


def point_latest(directory: Path) -> None:
    """Let `runs/NAME/latest` point to a run."""
    point_link(directory.parent / "latest", directory.name)


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Lock a run directory for this process; the lock ends with the process.

    Raises:
      RunInUse: another process has locked it.
    """
    with (directory / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunInUse(
                f"{directory} is in use by another process: two would overwrite each other; "
                "wait for it, stop it, or start a new run with --fresh"
            ) from None
        yield


def in_use(directory: Path) -> bool:
    """True if a process works in a run directory; while this checks, none can begin."""
    lock = directory / ".lock"
    if not lock.exists():
        return False
    with lock.open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def continuing(command: str) -> str:
    """The command that continues the run of a command."""
    return shlex.join(part for part in shlex.split(command) if part != "--fresh")


def _git(root: Path, *arguments: str) -> str | None:
    """The output of a git command, `None` without git or a checkout."""
    try:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None
