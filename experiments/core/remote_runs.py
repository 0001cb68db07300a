"""Runs at a URL: computed in a folder of this machine, copied to the URL as they go on, continued from there anywhere.

A store can neither lock nor append to a file, so one machine at a time may compute a run.
"""

import contextlib
import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

from experiments.core.commands import print_error, print_lines
from experiments.core.runs import LATEST
from sensors_io.remote import Mirror, StoreError
from touchr1_jax.training.checksums import CHECKSUMS

EVERY_S = 60.0  # between two copies: what a machine computed in the last minute before it is lost is computed again

RESULTS = "results.json"
_SEALS = "stages/logged/"  # of the log; one of another moment than the copied log would not hold of it
_HALF = ".orbax-checkpoint-tmp"  # in the name of a checkpoint that is being written
_LOG = logging.getLogger(__name__)


def run_at(url: str, name: str, execute: Callable[[Path], int]) -> int:
    """Compute a run of an experiment in a folder that is copied to `url`/`name`; the exit code.

    Args:
      url: of all runs.
      name: of the experiment.
      execute: runs or continues in a folder of runs; returns the exit code.

    Raises:
      StoreError: before anything is computed, if the store cannot be read.
    """
    runs_dir = Path(tempfile.mkdtemp(prefix="touchr1-runs-"))
    copier, ended = _Copier(Mirror(f"{url}/{name}"), runs_dir / name), threading.Event()
    copier.fetch()
    copying = threading.Thread(target=copier.copy_until, args=(ended,), daemon=True)
    copying.start()
    try:
        code = execute(runs_dir)
    finally:  # also what a run left that ended by an error of the code
        ended.set()
        copying.join()
        copied = copier.finish()
    return code if copied else code or 1


class _Copier:
    """Copies the runs of an experiment between a folder and a URL, of which the URL's are the true ones."""

    def __init__(self, remote: Mirror, folder: Path) -> None:
        self._remote, self._folder = remote, folder
        self._sent = dict[str, tuple[int, int]]()

    def fetch(self) -> None:
        """Take the unfinished runs of the URL.

        A checkpoint whose copy broke off lacks its checksums, which are sent last, and is left out.
        """
        files = self._remote.files()
        finished = {name.partition("/")[0] for name in files if name.partition("/")[2] == RESULTS}
        signed = tuple(name.removesuffix(CHECKSUMS) for name in files if name.endswith(f"/{CHECKSUMS}"))
        for name in files:
            run, _, inside = name.partition("/")
            whole = not inside.startswith("checkpoints/") or name.startswith(signed)
            elsewhere = run in (*finished, LATEST)  # an upload may have followed the link
            if whole and not elsewhere and not inside.startswith(_SEALS):
                (path := self._folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self._remote.fetch(name), path)
        self._sent = {name: _state(path) for name, path in self._files().items()}

    def copy_until(self, ended: threading.Event) -> None:
        """Copy every `EVERY_S` seconds; a store or a disk that fails is tried again the next time."""
        while not ended.wait(EVERY_S):
            if (error := self.failure()) is not None:
                _LOG.warning("%s: the run goes on, and is copied in %g s", error, EVERY_S)

    def finish(self) -> bool:
        """Copy the end of a run and remove it here; false, with a line, if it cannot be copied."""
        if (error := self.failure()) is not None:
            kept = f"The run is in {self._folder}: copy it to {self._remote} yourself"
            print_error(f"{type(error).__name__}: {error}\n{kept}")
            return False
        shutil.rmtree(self._folder.parent)
        print_lines(f"the run is at {self._remote}")
        return True

    def failure(self) -> Exception | None:
        """Copy what changed; the error that prevented it, if any."""
        try:
            self.copy()
        except (StoreError, OSError) as error:
            return error
        return None

    def copy(self) -> None:
        """Copy what changed.

        A run must go on from any part of a copy.  So finished stages and checkpoints are listed before the log is read
        and sent after it, which then has their lines; the results, which mark a run as finished, are sent last.
        """
        files = self._files()
        states = {name: _state(path) for name, path in files.items()}
        changed = sorted((name for name in files if self._sent.get(name) != states[name]), key=lambda n: not _whole(n))
        with tempfile.TemporaryDirectory(dir=self._folder.parent) as snapshot:
            kept = [name for name in changed if _keep(files[name], Path(snapshot, name))]
            rank = lambda name: (name.split("/")[1] == RESULTS, name.endswith(f"/{CHECKSUMS}"), _whole(name))
            self._remote.publish(Path(snapshot), sorted(kept, key=rank))
        self._sent |= {name: states[name] for name in kept}

    def _files(self) -> dict[str, Path]:
        """The files of all runs, without locks, the link to the latest run, seals and what is half-written."""
        found = dict[str, Path]()
        for run in (path for path in self._folder.glob("*") if not path.is_symlink()):
            # `rglob` fails where a folder is renamed or removed meanwhile, as those of checkpoints are
            for path in (Path(folder, file) for folder, _, files in os.walk(run) for file in files):
                name = path.relative_to(self._folder).as_posix()
                left_out = any(part[0] == "." or _HALF in part for part in name.split("/"))
                if path.is_file() and not left_out and not name.partition("/")[2].startswith(_SEALS):
                    found[name] = path
        return found


def _whole(name: str) -> bool:
    """True of a file that is written in one step and never changes."""
    return name.split("/")[1] in ("stages", "checkpoints")


def _state(path: Path) -> tuple[int, int]:
    """Size and time of a file, which change with its content."""
    with contextlib.suppress(FileNotFoundError):
        found = path.stat()
        return found.st_size, found.st_mtime_ns
    return -1, -1


def _keep(path: Path, target: Path) -> bool:
    """Keep a file as it is now, for the upload; false if it was removed, as an old checkpoint is."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileNotFoundError):
        shutil.copyfile(path, target)
        return True
    return False
