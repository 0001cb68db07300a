"""Figures in the documentation that come from recorded runs.

    python -m experiments.core.recorded record RUN        # keep a finished run's results in the repository
    python -m experiments.core.recorded fill              # write every marked figure anew

A marked figure stands between two comments, `<!--= NAME :: KEY :: … :: FORMAT -->63<!--/-->`: the path of a value in
`experiments/recorded/NAME.json`, and the format of its number; a bar would end the cell of a table.  A key names an
entry of an object; of a list, the entry with that `name` or `title`; of a table, the row that begins with it, then the
column.  A test holds the documents to what `fill` would write.
"""

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.core.artifacts import read_json, write_json, write_text
from experiments.core.runs import ROOT, NoCheckoutError, checkout

RECORDED = Path("experiments/recorded")
"""Relative to the checkout; one file for each experiment, the run that the documents speak of."""

DOCUMENTS = tuple(Path(x) / "README.md" for x in (".", "touchr1_jax", "sensors_io", "experiments"))

_ABSOLUTE = re.compile(r"(?:/[\w.+ -]+){2,}/?|[A-Za-z]:\\\S+")
_MARK = re.compile(r"<!--= (?P<path>[^>]*?) -->(?P<shown>[^<]*)<!--/-->")


class FigureError(ValueError):
    """A marked figure that no recorded run gives; the message names the mark, the key and what there is."""


def record(run: Path, root: Path = ROOT) -> Path:
    """Keep the results of a finished run, in the place of an earlier one of the same experiment.

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
    """The same with the last part alone of every absolute path: where a folder lay is of no use to others."""
    if isinstance(value, Mapping):
        return {key: _placeless(x) for key, x in value.items()}
    if isinstance(value, list):
        return [_placeless(x) for x in value]
    return Path(value).name if isinstance(value, str) and _ABSOLUTE.fullmatch(value) else value


def filled(text: str, root: Path = ROOT) -> str:
    """A document with every marked figure as the recorded runs have it.

    Args:
      text: the document.
      root: the checkout.

    Raises:
      FigureError: a mark whose run, key or format is unknown.
    """

    def write(mark: re.Match[str]) -> str:
        path = mark["path"]
        return f"<!--= {path} -->{shown(path, root)}<!--/-->"

    return _MARK.sub(write, text)


def shown(path: str, root: Path = ROOT) -> str:
    """A figure as its mark asks for it: "conflict :: requirements :: least gain from touch :: measured :: .0f".

    Raises:
      FigureError: an unknown run or key, or something that has no such format.
    """
    name, *keys = [part.strip() for part in path.split("::")]
    file = root / RECORDED / f"{name}.json"
    if len(keys) < 2:
        raise FigureError(f"mark {path!r} has {len(keys)} parts after the run: must have a key and a format; add them")
    if not file.exists():
        raise FigureError(f"mark {path!r}: no run of {name!r} is recorded in {RECORDED}; record one")
    value: Any = read_json(file)
    for key in keys[:-1]:
        value = _entry(value, key, path)
    try:
        return format(value, keys[-1]).replace("-", "−")
    except (TypeError, ValueError) as error:
        raise FigureError(f"mark {path!r}: {value!r} has no format {keys[-1]!r}: {error}; correct either") from error


def _entry(value: Any, key: str, path: str) -> Any:
    """What a key names in a value."""
    if isinstance(value, Mapping) and "rows" in value and "columns" in value:
        columns = [column["name"] for column in value["columns"]]
        value = {str(row[0]): dict(zip(columns, row, strict=True)) for row in value["rows"]}
    if isinstance(value, list):
        value = {str(entry.get("name", entry.get("title"))): entry for entry in value if isinstance(entry, Mapping)}
    if not isinstance(value, Mapping) or key not in value:
        known = ", ".join(map(str, value)) if isinstance(value, Mapping) else repr(value)
        raise FigureError(f"mark {path!r}: {key!r} must be one of {known}; correct it")
    return value[key]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("record", help="keep a finished run's results").add_argument("run", type=Path)
    commands.add_parser("fill", help="write every marked figure anew")
    chosen = parser.parse_args(arguments)
    try:
        root = checkout()
        if chosen.command == "record":
            record(chosen.run, root)
        else:
            for document in DOCUMENTS:
                text = (root / document).read_text(encoding="utf-8")
                write_text(root / document, filled(text, root))
    except (FigureError, NoCheckoutError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
