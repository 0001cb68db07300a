"""Comparison of two runs: settings, code, machine, and every figure that differs."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np

from experiments.core.history import PastRun, summary
from experiments.core.runs import continuing
from experiments.core.text import ABSENT, aligned, bounds, duration, interval, number
from touchr1_jax.bench.statistics import student_interval

Verdict = Literal["0 lies outside", "differs", "only in A", "only in B", "may be chance", "same"]
"""With paired seeds: 0 lies outside the interval of the difference, or the difference may be chance; else `differs`."""

VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
"""The most important first."""

CHANCE = 0.05
"""Rate at which a 95 % interval of no difference excludes 0."""


class ComparisonError(ValueError):
    """Runs that cannot be compared; the message says why and what to do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparedFigure:
    """One figure of both runs.

    Attributes:
      where: arm and metric, requirement, or cell of a table.
      a, b: its value in either run, as shown.
      change: B − A, with its interval where seeds are paired.
      verdict: kind of the difference.
    """

    where: str
    a: str
    b: str
    change: str
    verdict: Verdict


def compare_runs(a: PastRun, b: PastRun, most: int) -> str:
    """Compare two runs as text: runs, differing settings, figures, cost.

    Args:
      a, b: finished runs.
      most: figures to show, the most important differences first; the others are counted.

    Raises:
      ComparisonError: the same run twice, an unfinished run, or two runs without a common figure.
    """
    if a.directory == b.directory:
        raise ComparisonError(f"RUN_A and RUN_B are both {a.directory}: must be two runs; name them by NAME/STAMP")
    for run in (a, b):
        if run.results is None:
            raise ComparisonError(
                f"{run.directory} is {run.state}: must be finished to be compared; "
                f"continue it with: {continuing(run.description['command'])}"
            )
    figures = list(compare_results(_results(a), _results(b)))
    if not any(f.verdict not in ("only in A", "only in B") for f in figures):
        raise ComparisonError(
            f"{a.directory} ({a.name}) and {b.directory} ({b.name}) have no figure in common; "
            "compare two runs of one experiment"
        )
    return "\n\n".join(
        [
            aligned([("A", a.name, summary(a)), ("B", b.name, summary(b))]),
            _block("Different settings", _differing(_settings(a), _settings(b))),
            _block("Different code or machine", _differing(_machine(a), _machine(b))),
            _figures_block(figures, most),
            f"Cost: A {_cost(a)}, B {_cost(b)}",
        ]
    )


