"""Figures of a sweep: those that all of its runs have, over the values of its options."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from experiments.core.charts import Panel, Series, draw, estimates
from experiments.core.compare import figures
from experiments.core.results import Estimate
from touchr1_jax.bench.scoring import REPORTED

MOST = 6  # figures of a table whose figures nobody chose

MAIN = ("acc", "avg", "omae")  # metrics of a table of arms whose figures nobody chose

WIDE = 20.0  # largest over smallest value from which on an axis is logarithmic


def chosen_figures(results: Sequence[Mapping[str, Any]], wanted: Sequence[str]) -> list[str]:
    """Names of numbers that all runs have: with a wanted word in them, else the main ones of the arms, or a few."""
    numbers = [{n for n, x in figures(one).items() if number_of(x) is not None} for one in results]
    shared = [n for n in (figures(results[0]) if results else ()) if all(n in of for of in numbers)]
    if wanted:
        return [n for n in shared if any(word in n for word in wanted)]
    arms = results[0].get("arms", {}) if results else {}
    main = [f"{arm} {metric}" for metric in MAIN for arm in arms]
    return [n for n in main if n in shared] or shared[:MOST]


def chart(finished: Sequence[tuple[Mapping[str, str], Mapping[str, Any]]], chosen: Sequence[str]) -> bytes:
    """Draw a panel for each metric, or each chosen figure without one, over the first option.

    A line is an arm, and an arm for each setting of the further options.
    """
    first = next(iter(finished[0][0]))
    listed = list(dict.fromkeys(settings[first] for settings, _ in finished))
    places = dict(zip(listed, _numbers(listed) or range(len(listed)), strict=True))
    positive = _numbers(listed) and min(places.values()) > 0
    scale: Any = "log" if positive and max(places.values()) >= WIDE * min(places.values()) else "linear"
    panels: dict[str, dict[str, list[tuple[float, Any]]]] = {}
    for figure in chosen:
        arm, _, metric = figure.rpartition(" ")
        title, line = (_title(metric), arm) if metric in REPORTED else (figure, "")
        for settings, of in finished:
            others = ", ".join(f"{name} {value}" for name, value in settings.items() if name != first)
            named = ", ".join(filter(None, (line, others)))
            panels.setdefault(title, {}).setdefault(named, []).append((places[settings[first]], number_of(of[figure])))
    ticks = {place: value for value, place in places.items()}
    return draw(
        [
            Panel(list(_lines(lines)), title=title, x_label=first, x_scale=scale, x_ticks=ticks)
            for title, lines in panels.items()
        ]
    )


def _lines(lines: Mapping[str, Sequence[tuple[float, Any]]]) -> Iterator[Series]:
    for name, points in lines.items():
        at, values = zip(*sorted(points, key=lambda point: point[0]), strict=True)
        if isinstance(values[0], Estimate):
            yield estimates(name, values, at=at)
        else:
            yield Series(name, x=at, y=values)


def number_of(value: Any) -> Estimate | float | None:
    """A figure as a number or an estimate; `None` for what is neither."""
    if isinstance(value, Mapping):
        return Estimate(**{**value, "ci95": tuple(value["ci95"]), "per_seed": tuple(value["per_seed"])})
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _numbers(words: Sequence[str]) -> list[float]:
    """Words as numbers, nothing where one is none."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def _title(metric: str) -> str:
    unit = REPORTED[metric].unit
    return f"{REPORTED[metric].title} ({unit})" if unit else REPORTED[metric].title
