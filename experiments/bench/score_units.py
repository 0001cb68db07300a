"""Scores of files of answers as units of work, each kept under the hash of what it is made of."""

import functools
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.core.artifacts import make_folder, write_sealed
from experiments.study.cache import source_digest
from sensors_io.units import WorkUnit
from touchr1_jax.bench.items import read_items
from touchr1_jax.bench.json_lines import read_lines
from touchr1_jax.bench.questions.answers import average_line, metric_rows, parsed_share, read_answers

SCORES = "scores"  # folder of the cache that holds them


def score_units(
    items: Path, answers: Sequence[Path], by_sight: Path | None, cache_dir: Path
) -> dict[Path, tuple[WorkUnit, Path]]:
    """File of answers → the unit that scores it, and where its scores are when it is done."""
    asked, listed = read_items(items), {}
    for path in (*answers, *([by_sight] if by_sight else [])):
        read_answers(read_lines(path), asked, str(path))
    make_folder(cache_dir / SCORES, "cache-dir", cache_dir)
    for path in dict.fromkeys(answers):
        sum_ = hashlib.sha256(source_digest(()).encode())
        for one in (items, path, *((by_sight,) if by_sight else ())):
            sum_.update(hashlib.sha256(one.read_bytes()).digest())
        out = cache_dir.absolute() / SCORES / f"{sum_.hexdigest()[:16]}.json"
        run = functools.partial(_score, items, path, by_sight, out)
        listed[path] = WorkUnit(name=f"{path} {out.stem}", run=run, done=out.exists), out
    return listed


def _score(items_file: Path, answers_file: Path, by_sight_file: Path | None, out: Path) -> None:
    items = read_items(items_file)
    read = lambda path: read_answers(read_lines(path), items, str(path))
    answers = read(answers_file)
    rows: dict[str, Any] = {
        row.name: {"mean": row.interval.mean, "low": row.interval.low, "high": row.interval.high, "values": row.values}
        for row in metric_rows(items, answers, None if by_sight_file is None else read(by_sight_file))
    }
    summary = f"parsed {100 * parsed_share(answers):.1f} %; {average_line(items, answers)}"
    write_sealed(out, {"of": out.stem, "rows": rows, "said": summary})
