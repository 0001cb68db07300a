"""Single bits flipped at random in the files of a run and of its cache: each is found where its file is read, or
changes nothing.

A file is read as a session reads it, by the function that does.  Then the run goes on: once with all flips that change
nothing, and once with each of some that were found.
"""

import dataclasses
import hashlib
import re
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.core.artifacts import DamagedFileError, read_json
from experiments.core.context import Context
from experiments.core.metric_log import MetricLog, read_metrics
from experiments.core.runs import read_description
from experiments.faults.damaged_files import SAME as SAME_END
from experiments.faults.damaged_files import Damage, end_of_run, telling_line
from experiments.faults.fixtures import flip_bit
from experiments.faults.kills import PRINTED, KillableTraining, Session
from experiments.study.answers import load_answers
from experiments.study.cache import read_policy
from sensors_io.errors import UserError
from sensors_io.records import RecordStore
from touchr1_jax.models import saved_policy
from touchr1_jax.models.load import WeightsError
from touchr1_jax.training.checkpoint import CheckpointError, DamagedCheckpointError
from touchr1_jax.training.checksums import changed_files

FOUND, SAME, WRONG, RAW, UNREAD = "found", "read the same", "WRONG", "RAW ERROR", "never read back"
READINGS = (FOUND, SAME, UNREAD, WRONG, RAW)
"""What reading a file with a flipped bit may give: an error that names it, what was written, other content, an error
that nobody handles; or nothing ever reads the file."""

