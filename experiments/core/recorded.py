"""The table of results in the README, written from runs that are kept in the repository.

    python -m experiments.core.recorded record RUN        # keep the results of a finished run
    python -m experiments.core.recorded fill              # write the table again

A figure of a row is `{KEY > KEY > … | FORMAT}`: the path of a value in `experiments/recorded/EXPERIMENT.json` and the
format of its number.  A key names an entry of an object; of a list, the entry with that `name` or `title`; of a table,
the row that begins with it, then the column.  A test compares the README with what `fill` would write.
"""

import argparse
import functools
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.core.artifacts import read_json, write_json, write_text
from experiments.core.runs import ROOT, NoCheckoutError, checkout
from experiments.core.text import number

RECORDED = Path("experiments/recorded")
"""Folder of the checkout with one file for each experiment: the run that the README shows."""

BEGIN, END = "<!-- results: `python -m experiments.core.recorded fill` writes this table -->", "<!-- /results -->"

SIGHT = "tables > Accuracy where the picture helps and where it deceives > deceptive questions"

ROWS = (
    (
        "conflict",
        "hardness, roughness and protrusion on three levels each",
        "right: SFT {arms > sft > acc > mean | .0f} %, GRPO with the published rewards "
        "{arms > full > acc > mean | .0f} %, the same policy without touch "
        "{baselines > tactile_blind > acc > mean | .0f} %, a constant {baselines > constant > acc > mean | .0f} %",
    ),
    (
        "conflict",
        "questions where the picture shows the wrong material",
        f"right: with touch {{{SIGHT} > full model | .0f}} %, without {{{SIGHT} > vision-only | .0f}} %",
    ),
    (
        "main_table",
        "average of the bench's nine columns",
        "SFT {arms > sft > avg > mean | .1f}, SFT and GRPO {arms > full > avg > mean | .1f}, a linear probe on the "
        "encoder of SFT {baselines > encoder_probe > avg > mean | .1f}",
    ),
    (
        "physiclear",
        "real videos of 67 objects, cross-validated",
        "{requirements > all right > measured | .0f} % right in all three properties, "
        "{requirements > mean > measured | .0f} % of the levels right",
    ),
    (
        "pareto_fields",
        "depth under real balls that calibration never saw",
        "error of {requirements > ball, gelslam, held out by press: depth rmse > measured | .1f} µm (RMSE)",
    ),
    (
        "speed_grpo",
        "one iteration of GRPO, 8 × 8 answers of 64 tokens",
        "{requirements > iteration at prefix 64 > measured | .2f} s with a prefix of 64 tokens, "
        "{requirements > iteration at prefix 512 > measured | .2f} s with 512",
    ),
    (
        "stability_grpo",
        "known failures of GRPO, each provoked, over ten seeds",
        "an alarm fires in {requirements > failed runs whose alarm fired > measured | .0%} of the failed runs",
    ),
)
"""Experiment, subject and figures of every row."""

_ABSOLUTE = re.compile(r"(?:/[\w.+ -]+){2,}/?|[A-Za-z]:\\\S+")
_FIGURE = re.compile(r"\{(?P<path>[^{}|]+)\|(?P<format>[^{}|]+)\}")


class FigureError(ValueError):
    """A figure that no recorded run gives; the message names the figure, the key and the choices."""


def record(run: Path, root: Path = ROOT) -> Path:
    """Keep the results of a finished run; they replace those of an earlier run of the experiment.

    Args:
      run: its directory.
      root: the checkout.

    Raises:
      FigureError: the run is not finished.
    """
    if not (run / "results.json").exists():
        raise FigureError(f"run is {run}: holds no results.json; finish it first")
    results = read_json(run / "results.json")
    path = root / RECORDED / f"{results['experiment']}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, _placeless(results))
    return path


def _placeless(value: Any) -> Any:
    """The same value with absolute paths reduced to their last part, which alone means something elsewhere."""
    if isinstance(value, Mapping):
        return {key: _placeless(x) for key, x in value.items()}
    if isinstance(value, list):
        return [_placeless(x) for x in value]
    return Path(value).name if isinstance(value, str) and _ABSOLUTE.fullmatch(value) else value


def filled(text: str, rows: Sequence[tuple[str, str, str]] = ROWS, root: Path = ROOT) -> str:
    """A document with the table between `BEGIN` and `END` as the recorded runs have it.

    Args:
      text: the document.
      rows: experiment, subject, figures.
      root: the checkout.

    Raises:
      FigureError: no such block, or a figure whose run, key or format is unknown.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise FigureError(f"the document holds no block between {BEGIN!r} and {END!r}: must hold one; add it")
    lines = ["| subject | measured | experiment |", "|---|---|---|"]
    for name, subject, figures in rows:
        show = functools.partial(_show, name=name, root=root)
        lines.append(f"| {subject} | {_FIGURE.sub(show, figures)} | `{name}` |")
    return before + "\n".join((BEGIN, *lines, END)) + after


def _show(match: re.Match[str], *, name: str, root: Path) -> str:
    return figure(name, match["path"], match["format"].strip(), root)


def figure(name: str, path: str, spec: str, root: Path = ROOT) -> str:
    """A figure of a recorded run, such as `requirements > least gain from touch > measured` with format `.0f`.

    Raises:
      FigureError: an unknown run or key, or a value that has no such format.
    """
    file = root / RECORDED / f"{name}.json"
    if not file.exists():
        raise FigureError(f"figure {path!r}: no run of {name!r} is recorded in {RECORDED}; record one")
    value: Any = read_json(file)
    for key in path.split(">"):
        value = _entry(value, key.strip(), path)
    try:
        return number(value, spec)
    except (TypeError, ValueError) as error:
        raise FigureError(f"figure {path!r}: {value!r} has no format {spec!r}: {error}; correct either") from error


def _entry(value: Any, key: str, path: str) -> Any:
    """The entry of a value that a key names."""
    if isinstance(value, Mapping) and "rows" in value and "columns" in value:
        columns = [column["name"] for column in value["columns"]]
        value = {str(row[0]): dict(zip(columns, row, strict=True)) for row in value["rows"]}
    if isinstance(value, list):
        value = {str(entry.get("name", entry.get("title"))): entry for entry in value if isinstance(entry, Mapping)}
    if not isinstance(value, Mapping) or key not in value:
        known = ", ".join(map(str, value)) if isinstance(value, Mapping) else repr(value)
        raise FigureError(f"figure {path!r}: {key!r} must be one of {known}; correct it")
    return value[key]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("record", help="keep a finished run's results").add_argument("run", type=Path)
    commands.add_parser("fill", help="write the table of the README again")
    chosen = parser.parse_args(arguments)
    try:
        readme = checkout() / "README.md"
        if chosen.command == "record":
            record(chosen.run)
        else:
            write_text(readme, filled(readme.read_text(encoding="utf-8")))
    except (FigureError, NoCheckoutError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
