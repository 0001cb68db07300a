"""That the weights of a run are those that it began with."""

import zlib
from pathlib import Path

from experiments.core.context import Context
from touchr1_jax.models.load import WeightsError


def require_same(source: Path, context: Context) -> None:
    """Hold the weights of a run that goes on to those that it began with, by the marks of their files (see `mark`).

    Raises:
      WeightsError: they are others.
    """
    marks = {path.name: mark(path) for path in sorted(source.iterdir()) if path.is_file()}
    if not context.done("weights"):
        context.save_stage("weights", marks)
    began = context.load_stage("weights")
    changed = sorted(name for name in {*began, *marks} if began.get(name) != marks.get(name))
    if changed:
        raise WeightsError(
            f"{source} is not what this run began with: {', '.join(changed)} changed; put it back, or say --fresh"
        )


def mark(path: Path) -> list[int]:
    """Size of a file and the CRC-32 of its first and of its last mebibyte: shards of gigabytes are not read twice."""
    size, ends = path.stat().st_size, []
    with path.open("rb") as file:
        for start in (0, max(0, size - 2**20)):
            file.seek(start)
            ends.append(zlib.crc32(file.read(2**20)))
    return [size, *ends]
