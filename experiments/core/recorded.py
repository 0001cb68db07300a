"""The table of results in the README, written from runs that are kept in the repository.

    python -m experiments.core.recorded record RUN        # keep the results of a finished run
    python -m experiments.core.recorded fill              # write the table again

`experiments/recorded/table.md` holds the rows.  A figure of a row is `{KEY > KEY > … | FORMAT}`: the path of a value in
`experiments/recorded/EXPERIMENT.json` and the format of its number.  A key names an entry of an object; of a list, the
entry with that `name` or `title`; of a table, the row that begins with it, then the column; `NEW or OLD` is the first
that exists, for names that changed.  A test compares the README with what `fill` would write.
"""

import argparse
import ast
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.core.artifacts import DamagedFileError, fitting, make_folder, read_json, write_json, write_text
from experiments.core.report import write_report
from experiments.core.results import from_json
from experiments.core.runs import ROOT, PastRun, read_description, read_results
from experiments.core.text import MEANINGLESS, SMOKE, number

RECORDED = Path("experiments/recorded")  # folder of the checkout with the run of each experiment that the README shows

RECORDED_RUN = "recorded"  # name of a recorded run in place of a stamp, and so of the folder that `show` writes

BEGIN, END = "<!-- results: `python -m experiments.core.recorded fill` writes this table -->", "<!-- /results -->"

TABLE = "table.md"  # file in it with the rows: subject, figures, experiment

_ABSOLUTE = re.compile(r"(?:/[\w.+ -]+){2,}/?|[A-Za-z]:\\\S+")
_FIGURE = re.compile(r"\{([^{}|]+)\|([^{}|]+)\}")
_EXPERIMENT = re.compile(r"`(\w+)` \|$")


class FigureError(ValueError):
    """A figure that no recorded run gives; the message names the figure, the key and the choices."""


def record(run: Path, root: Path = ROOT) -> Path:
    """Keep the results of a finished run in place of those of an earlier one.

    Raises:
      FigureError: it is not finished, or of scale `smoke`.
      DamagedFileError: its results are damaged, or those of another run.
    """
    if not (run / "results.json").exists():
        raise FigureError(f"run is {run}: holds no results.json; finish it first")
    description = read_description(run)
    results = read_results(run / "results.json", description)
    if description["scale"] == SMOKE:
        raise FigureError(f"run is {run}: {MEANINGLESS}; record one of another scale")
    path = root / RECORDED / f"{description['experiment']}.json"
    write_json(path, _placeless(results))
    return path


def _placeless(value: Any) -> Any:
    """The same value with absolute paths reduced to their last part, which alone means something elsewhere."""
    if isinstance(value, Mapping):
        return {key: _placeless(x) for key, x in value.items()}
    if isinstance(value, list):
        return [_placeless(x) for x in value]
    return Path(value).name if isinstance(value, str) and _ABSOLUTE.fullmatch(value) else value


def show_recorded(name: str, module: str, runs_dir: Path) -> tuple[str, ...]:
    """Write the recorded results of an experiment as its report; the lines to print, `FigureError` without any."""
    past = recorded_run(name, runs_dir)
    make_folder(past.directory, "runs-dir", runs_dir)
    source = ROOT / Path(*module.split(".")).with_suffix(".py")
    about = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or name
    note = f"Recorded are figures alone; curves, pictures and examples come with a run: make experiment EXP={name}."
    with fitting(RECORDED / f"{name}.json"):
        results = from_json(past.results or {})
        report = write_report(past.directory, results, about=about, description=past.description, note=note)
        return (f"report: {report}", *results.verdict)


def recorded_names(root: Path = ROOT) -> list[str]:
    """The experiments of which a checkout holds recorded results."""
    return sorted(path.stem for path in (root / RECORDED).glob("*.json"))


def recorded_run(name: str, runs_dir: Path, root: Path = ROOT) -> PastRun:
    """The recorded results of an experiment as a run in RUNS/NAME/recorded, `FigureError` without any.

    Only `show_recorded` makes that folder, with a page and the charts that the results hold.
    """
    found = _read(name, root)
    with fitting(RECORDED / f"{name}.json"):
        commit, _, dirty = found["git"].partition("-")
        git = {"commit": commit, "dirty": bool(dirty)}
        description = {"experiment": name, "scale": found["scale"], "git": git, "config": found["config"]}
    directory = runs_dir / name / RECORDED_RUN
    return PastRun(directory=directory, description=description, seconds=None, results=found, in_use=False)


def _read(name: str, root: Path) -> Mapping[str, Any]:
    file = root / RECORDED / f"{name}.json"
    if not file.exists():
        known = ", ".join(recorded_names(root))
        raise FigureError(
            f"name is {name!r}: no run of it is recorded in {RECORDED}; choose from {known}, or record one"
        )
    return read_json(file)


def filled(text: str, root: Path = ROOT) -> str:
    """A document with the table between `BEGIN` and `END` by the recorded runs; `FigureError` names what is unknown."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise FigureError(f"the document holds no block between {BEGIN!r} and {END!r}: must hold one; add it")
    lines = ["| subject | measured | experiment |", "|---|---|---|"]
    for row in (root / RECORDED / TABLE).read_text(encoding="utf-8").splitlines():
        (name,) = _EXPERIMENT.findall(row)
        figures = [figure(name, path, spec.strip(), root) for path, spec in _FIGURE.findall(row)]
        lines.append(_FIGURE.sub("{}", row).format(*figures))
    return before + "\n".join((BEGIN, *lines, END)) + after


def figure(name: str, path: str, spec: str, root: Path = ROOT) -> str:
    """A figure of a recorded run, such as `requirements > least gain from touch > measured` with format `.0f`."""
    value = value_at(_read(name, root), path)
    try:
        return number(value, spec)
    except (TypeError, ValueError) as error:
        raise FigureError(f"figure {path!r}: {value!r} has no format {spec!r}: {error}; correct either") from error


def value_at(run: Mapping[str, Any], path: str) -> Any:
    """The value at a path in the results of a run; `FigureError` for an unknown key."""
    value: Any = run
    for key in map(str.strip, path.split(">")):
        entries = _entries(value)
        key = next((choice for choice in (key, *key.split(" or ")) if choice in entries), key)
        if key not in entries:
            known = ", ".join(map(str, entries)) or repr(value)
            raise FigureError(f"figure {path!r}: {key!r} must be one of {known}; correct it")
        value = entries[key]
    return value


def _entries(value: Any) -> Mapping[str, Any]:
    """The entries of an object, a list of named objects or a table by the keys that name them."""
    if isinstance(value, list):
        return {str(entry.get("name", entry.get("title"))): entry for entry in value if isinstance(entry, Mapping)}
    if not isinstance(value, Mapping):
        return {}
    if not {"rows", "columns"} <= value.keys():
        return value
    columns = [column["name"] for column in value["columns"]]
    return {str(row[0]): dict(zip(columns, row, strict=True)) for row in value["rows"]}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("record", help="keep a finished run's results").add_argument("run", type=Path)
    commands.add_parser("fill", help="write the table of the README again")
    chosen, readme = parser.parse_args(arguments), ROOT / "README.md"
    try:
        if not readme.exists():
            raise FigureError(f"{ROOT} holds no README.md: must be a checkout of the project; clone it and work there")
        if chosen.command == "record":
            record(chosen.run)
        else:
            write_text(readme, filled(readme.read_text(encoding="utf-8")))
    except (FigureError, DamagedFileError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
