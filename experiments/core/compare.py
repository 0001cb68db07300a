"""Comparison of two runs: settings, code, machine, and every figure that differs."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple, cast, get_args

import numpy as np

from experiments.core.runs import PastRun, continuing
from experiments.core.text import ABSENT, aligned, bounds, duration, interval, number
from touchr1_jax.bench.statistics import student_interval

Verdict = Literal["0 lies outside", "differs", "only in A", "only in B", "may be chance", "same"]
"""With paired seeds: 0 lies outside the interval of the difference, or the difference may be chance; else `differs`.

The most important is the first."""

CHANCE = 0.05
"""Rate at which a 95 % interval of no difference excludes 0."""


class ComparisonError(ValueError):
    """Runs that cannot be compared; the message names the reason and the fix."""


class ComparedFigure(NamedTuple):
    """One figure of both runs as it is shown; `change` is B − A, with its interval where seeds are paired."""

    where: str
    a: str
    b: str
    change: str
    verdict: Verdict


def compare_runs(a: PastRun, b: PastRun, most: int) -> str:
    """Compare two runs as text: runs, differing settings, at most `most` figures that differ, cost.

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
    figures = list(compare_results(a.results or {}, b.results or {}))
    if all(f.verdict in ("only in A", "only in B") for f in figures):
        raise ComparisonError(
            f"{a.directory} ({a.name}) and {b.directory} ({b.name}) have no figure in common; "
            "compare two runs of one experiment"
        )
    settings = ({"scale": r.description["scale"]} | r.description["config"] for r in (a, b))
    code = ({"code": r.code} | r.description["versions"] | r.description["machine"] for r in (a, b))
    cost = (ABSENT if run.seconds is None else duration(run.seconds) for run in (a, b))
    parts = [
        aligned([("A", a.name, a.summary), ("B", b.name, b.summary)]),
        _differences("Different settings", *settings),
        _differences("Different code or machine", *code),
        _figures_block(figures, most),
        "Cost: A {}, B {}".format(*cost),
    ]
    return "\n\n".join(parts)


def compare_results(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[ComparedFigure]:
    """Compare every figure of two `results.json`: arms and baselines, requirements, cells of tables."""
    one, two = _figures(a), _figures(b)
    for where in one | two:
        change, verdict = "", cast(Verdict, "only in A" if where in one else "only in B")
        if where in one and where in two:
            change, verdict = _compare(one[where], two[where])
        yield ComparedFigure(where, _shown(one.get(where)), _shown(two.get(where)), change, verdict)


def _figures(results: Mapping[str, Any]) -> dict[str, Any]:
    """Name → estimate, requirement or cell of a table; rows of one name are numbered."""
    arms = {**results.get("arms", {}), **results.get("baselines", {})}
    found = {f"{name} {metric}": value for name, row in arms.items() for metric, value in row.items()}
    found |= {f"requirement: {r['name']}": r["measured"] for r in results.get("requirements", ())}
    for table in results.get("tables", ()):
        seen: dict[str, int] = {}
        for name, *cells in table["rows"]:
            seen[str(name)] = again = seen.get(str(name), 0) + 1
            label = str(name) if again == 1 else f"{name} #{again}"
            for column, cell in zip(table["columns"][1:], cells, strict=True):
                found[f"{table['title']} | {label} | {column['name']}"] = cell
    return found


def _compare(a: Any, b: Any) -> tuple[str, Verdict]:
    """Change and verdict; seeds are paired by number, since seed s draws the same random numbers in both runs."""
    estimates = isinstance(a, Mapping) and isinstance(b, Mapping)
    one, two = (a["per_seed"], b["per_seed"]) if estimates else (a, b)
    if one == two:
        return "", "same"
    if estimates and len(one) == len(two) > 1:
        found = student_interval(np.subtract(two, one))
        return interval(found, "+.3g"), "0 lies outside" if found.excludes_zero else "may be chance"
    if estimates:
        return number(b["mean"] - a["mean"], "+.3g"), "differs"
    if not all(isinstance(x, int | float) and not isinstance(x, bool) for x in (a, b)):
        return "", "differs"
    return number(b - a, "+.3g") + (f" (× {number(b / a)})" if a else ""), "differs"


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        low, high = value["ci95"]
        return f"{number(value['mean'], '.4g')} {bounds(low, high, '.4g')}"
    if isinstance(value, float) and math.isfinite(value):
        return number(value, ".4g")
    return ABSENT if value is None else str(value)


def _figures_block(figures: list[ComparedFigure], most: int) -> str:
    """The number of figures of each verdict, and the figures that differ."""
    counts = {verdict: sum(f.verdict == verdict for f in figures) for verdict in get_args(Verdict)}
    head = f"{len(figures)} figures; " + "; ".join(f"{verdict}: {count}" for verdict, count in counts.items() if count)
    paired = counts["0 lies outside"] + counts["may be chance"]
    if paired:
        head += f" (of {paired} intervals, chance alone excludes 0 from {paired * CHANCE:.1f})"
    differing = sorted((f for f in figures if f.verdict != "same"), key=lambda f: list(counts).index(f.verdict))
    if not differing:
        return head
    left = f"\n… and {len(differing) - most} more; --most shows them" if len(differing) > most else ""
    return f"{head}\n{aligned([('figure', 'A', 'B', 'B − A', ''), *differing[:most]])}{left}"


def _differences(title: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> str:
    """The leaves of two nested mappings that are not equal."""
    one, two = (dict(_leaves(tree)) for tree in (a, b))
    rows = [
        (key, str(one.get(key, ABSENT)), str(two.get(key, ABSENT)))
        for key in one | two
        if key not in one or key not in two or one[key] != two[key]
    ]
    return f"{title}:\n{aligned([('', 'A', 'B'), *rows])}" if rows else f"{title}: nothing"


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of the leaves of nested objects; a list is a leaf."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
