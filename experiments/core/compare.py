"""Comparison of runs: settings, code, machine, and every figure that differs."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from string import ascii_uppercase
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from experiments.core.artifacts import fitting
from experiments.core.runs import PastRun, continuing
from experiments.core.text import ABSENT, aligned, bounds, duration, interval, number
from touchr1_jax.bench.statistics import student_interval

Verdict = Literal["significant", "differs", "not significant", "same"]
"""With paired seeds a difference is significant if its 95 % interval excludes 0; without them it `differs`.

The most important is the first."""

GRAVITY = get_args(Verdict)

ABSENT_IN = "only in"  # begins the verdict on a figure that some runs lack
CHANCE = 0.05  # rate at which a 95 % interval of no difference excludes 0


class ComparisonError(ValueError):
    """Runs that cannot be compared; the message names the reason and the fix."""


class ComparedFigure(NamedTuple):
    """One figure of all runs as it is shown.

    Of two runs `change` is B − A, with its interval where seeds are paired; of more, it names those that differ from A.
    `verdict` is the gravest `Verdict` over the others, or "only in" and the runs that have the figure.
    """

    where: str
    shown: tuple[str, ...]
    change: str
    verdict: str


def compare_runs(runs: Sequence[PastRun], most: int) -> str:
    """Compare runs as text: runs, other settings and data, at most `most` differing figures, shared ones first, cost.

    `ComparisonError` for fewer than two runs, one named twice, an unfinished one, or runs without a common figure.
    """
    if len(runs) < 2:
        raise ComparisonError(f"{len(runs)} run is named: must be at least two; name another")
    again = next((run for i, run in enumerate(runs) if run.directory in [r.directory for r in runs[:i]]), None)
    if again is not None:
        raise ComparisonError(f"{again.directory} is named twice: must be different runs; name them by NAME/STAMP")
    for run in runs:
        if run.results is None:
            raise ComparisonError(
                f"{run.directory} is {run.state}: must be finished to be compared; "
                f"continue it with: {continuing(run.description['command'])}"
            )
    names = (
        ascii_uppercase[: len(runs)] if len(runs) <= len(ascii_uppercase) else [str(i + 1) for i in range(len(runs))]
    )
    found = list(compare_results(*(run.results or {} for run in runs), names=names))
    if not any(ABSENT_IN not in f.verdict for f in found):
        raise ComparisonError(
            f"{' and '.join(f'{run.directory} ({run.name})' for run in runs)} have no figure in common; "
            "compare runs of one experiment"
        )
    settings = [{"scale": r.description["scale"]} | r.description["config"] for r in runs]
    source = lambda run: {"code": run.code, "source": run.description.get("source", ABSENT)}
    code = [source(r) | r.description.get("versions", {}) | r.description.get("machine", {}) for r in runs]
    cost = (
        f"{name} {ABSENT if run.seconds is None else duration(run.seconds)}"
        for name, run in zip(names, runs, strict=True)
    )
    with fitting("results.json"):
        data = _differences("Different data", names, [(run.results or {}).get("data", {}) for run in runs])
    parts = [
        aligned([(name, run.name, run.summary) for name, run in zip(names, runs, strict=True)]),
        _differences("Different settings", names, settings),
        data,
        _differences("Different code or machine", names, code),
        _figures_block(found, names, most),
        f"Cost: {', '.join(cost)}",
    ]
    return "\n\n".join(parts)


def compare_results(*results: Mapping[str, Any], names: Sequence[str] = ascii_uppercase) -> Iterator[ComparedFigure]:
    """Compare every figure of several `results.json`: arms and baselines, requirements, cells of tables."""
    every = [figures(one) for one in results]
    for where in dict.fromkeys(name for one in every for name in one):
        shown = tuple(_shown(one.get(where)) for one in every)
        having = [name for name, one in zip(names, every, strict=False) if where in one]
        if len(having) < len(every):
            yield ComparedFigure(where, shown, "", f"{ABSENT_IN} {', '.join(having)}")
            continue
        against = [_compare(every[0][where], one[where]) for one in every[1:]]
        verdict = min((v for _, v in against), key=GRAVITY.index)
        change = against[0][0]
        if len(against) > 1:
            change = ", ".join(n for n, (_, v) in zip(names[1:], against, strict=False) if v == verdict != "same")
        yield ComparedFigure(where, shown, change, verdict)


def figures(results: Mapping[str, Any]) -> dict[str, Any]:
    """Name → estimate, requirement or cell of a table; rows of one name are numbered.

    Raises:
      DamagedFileError: results that are not those of a run.
    """
    with fitting("results.json"):
        return _figures(results)


def _figures(results: Mapping[str, Any]) -> dict[str, Any]:
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
    for estimate in (x for x in found.values() if isinstance(x, Mapping)):
        low, high = estimate["ci95"]
        math.fsum((estimate["mean"], low, high, *estimate["per_seed"]))  # raises an error unless all are numbers
    return found


def _compare(a: Any, b: Any) -> tuple[str, Verdict]:
    """Change and verdict; seeds are paired by number, since seed s draws the same random numbers in both runs."""
    estimates = isinstance(a, Mapping) and isinstance(b, Mapping)
    one, two = (a["per_seed"], b["per_seed"]) if estimates else (a, b)
    if one == two:
        return "", "same"
    if estimates and len(one) == len(two) > 1:
        found = student_interval(np.subtract(two, one))
        return interval(found, "+.3g"), "significant" if found.excludes_zero else "not significant"
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


def _figures_block(found: Sequence[ComparedFigure], names: Sequence[str], most: int) -> str:
    """The number of figures of each verdict, and the figures that differ, those that all runs have first."""
    rank = lambda verdict: GRAVITY.index(verdict) if verdict in GRAVITY else len(GRAVITY)
    counts = Counter(f.verdict for f in found)
    verdicts = sorted(counts, key=rank)
    head = f"{len(found)} figures; " + "; ".join(f"{verdict}: {counts[verdict]}" for verdict in verdicts)
    paired = counts["significant"] + counts["not significant"]
    if paired:
        head += f" (of {paired} intervals, chance alone excludes 0 from {paired * CHANCE:.1f})"
    differing = sorted((f for f in found if f.verdict != "same"), key=lambda f: rank(f.verdict))
    if not differing:
        return head
    left = f"\n… and {len(differing) - most} more; --most shows them" if len(differing) > most else ""
    change = f"{names[1]} − {names[0]}" if len(names) == 2 else f"from {names[0]} differ"
    rows = [(f.where, *f.shown, f.change, f.verdict) for f in differing[:most]]
    return f"{head}\n{aligned([('figure', *names, change, ''), *rows])}{left}"


def _differences(title: str, names: Sequence[str], every: Sequence[Mapping[str, Any]]) -> str:
    """The leaves of nested mappings that are not equal in all of them."""
    flat = [dict(_leaves(tree)) for tree in every]
    rows = []
    for key in dict.fromkeys(key for one in flat for key in one):
        values = [one.get(key, ABSENT) for one in flat]
        if any(value != values[0] for value in values):
            rows.append((key, *map(str, values)))
    return f"{title}:\n{aligned([('', *names), *rows])}" if rows else f"{title}: nothing"


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of the leaves of nested objects; a list is a leaf."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