NAMED = (DamagedFileError, CheckpointError, UserError, WeightsError)
"""Errors that a session answers by an older checkpoint, by doing the work again, or by their message."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Flip:
    """One flipped bit: the kind of its file, its path and place, and what reading gave."""

    file: str
    path: str
    bit: int
    reading: str


def flip_bits(root: Path, scratch: Path, context: Context, count: int, seed: int = 0) -> Iterator[Flip]:
    """Flip one bit at a time in a copy of a folder: a random bit of a random file of a random kind."""
    copy = shutil.copytree(root, scratch / "flipped", symlinks=True)
    kinds: dict[str, list[Path]] = {}
    whole: dict[Path, str] = {}
    for path in sorted(copy.rglob("*")):
        if path.is_file() and not path.is_symlink() and path.stat().st_size and path.name != PRINTED:
            kinds.setdefault(kind(path.relative_to(copy)), []).append(path)
    rng, names = np.random.default_rng(seed), sorted(kinds)
    for _ in context.each("flipping bits", range(count), still=True):
        name = names[rng.integers(len(names))]
        path = kinds[name][rng.integers(len(kinds[name]))]
        content = path.read_bytes()
        bit = int(rng.integers(8 * len(content)))
        yield Flip(file=name, path=str(path.relative_to(copy)), bit=bit, reading=_reading(path, content, bit, whole))
    shutil.rmtree(copy)


def go_on_flipped(
    unfinished: Path,
    flips: Sequence[Flip],
    wanted: Mapping[str, str],
    training: KillableTraining,
    programs: Path,
    scratch: Path,
    context: Context,
    most: int,
) -> Iterator[Damage]:
    """Ends of copies of a run that go on with flipped bits: all that change nothing at once, and some found ones alone.

    `wanted` are digests of an undisturbed run; `most` found flips are tried, of as many kinds of file as there are.
    """
    together = [one for one in flips if one.reading in (SAME, UNREAD)]
    found = [one for one in flips if one.reading == FOUND]
    first = {one.file: one for one in reversed(found)}
    alone = [*first.values(), *(one for one in found if first[one.file] is not one)][:most]
    tries = [(f"{len(together)} files that change nothing", together), *((one.file, [one]) for one in alone)]
    for i, (name, group) in context.each("going on with flipped bits", enumerate(tries)):
        home = shutil.copytree(unfinished, scratch / f"flipped-{i}", symlinks=True)
        for one in group:
            flip_bit(home / one.path, one.bit)
        for path in (home / PRINTED, *home.rglob("results.json")):
            path.unlink(missing_ok=True)
        damaged = {home / one.path: (home / one.path).read_bytes() for one in group}
        code, output = Session(training, home, home / "cache", programs).end()
        left = {path for path, content in damaged.items() if path.exists() and path.read_bytes() == content}
        for one in group:  # a checkpoint of a stage that is done is not looked into, and would be refused if it were
            if home / one.path in left:
                flip_bit(home / one.path, one.bit)
        outcome = end_of_run(home / training.name, code, output, wanted)
        if group is together and outcome != SAME_END:
            outcome = WRONG  # even a named error: reading said that these bits change nothing
        yield Damage(file=name, damage="a random bit flipped", outcome=outcome, message=telling_line(output, scratch))
        shutil.rmtree(home)


def _reading(path: Path, content: bytes, bit: int, whole: dict[Path, str]) -> str:
    """Read a file with a flipped bit, which is then taken back; `whole` are the readings of undamaged files."""
    read = next((read for pattern, read in READERS if re.search(pattern, path.as_posix())), None)
    if read is None:
        return UNREAD
    before = whole[path] if path in whole else whole.setdefault(path, read(path))
    flip_bit(path, bit)
    try:
        return SAME if read(path) == before else WRONG
    except NAMED:
        return FOUND
    except Exception:  # counted as what it is: nothing handles it
        return RAW
    finally:
        path.write_bytes(content)


def kind(path: Path) -> str:
    """A path without the names that differ from run to run."""
    return re.sub(r"(?<=/compiled/).*(?=-)|\d{8}-\d{6}|[0-9a-f]{16,}|(?<=[-/])\d+(?=[/.\-])", "…", path.as_posix())


def digest(tree: Any) -> str:
    """SHA-256 of arrays and JSON values."""
    sum_ = hashlib.sha256()
    for path, leaf in jax.tree.leaves_with_path(tree):
        sum_.update(jax.tree_util.keystr(path).encode())
        sum_.update(leaf.tobytes() if isinstance(leaf, np.ndarray | jax.Array) else repr(leaf).encode())
    return sum_.hexdigest()


def _checkpoint(path: Path) -> str:
    """The file itself, if the checkpoint that it belongs to counts as whole."""
    (folder,) = (parent for parent in path.parents if parent.name.isdigit() and (parent / "data").is_dir())
    changed = changed_files(folder)
    if changed:
        raise DamagedCheckpointError(f"{folder}: {changed}")
    return digest(path.read_bytes())


def _log(path: Path) -> str:
    MetricLog(path).close()  # as a session that continues the run
    return digest(read_metrics(path.parent))


def _answers(path: Path) -> str:
    answers = load_answers(path)
    return digest(
        {f.name: getattr(answers, f.name) for f in dataclasses.fields(answers)} | {"parsed": vars(answers.parsed)}
    )


def _records(path: Path) -> str:
    store = RecordStore(path.parent)
    contacts = [{name: vars(s) for name, s in store.contact(i).items()} for i in range(len(store))]
    cards = {name: vars(card) for name, card in store.objects.items()}
    return digest([dataclasses.asdict(store.meta), store.complete, cards, contacts])


def _saved_policy(path: Path) -> str:
    saved = saved_policy.read_policy(path.parent)
    return digest([saved.params, dict(saved.notes), repr(saved.reads), repr(saved.policy.language)])


def _program(path: Path) -> str:
    try:
        return digest(zlib.decompress(path.read_bytes()))
    except zlib.error as error:  # JAX then warns, and compiles again
        raise DamagedFileError(str(error)) from error


READERS: tuple[tuple[str, Callable[[Path], str]], ...] = (
    (r"\.orbax-checkpoint-tmp/", lambda path: ""),  # a save that was cut off: no session looks into it
    (
        r"/checkpoints/.*/\d+/(_CHECKPOINT_METADATA|commit_success\.txt)$",
        lambda path: "",
    ),  # times, and a mark that is only looked for
    (r"/checkpoints/.*/\d+/", _checkpoint),
    (r"/metrics\.jsonl$", _log),
    (r"/answers/[^/]*\.npz$", _answers),
    (r"/(sft|grpo)/[^/]*\.npz$", lambda path: digest(read_policy(path))),
    (r"/scenes-[^/]*/(index\.[^/]*|[^/]*\.arrayrecord)$", _records),
    (r"/policies/.*\.(json|safetensors)$", _saved_policy),
    (r"/config\.json$", lambda path: digest(read_description(path.parent))),
    (r"\.json$", lambda path: digest(read_json(path))),
    (r"-cache$", _program),
)
"""Pattern of a path and what reads it; the first that fits counts."""
