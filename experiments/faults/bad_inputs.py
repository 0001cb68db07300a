"""Some forty kinds of bad input through the public command lines; each must be answered by name, place and way out."""

import contextlib
import dataclasses
import functools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import jax.numpy as jnp

from experiments.core import runs
from experiments.faults.bad_input import BadInput, Kind
from experiments.faults.fixtures import (
    counting_paths,
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
from touchr1_jax.training.checkpoint import Checkpoints

FULL_BYTES = 6_000
"""The counting run's small files fit into so many; its report, which grows with its log, does not."""


def cases(unfinished: Path) -> tuple[BadInput, ...]:
    """All cases.

    Args:
      unfinished: a folder that `inputs.unfinished_run` filled.
    """
    return (*command_lines(), *configurations(), *records(), *recordings(), *answers(), *run_files(unfinished))


def command_lines() -> tuple[BadInput, ...]:
    """What is typed wrong."""
    study = ["ablation_ordinal"]
    return (
        BadInput(
            kind="command line",
            name="an experiment that there is not",
            program="experiments",
            arguments=lambda folder: ["ablation_ordinl"],
            error="There is no experiment",
            where="'ablation_ordinl'",
            fix="Did you mean ablation_ordinal",
        ),
        BadInput(
            kind="command line",
            name="an option that there is not",
            program="experiments",
            arguments=lambda folder: [*study, "--grpo-stepz", "3"],
            error="Unrecognized",
            where="--grpo-stepz",
            fix="--grpo-steps",
        ),
        BadInput(
            kind="command line",
            name="a number that is none",
            program="experiments",
            arguments=lambda folder: [*study, "--seeds", "many"],
            error="Error parsing",
            where="--seeds",
            fix="INT",
        ),
        BadInput(
            kind="command line",
            name="a scale that there is not",
            program="experiments",
            arguments=lambda folder: [*study, "--scale", "huge"],
            error="invalid choice",
            where="'huge'",
            fix="smoke",
        ),
        BadInput(
            kind="command line",
            name="a run that there is not",
            program="experiments",
            arguments=lambda folder: ["compare", "nothing", "nowhere", "--runs-dir", str(folder)],
            error="FileNotFoundError",
            where="'nothing'",
            fix="must be a directory with config.json",
        ),
        BadInput(
            kind="command line",
            name="a label that no object has",
            program="rewards",
            arguments=lambda folder: ["explain", "--text", "soft", "--label", "hardness", "pink"],
            error="ExplainError",
            where="'pink'",
            fix="correct the word",
        ),
    )


def configurations() -> tuple[BadInput, ...]:
    """Values that contradict each other or mean nothing."""
    study = ["ablation_ordinal"]
    return (
        BadInput(
            kind="configuration",
            name="micro-batches that do not divide the batch",
            program="experiments",
            arguments=lambda folder: [*study, "--sft.micro-contacts", "5"],
            error="Value error",
            where="micro_contacts is 5",
            fix="must divide batch_size",
        ),
        BadInput(
            kind="configuration",
            name="answers of two lengths",
            program="experiments",
            arguments=lambda folder: [*study, "--grpo.length", "9"],
            error="ValueError",
            where="grpo.length is 9",
            fix="set both",
        ),
        BadInput(
            kind="configuration",
            name="a negative weight",
            program="experiments",
            arguments=lambda folder: [*study, "grpo.algorithm:paper", "--grpo.algorithm.beta", "-1"],
            error="Value error",
            where="beta is -1.0",
            fix="must be ≥ 0",
        ),
        BadInput(
            kind="configuration",
            name="a checkpoint every zero steps",
            program="faults",
            arguments=lambda folder: ["counting", "--save-every", "0", *counting_paths(folder)],
            error="ValueError",
            where="save_every is 0",
            fix="must be at least 1",
        ),
        BadInput(
            kind="configuration",
            name="recordings without a folder",
            program="experiments",
            arguments=lambda folder: [*study, "--data", "records", *counting_paths(folder)],
            error="ValueError",
            where="data_dir is None",
            fix="needs data_dir",
        ),
        BadInput(
            kind="configuration",
            name="scenes without an object",
            program="sensors_io",
            arguments=lambda folder: ["generate", "--out", folder / "new", "--objects", "0"],
            error="Value error",
            where="objects",
            fix="must be",
        ),
    )


def records() -> tuple[BadInput, ...]:
    """Records that are damaged, each met by `check`."""
    return (
        _checked("no index", lambda r: (r / "index.json").unlink(), "MissingIndexError", "give the directory"),
        _checked("an index cut in half", lambda r: cut(r / "index.json"), _CORRUPT, "write it again"),
        _checked("an empty index", lambda r: emptied(r / "index.json"), _CORRUPT, "write it again"),
        _checked("an index that cannot be read", _unreadable, "RecordsError", "copy it again"),
        _checked(
            "an index of another version",
            lambda r: replaced(r / "index.json", '"version":2', '"version":9'),
            "RecordsVersionError",
            "write the records again",
        ),
        _checked("a missing shard", lambda r: _shard(r).unlink(), _CORRUPT, "copy it again", "is missing"),
        _checked("a shard cut in half", lambda r: cut(_shard(r)), _CORRUPT, "copy it again", "bytes where"),
        _checked("an empty shard", lambda r: emptied(_shard(r)), _CORRUPT, "copy it again", "has 0 bytes"),
        _checked("a flipped byte in a shard", lambda r: flipped(_shard(r)), _CORRUPT, "copy the file again"),
        _checked("a flipped byte in the objects", lambda r: flipped(_shard(r, "objects")), _CORRUPT, "copy"),
        BadInput(
            kind="records",
            name="records whose writing has not ended",
            program="sensors_io",
            arguments=lambda folder: ["check", folder / "records"],
            prepare=lambda folder: write_records(folder, complete=False),
            error="IncompleteRecordsError",
            where="records",
            fix="run its command again",
        ),
        BadInput(
            kind="records",
            name="records of another making in the way",
            program="sensors_io",
            arguments=lambda folder: ["generate", "--out", folder / "records"],
            prepare=write_records,
            error="RecordsExistError",
            where="made by config 'made up'",
            fix="choose another directory",
        ),
        BadInput(
            kind="records",
            name="a file where records should go",
            program="sensors_io",
            arguments=lambda folder: ["generate", "--out", folder / "taken"],
            prepare=_text("taken", "something else"),
            error="RecordsExistError",
            where="taken",
            fix="choose another path",
        ),
    )


def recordings() -> tuple[BadInput, ...]:
    """Pictures and folders that are not what a command needs."""
    rest = lambda folder: ["--background", folder / "rest.png", "--out", folder / "out.npz", "--mm-per-px", "0.06"]
    return (
        _extract(
            "a picture that there is not", lambda folder: [folder / "no.png", *rest(folder)], "no.png", "replace it"
        ),
        _extract("a picture that is none", lambda folder: [folder / "none.png", *rest(folder)], "none.png", "picture"),
        _extract("sizes that differ", lambda folder: [folder / "press.png", *rest(folder)], "(120, 160)", "crop them"),
        BadInput(
            kind="recordings",
            name="a folder to import that there is not",
            program="sensors_io",
            arguments=lambda folder: ["import", "tac3d", folder / "nowhere", "--out", folder / "new"],
            error="ImportSourceError",
            where="nowhere",
            fix="give",
        ),
        BadInput(
            kind="recordings",
            name="a folder to import that holds nothing",
            program="sensors_io",
            arguments=lambda folder: ["import", "tac3d", folder / "empty", "--out", folder / "new"],
            prepare=lambda folder: (folder / "empty").mkdir(),
            error="ImportSourceError",
            where="empty",
            fix="give",
        ),
    )


def answers() -> tuple[BadInput, ...]:
    """Files of questions and answers."""
    return (
        BadInput(
            kind="answers",
            name="a line that is no JSON",
            program="bench",
            arguments=lambda folder: ["score", folder / "questions.jsonl", folder / "answers.jsonl"],
            prepare=_text("questions.jsonl", '{"id": 1\n'),
            error="LinesError",
            where="line 1",
            fix="must be one JSON object",
        ),
    )


def run_files(unfinished: Path) -> tuple[BadInput, ...]:
    """Files of a run that is about to go on, its data, and its disk."""
    struck = functools.partial(_struck, unfinished)
    held = struck("run", "another process in the run", _nothing, ("RunInUse", "runs/counting", "--fresh"))
    full = struck("disk", "a disk that fills up", _nothing, ("UnwrittenError", "cannot be written", "free some space"))
    return (
        struck("run", "a damaged configuration", _run_file("config.json"), (_DAMAGED, "config.json", "move the run")),
        struck("run", "damaged wall times", _run_file("timing.json"), (_DAMAGED, "timing.json", "put a copy back")),
        struck("run", "a damaged line in the log", _spoiled_log, (_DAMAGED, "metrics.jsonl", "put a copy back")),
        dataclasses.replace(held, around=_held),
        struck("checkpoint", "every checkpoint cut", _every_state(cut), (_NO_CHECKPOINT, "damaged-*", "put copies")),
        struck(
            "checkpoint", "every checkpoint empty", _every_state(emptied), (_NO_CHECKPOINT, "[12, 8]", "put copies")
        ),
        struck("checkpoint", "a changed iterator", _changed_data, (_NO_CHECKPOINT, "its data does not hold", "copies")),
        struck("checkpoint", "other shapes", _other_shapes, ("CheckpointError", "holds another state", "go back to")),
        struck("checkpoint", "a file in their place", _file_for_folder, ("UnwrittenError", "count/0", "move away")),
        BadInput(
            kind="run",
            name="targets that are NaN from step 5 on",
            program="faults",
            arguments=lambda folder: ["counting", "--poison-from", "5", *counting_paths(folder)],
            error="NonFiniteGradientError",
            where="step 8",
            fix="lower the learning rate",
        ),
        dataclasses.replace(full, around=full_disk(FULL_BYTES)),
    )


_CORRUPT, _DAMAGED, _NO_CHECKPOINT = "CorruptRecordsError", "DamagedFileError", "DamagedCheckpointError"

Says = tuple[str, str, str]
"""Error, place and way out that a message must name."""


def _checked(name: str, spoil: Callable[[Path], None], error: str, fix: str, where: str = "records") -> BadInput:
    """Records that `check` meets after `spoil` had them."""

    def prepare(folder: Path) -> None:
        write_records(folder)
        spoil(folder / "records")

    check = lambda folder: ["check", folder / "records"]
    return BadInput(
        kind="records", name=name, program="sensors_io", arguments=check, prepare=prepare, error=error, where=where,
        fix=fix,
    )  # fmt: skip


def _text(name: str, text: str) -> Callable[[Path], None]:
    """Puts a file of that text into a folder."""

    def write(folder: Path) -> None:
        (folder / name).write_text(text, encoding="utf-8")

    return write


def _shard(records: Path, kind: str = "contacts") -> Path:
    return records / f"{kind}-00000.arrayrecord"


def _unreadable(records: Path) -> None:
    """A file that opens and whose bytes cannot be read, as on a failing disk (EIO); root may read all others."""
    (records / "index.json").unlink()
    (records / "index.json").symlink_to("/proc/self/mem")


def _extract(name: str, arguments: Callable[[Path], list[Path | str]], where: str, fix: str) -> BadInput:
    command = lambda folder: ["extract", *arguments(folder)]
    return BadInput(
        kind="recordings", name=name, program="sensors_io", arguments=command, prepare=write_pictures, error="Error",
        where=where, fix=fix,
    )  # fmt: skip


def _struck(unfinished: Path, kind: Kind, name: str, spoil: Callable[[Path], None], says: Says) -> BadInput:
    """A run of `counting` that goes on after `spoil` had its folder."""

    def prepare(folder: Path) -> None:
        shutil.copytree(unfinished, folder, dirs_exist_ok=True, symlinks=True)
        spoil(folder)

    error, where, fix = says
    command = lambda folder: ["counting", *counting_paths(folder)]
    return BadInput(
        kind=kind, name=name, program="faults", arguments=command, prepare=prepare, error=error, where=where, fix=fix
    )


def _nothing(folder: Path) -> None:
    """Spoils nothing; what is wrong lies around the command."""
    del folder


def _run_file(name: str) -> Callable[[Path], None]:
    return lambda folder: cut(run_directory(folder) / name)


def _spoiled_log(folder: Path) -> None:
    replaced(run_directory(folder) / "metrics.jsonl", '"step": 1,', '"step": 1;')


def _every_state(spoil: Callable[[Path], None]) -> Callable[[Path], None]:
    """Spoils what holds the arrays of every checkpoint."""

    def prepare(folder: Path) -> None:
        for checkpoint in newest_checkpoints(folder):
            for path in (checkpoint / "state" / "d").iterdir():
                spoil(path)

    return prepare


def _changed_data(folder: Path) -> None:
    for checkpoint in newest_checkpoints(folder):
        replaced(checkpoint / "data" / "metadata", '"next_index": ', '"next_index": 1')


def _other_shapes(folder: Path) -> None:
    """A newer checkpoint, of a state that has four numbers."""
    with Checkpoints(newest_checkpoints(folder)[0].parent) as checkpoints:
        checkpoints.save(13, {"params": jnp.zeros(4)}, None)


def _file_for_folder(folder: Path) -> None:
    stage = newest_checkpoints(folder)[0].parent
    shutil.rmtree(stage)
    stage.write_text("no folder", encoding="utf-8")


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[None]:
    with runs.locked(run_directory(folder)):
        yield
