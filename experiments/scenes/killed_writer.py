"""A generation that is killed at random moments and resumed, compared with one that was not interrupted."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from sensors_io.records import CorruptRecordsError, RecordStore
from sensors_io.scenes.config import require
from sensors_io.schema import Sequence

_POLL_S = 0.05  # a shard takes seconds
_SIGKILL = -int(signal.SIGKILL)  # return code of a process that it ended


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResumedSet:
    """A set that was written with interruptions, compared with one that was not.

    `records` that can be read; contacts that are missing, repeated, or damaged by their checksums; readable contacts
    that differ in a bit or in their place.
    """

    records: int
    missing: int
    repeated: int
    damaged: int
    differing: int


def killed_and_resumed(
    arguments: list[str],
    out: Path,
    *,
    kills: int,
    shards: int,
    shard_s: float,
    seed: int,
    advance: Callable[[], None] = lambda: None,
) -> int:
    """Run `python -m sensors_io generate`, kill it with SIGKILL at random moments, let the last run finish.

    A moment is a random shard, another each time, and a random part of the time in which it is written; the first shard
    takes in the start of the process and its compiling.

    Args:
      arguments: of the command, without `--out`.
      out: directory of the records.
      kills: number of kills, < `shards`.
      shards: that the finished set has.
      shard_s: seconds that an undisturbed writer takes for one.
      seed: of the moments.
      advance: called after each kill, and after the last run.

    Returns:
      Number of runs that were killed before they ended.

    Raises:
      ValueError: as many kills as shards, or more.
    """
    require(kills < shards, "kills", kills, f"must be < {shards}, the shards of the set, or more contacts be written")
    command = [sys.executable, "-m", "sensors_io", "generate", *arguments, "--out", str(out)]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(out.parent / "compiled")}
    rng = np.random.default_rng(seed)
    killed = 0
    for shard in np.sort(rng.choice(shards - 1, kills, replace=False)):
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            while process.poll() is None and len(list(out.glob("contacts-*"))) < shard:
                time.sleep(_POLL_S)
            time.sleep(rng.uniform(0, shard_s))
        finally:
            process.kill()
            killed += process.wait() == _SIGKILL
        advance()
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    advance()
    return killed


def compare(whole: Path, killed: Path, advance: Callable[[], None] = lambda: None) -> ResumedSet:
    """Read every entry of both sets; `advance` is called before each."""
    left, right = RecordStore(whole), RecordStore(killed)
    records = damaged = differing = 0
    for i, key in enumerate(right.contacts):
        advance()
        try:
            contact = right.contact(i)
        except CorruptRecordsError:
            damaged += 1
            continue
        records += sum(len(sequence) for sequence in contact.values())
        differing += i >= len(left) or key != left.contacts[i] or not _same(contact, left.contact(i))
    return ResumedSet(
        records=records,
        missing=len(set(left.contacts) - set(right.contacts)),
        repeated=len(right) - len(set(right.contacts)),
        damaged=damaged,
        differing=differing,
    )


def _same(a: Mapping[str, Sequence], b: Mapping[str, Sequence]) -> bool:
    if a.keys() != b.keys():
        return False
    pairs = ((vars(a[name]), vars(b[name])) for name in a)
    return all(np.array_equal(x[field], y[field]) for x, y in pairs for field in x)
