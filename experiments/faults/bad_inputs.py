"""Some forty kinds of bad input to the public command lines; each must be answered with error, place and way out."""

import contextlib
import dataclasses
import functools
import hashlib
import io
import shlex
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import jax.numpy as jnp

from experiments.bench import __main__ as bench
from experiments.core import runner, runs
from experiments.faults.fixtures import (
    COUNTING,
    cut,
    emptied,
    flipped,
    full_disk,
    newest_checkpoints,
    replaced,
    run_directory,
    write_pictures,
    write_records,
)
from experiments.faults.trainings import PACKAGE
from sensors_io import __main__ as sensors_io
from touchr1_jax.rewards import __main__ as rewards
from touchr1_jax.training.checkpoint import Checkpoints

PROGRAMS: Mapping[str, Callable[[list[str]], int]] = {
    "experiments": runner.main,
    "trainings": lambda arguments: runner.main(arguments, package=PACKAGE),
    "sensors_io": sensors_io.main,
    "bench": bench.main,
    "rewards": rewards.main,
}

REWRITTEN = frozenset({"metrics.jsonl", "timing.json", "report.html"})
"""Files of a run that a session rewrites as it goes on, whole each time."""

LOCKS = frozenset({".lock", ".lockfile"})  # empty files that only serve as locks

Kind = Literal["command line", "configuration", "records", "recordings", "run", "checkpoint", "answers", "disk"]

Prepare = Callable[[Path], None]  # put something into a folder