def compare_results(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[ComparedFigure]:
    """Every figure of two `results.json`: arms and baselines, requirements, cells of tables."""
    yield from _paired(_scores(a), _scores(b), _compare_estimates)
    yield from _paired(_requirements(a), _requirements(b), _compare_numbers)
    yield from _paired(_cells(a), _cells(b), _compare_numbers)


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """The leaves of nested objects by dotted name; a list is a leaf."""
    if not isinstance(value, Mapping):
        return {name: value}
    return {key: leaf for k, item in value.items() for key, leaf in flat(item, f"{name}.{k}" if name else k).items()}


def _scores(results: Mapping[str, Any]) -> dict[str, Any]:
    rows = {**results.get("arms", {}), **results.get("baselines", {})}  # findings have neither
    return {f"{name} {metric}": value for name, row in rows.items() for metric, value in row.items()}


def _requirements(results: Mapping[str, Any]) -> dict[str, Any]:
    return {f"requirement: {r['name']}": r["measured"] for r in results.get("requirements", ())}


def _cells(results: Mapping[str, Any]) -> dict[str, Any]:
    """Cells by table, row and column; rows of one name are numbered."""
    found: dict[str, Any] = {}
    for table in results.get("tables", ()):
        seen: dict[str, int] = {}
        for row in table["rows"]:
            name = str(row[0])
            seen[name] = seen.get(name, 0) + 1
            label = name if seen[name] == 1 else f"{name} #{seen[name]}"
            for column, cell in zip(table["columns"][1:], row[1:], strict=True):
                found[f"{table['title']} | {label} | {column['name']}"] = cell
    return found


def _paired(a: Mapping[str, Any], b: Mapping[str, Any], compare: Any) -> Iterator[ComparedFigure]:
    for where in {**a, **b}:
        if where in a and where in b:
            yield compare(where, a[where], b[where])
        else:
            verdict: Verdict = "only in A" if where in a else "only in B"
            yield ComparedFigure(where=where, a=_text(a.get(where)), b=_text(b.get(where)), change="", verdict=verdict)


def _compare_estimates(where: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> ComparedFigure:
    """Seeds are paired by their number: seed s draws the same random numbers in both runs."""
    one, two = a["per_seed"], b["per_seed"]
    if one == two:
        return ComparedFigure(where=where, a=_text(a), b=_text(b), change="", verdict="same")
    if len(one) != len(two) or len(one) < 2:
        change = number(b["mean"] - a["mean"], "+.3g")
        return ComparedFigure(where=where, a=_text(a), b=_text(b), change=change, verdict="differs")
    found = student_interval(np.subtract(two, one))
    change = interval(found, "+.3g")
    verdict: Verdict = "0 lies outside" if found.excludes_zero else "may be chance"
    return ComparedFigure(where=where, a=_text(a), b=_text(b), change=change, verdict=verdict)


def _compare_numbers(where: str, a: Any, b: Any) -> ComparedFigure:
    if a == b:
        return ComparedFigure(where=where, a=_text(a), b=_text(b), change="", verdict="same")
    numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in (a, b))
    change = number(b - a, "+.3g") + (f" (× {number(b / a)})" if a else "") if numbers else ""
    return ComparedFigure(where=where, a=_text(a), b=_text(b), change=change, verdict="differs")


def _text(value: Any) -> str:
    if value is None:
        return ABSENT
    if isinstance(value, Mapping):
        low, high = value["ci95"]
        return f"{number(value['mean'], '.4g')} {bounds(low, high, '.4g')}"
    return number(value, ".4g") if isinstance(value, float) and math.isfinite(value) else str(value)


def _figures_block(figures: Sequence[ComparedFigure], most: int) -> str:
    """The number of figures of each verdict, and the figures that differ."""
    counts = {verdict: sum(f.verdict == verdict for f in figures) for verdict in VERDICTS}
    head = f"{len(figures)} figures; " + "; ".join(f"{verdict}: {count}" for verdict, count in counts.items() if count)
    paired = counts["0 lies outside"] + counts["may be chance"]
    if paired:
        head += f" (of {paired} intervals, chance alone excludes 0 from {paired * CHANCE:.1f})"
    differing = sorted((f for f in figures if f.verdict != "same"), key=lambda f: VERDICTS.index(f.verdict))
    if not differing:
        return head
    rows = [(f.where, f.a, f.b, f.change, f.verdict) for f in differing[:most]]
    left = f"\n… and {len(differing) - most} more; --most shows them" if len(differing) > most else ""
    return f"{head}\n{aligned([('figure', 'A', 'B', 'B − A', ''), *rows])}{left}"


def _block(title: str, rows: list[tuple[str, str, str]]) -> str:
    return f"{title}:\n{aligned([('', 'A', 'B'), *rows])}" if rows else f"{title}: nothing"


def _differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    return [
        (key, str(a.get(key, ABSENT)), str(b.get(key, ABSENT)))
        for key in {**a, **b}
        if key not in a or key not in b or a[key] != b[key]
    ]


def _settings(run: PastRun) -> dict[str, Any]:
    return {"scale": run.description["scale"], **flat(run.description["config"])}


def _machine(run: PastRun) -> dict[str, Any]:
    return {"code": run.code, **flat(run.description["versions"]), **flat(run.description["machine"])}


def _results(run: PastRun) -> Mapping[str, Any]:
    assert run.results is not None
    return run.results


def _cost(run: PastRun) -> str:
    return ABSENT if run.seconds is None else duration(run.seconds)