@dataclasses.dataclass(frozen=True)
class BadInput:
    """One kind of bad input."""

    kind: Kind  # where the fault lies
    name: str  # what it is
    command: str  # the command line, a program of `PROGRAMS` first; {folder} stands for the folder that it works in
    error: str  # text that the message must hold, as the next two
    where: str
    way_out: str
    prepare: Prepare = lambda folder: None  # puts the input into the folder
    around: Callable[[Path], contextlib.AbstractContextManager[None]] = lambda folder: contextlib.nullcontext()
    """What holds while the command runs, such as a limit."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class InputOutcome:
    """The end of a command that met a bad input: exit code, output, and files that were lost or left half-written."""

    case: BadInput
    code: int
    output: str
    lost: tuple[str, ...]
    half: tuple[str, ...]

    @property
    def faults(self) -> tuple[str, ...]:
        """Everything that is wrong with the answer; empty for a good one."""
        wanted = {"error": self.case.error, "place": self.case.where, "fix": self.case.way_out}
        missing = [f"the message names no {name} {text!r}" for name, text in wanted.items() if text not in self.output]
        code = ["the exit code is 0"] if self.code == 0 else []
        files = [*(f"lost {name}" for name in self.lost), *(f"half-written {name}" for name in self.half)]
        return (*code, *missing, *files)

    @property
    def line(self) -> str:
        """The line of the output that names the place, or else the error; empty if none does."""
        lines = [line.strip(" │") for line in self.output.splitlines()]
        named = [line for text in (self.case.where, self.case.error) for line in lines if text in line]
        return named[0] if named else ""


def provoke(case: BadInput, folder: Path) -> InputOutcome:
    """Prepare a case in an empty folder, run its command in this process, and compare the files before and after."""
    case.prepare(folder)
    before = contents(folder)
    program, *arguments = (word.replace("{folder}", str(folder)) for word in shlex.split(case.command))
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), case.around(folder):
        code = _exit_code(PROGRAMS[program], arguments)
    after = contents(folder)
    kept = set(after.values())
    return InputOutcome(
        case=case,
        code=code,
        output=err.getvalue() + out.getvalue(),
        lost=tuple(name for name, digest in before.items() if digest not in kept and Path(name).name not in REWRITTEN),
        half=tuple(name for name in after if name not in before and _half_written(name)),
    )


def contents(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder, by path, without locks and links."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink() and path.name not in LOCKS
    }


def _exit_code(program: Callable[[list[str]], int], arguments: list[str]) -> int:
    """The exit code that a shell would see; an exception is printed as the interpreter would print it."""
    try:
        return program(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    except Exception as error:  # the interpreter itself would print it
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        return 1


def _half_written(name: str) -> bool:
    parts = Path(name).parts
    return any(part.startswith(".") or "tmp" in part for part in parts) and parts[-1] not in LOCKS


def cases(unfinished: Path) -> tuple[BadInput, ...]:
    """All cases; `unfinished` is a folder that `fixtures.unfinished_run` filled."""
    return (*typed(), *records(), *recordings(), *run_files(unfinished))


def typed() -> tuple[BadInput, ...]:
    """Typing mistakes, values that contradict each other or make no sense, and a line that is not JSON."""
    line, values = (functools.partial(BadInput, kind) for kind in ("command line", "configuration"))
    study = "experiments ablation_ordinal"
    return (
        line("an unknown experiment", "experiments ablation_ordinl", "There is no experiment",
             "'ablation_ordinl'", "Did you mean ablation_ordinal"),
        line("an unknown option", f"{study} --grpo-stepz 3", "Unrecognized", "--grpo-stepz", "--grpo-steps"),
        line("text in place of a number", f"{study} --seeds many", "Error parsing", "--seeds", "INT"),
        line("an unknown scale", f"{study} --scale huge", "invalid choice", "'huge'", "smoke"),
        line("an unknown run", "experiments compare nothing nowhere --runs-dir {folder}", "FileNotFoundError",
             "'nothing'", "must be a directory with config.json"),
        line("a label that no object has", "rewards explain --text soft --label hardness pink", "ExplainError",
             "'pink'", "correct the word"),
        values("micro-batches that do not divide the batch", f"{study} --sft.micro-contacts 5", "Value error",
               "micro_contacts is 5", "must divide batch_size"),
        values("answers of two lengths", f"{study} --grpo.length 9", "ValueError", "grpo.length is 9", "set both"),
        values("a negative weight", f"{study} grpo.algorithm:paper --grpo.algorithm.beta -1", "Value error",
               "beta is -1.0", "must be ≥ 0"),
        values("a checkpoint every zero steps", f"{COUNTING} --save-every 0", "ValueError", "save_every is 0",
               "must be at least 1"),
        values("recordings without a folder",
               f"{study} --data records --runs-dir {{folder}}/runs --cache-dir {{folder}}/cache", "ValueError",
               "data_dir is None", "needs data_dir"),
        values("scenes without an object", "sensors_io generate --out {folder}/new --objects 0", "Value error",
               "objects", "must be"),
        BadInput("answers", "a line that is not JSON", "bench score {folder}/questions.jsonl {folder}/answers.jsonl",
                 "LinesError", "line 1", "must be one JSON object", _text("questions.jsonl", '{"id": 1\n')),
    )  # fmt: skip


def records() -> tuple[BadInput, ...]:
    """Damaged records that `check` reads, and paths at which no records can be written."""
    index, shard, objects = "index.json", "contacts-00000.arrayrecord", "objects-00000.arrayrecord"
    corrupt, again, rewrite = "CorruptRecordsError", "copy it again", "write it again"
    other_version = functools.partial(replaced, old='"version":3', new='"version":9')
    damaged: tuple[tuple[str, str, Prepare, str, str, str], ...] = (
        ("no index", index, Path.unlink, "MissingIndexError", "records", "give the directory"),
        ("an index cut in half", index, cut, corrupt, "records", rewrite),
        ("an empty index", index, emptied, corrupt, "records", rewrite),
        ("an index that cannot be read", index, _unreadable, "RecordsError", "records", again),
        ("an index of another version", index, other_version, "RecordsVersionError", "records", "write the records"),
        ("a missing shard", shard, Path.unlink, corrupt, "is missing", again),
        ("a shard cut in half", shard, cut, corrupt, "bytes where", again),
        ("an empty shard", shard, emptied, corrupt, "has 0 bytes", again),
        ("a flipped byte in a shard", shard, flipped, corrupt, "records", "copy the file again"),
        ("a flipped byte in the objects", objects, flipped, corrupt, "records", "copy"),
    )

    def prepared(file: str, damage: Prepare, folder: Path) -> None:
        write_records(folder)
        damage(folder / "records" / file)

    check, command = functools.partial(BadInput, "records"), "sensors_io check {folder}/records"
    return (
        *(
            check(name, command, error, where, fix, functools.partial(prepared, file, damage))
            for name, file, damage, error, where, fix in damaged
        ),
        check("records whose writing has not ended", command, "IncompleteRecordsError", "records",
              "run its command again", functools.partial(write_records, complete=False)),
        check("records made with other settings", "sensors_io generate --out {folder}/records", "RecordsExistError",
              "made by config 'made up'", "choose another directory", write_records),
        check("a file where records should go", "sensors_io generate --out {folder}/taken", "RecordsExistError",
              "taken", "choose another path", _text("taken", "something else")),
    )  # fmt: skip


def recordings() -> tuple[BadInput, ...]:
    """Pictures and folders that a command cannot use."""
    recorded, source = functools.partial(BadInput, "recordings"), "ImportSourceError"
    extract = "sensors_io extract {folder}/%s --background {folder}/rest.png --out {folder}/out.npz --mm-per-px 0.06"
    tac3d = "sensors_io import tac3d {folder}/%s --out {folder}/new"
    return (
        recorded("a missing picture", extract % "no.png", "Error", "no.png", "replace it", write_pictures),
        recorded("a file that is not a picture", extract % "none.png", "Error", "none.png", "picture", write_pictures),
        recorded("sizes that differ", extract % "press.png", "Error", "(120, 160)", "crop them", write_pictures),
        recorded("a missing folder to import", tac3d % "nowhere", source, "nowhere", "give"),
        recorded("an empty folder to import", tac3d % "empty", source, "empty", "give",
                 lambda folder: (folder / "empty").mkdir()),
    )  # fmt: skip


def run_files(unfinished: Path) -> tuple[BadInput, ...]:
    """Files of an unfinished run, its data, and its disk; each case continues a copy of the run."""
    damaged, none_left, unwritten = "DamagedFileError", "DamagedCheckpointError", "UnwrittenError"

    def case(
        kind: Kind, name: str, error: str, where: str, way_out: str, damage: Prepare = lambda folder: None
    ) -> BadInput:
        def prepare(folder: Path) -> None:
            shutil.copytree(unfinished, folder, dirs_exist_ok=True, symlinks=True)
            damage(folder)

        return BadInput(kind, name, COUNTING, error, where, way_out, prepare)

    locked = case("run", "another process in the run", "RunInUse", "runs/counting", "--fresh")
    full = case("disk", "a disk that fills up", unwritten, "cannot be written", "free some space")
    return (
        case("run", "a damaged configuration", damaged, "config.json", "move its run away", _cut_file("config.json")),
        case("run", "damaged wall times", damaged, "timing.json", "put a copy back", _cut_file("timing.json")),
        case("run", "a damaged line in the log", damaged, "metrics.jsonl", "put a copy back", _damaged_log),
        dataclasses.replace(locked, around=lambda folder: runs.locked(run_directory(folder))),
        case("checkpoint", "every checkpoint cut", none_left, "damaged-*", "put copies", _every_state(cut)),
        case("checkpoint", "every checkpoint empty", none_left, "[12, 8]", "put copies", _every_state(emptied)),
        case("checkpoint", "a changed iterator", none_left, "data/metadata does not hold", "copies", _changed_iterator),
        case("checkpoint", "other shapes", "CheckpointError", "holds another state", "go back to", _other_shapes),
        case("checkpoint", "a file in their place", unwritten, "count/0", "move away", _file_for_folder),
        BadInput("run", "targets that are NaN from step 5 on", f"{COUNTING} --poison-from 5", "NonFiniteGradientError",
                 "step 8", "lower the learning rate"),
        dataclasses.replace(full, around=full_disk),
    )  # fmt: skip


def _text(name: str, text: str) -> Prepare:
    """Puts a file of that text into a folder."""

    def write(folder: Path) -> None:
        (folder / name).write_text(text, encoding="utf-8")

    return write


def _unreadable(path: Path) -> None:
    """A file that opens and whose bytes cannot be read, as on a failing disk (EIO); root may read all others."""
    path.unlink()
    path.symlink_to("/proc/self/mem")


def _cut_file(name: str) -> Prepare:
    return lambda folder: cut(run_directory(folder) / name)


def _damaged_log(folder: Path) -> None:
    replaced(run_directory(folder) / "metrics.jsonl", '"step": 1,', '"step": 1;')


def _every_state(damage: Prepare) -> Prepare:
    """Damages the files that hold the arrays of every checkpoint."""

    def prepare(folder: Path) -> None:
        for checkpoint in newest_checkpoints(folder):
            for path in (checkpoint / "state" / "d").iterdir():
                damage(path)

    return prepare


def _changed_iterator(folder: Path) -> None:
    for checkpoint in newest_checkpoints(folder):
        replaced(checkpoint / "data" / "metadata", '"next_index": ', '"next_index": 1')


def _other_shapes(folder: Path) -> None:
    """Adds a newer checkpoint, of a state that has four numbers."""
    with Checkpoints(newest_checkpoints(folder)[0].parent) as checkpoints:
        checkpoints.save(13, {"params": jnp.zeros(4)}, None)


def _file_for_folder(folder: Path) -> None:
    stage = newest_checkpoints(folder)[0].parent
    shutil.rmtree(stage)
    stage.write_text("no folder", encoding="utf-8")
