"""The report of a run: one HTML file without scripts that needs nothing from outside itself."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.core import curves
from experiments.core.artifacts import write_bytes, write_text
from experiments.core.context import read_metrics
from experiments.core.look import colours
from experiments.core.pages import render
from experiments.core.results import Comparison, Results
from touchr1_jax.bench.scoring import REPORTED

ARROW = {"higher": " ↑", "lower": " ↓", "none": ""}


def write_report(directory: Path, results: Results, *, about: str, description: Mapping[str, Any]) -> Path:
    """Write `report.html` and the pictures in `plots/` of a run and return the path of the report.

    Args:
      directory: the run's; its `metrics.jsonl` holds the curves.
      about: docstring of the experiment; its first line is the question.
      description: content of the run's `config.json`.
    """
    colour = colours(results.arms)
    settings = dict(results.settings)
    middle, drawn = None, {}
    if results.arms:
        settings["seeds"] = len(next(iter(next(iter(results.arms.values())).values())).per_seed)
        middle = curves.accuracy_against_middle(results.arms, results.baselines, colour)
        drawn = curves.draw_phases(read_metrics(directory), results.curves, colour)
    plots = {f"{picture.name}.{picture.kind}": picture.content for picture in results.pictures}
    plots |= {f"curves_{phase}.svg": phase_curves.svg for phase, phase_curves in drawn.items()}
    plots |= {} if middle is None else {"accuracy_against_middle.svg": middle}
    for name, content in plots.items():
        write_bytes(directory / "plots" / name, content)
    page = render(
        "report.jinja",
        about=about,
        description=description,
        settings=settings,
        verdict=results.verdict,
        data=results.data,
        data_title="Data and time",
        timing=results.timing,
        results=results,
        colour=colour,
        reported=REPORTED,
        arrow=ARROW,
        metric_groups=_metric_groups(results),
        best={(metric, arm) for arm in results.arms for metric in REPORTED if is_best(metric, arm, results)},
        pairs=_pairs(results.comparisons),
        compared_over=", ".join(dict.fromkeys(f"{c.n} {c.over}" for c in results.comparisons)),
        middle=middle,
        curves=drawn,
    )
    path = directory / "report.html"
    write_text(path, page)
    return path


def is_best(metric: str, arm: str, results: Results) -> bool:
    """True if an arm has the best mean, and the paired interval between it and every other arm excludes 0."""
    better = REPORTED[metric].better
    means = {name: row[metric].mean for name, row in results.arms.items() if metric in row}
    others = set(means) - {arm}
    if better == "none" or arm not in means or not others:
        return False
    sign = 1.0 if better == "higher" else -1.0
    return all(sign * (means[arm] - means[other]) > 0 and _clear(metric, {arm, other}, results) for other in others)


def _clear(metric: str, pair: set[str], results: Results) -> bool:
    """True if the two are compared on the metric and every interval between them excludes 0."""
    found = [c for c in results.comparisons if c.metric == metric and {c.arm, c.against} == pair]
    return bool(found) and all(c.low > 0 or c.high < 0 for c in found)


def _metric_groups(results: Results) -> dict[str, dict[str, Any]]:
    """Heading → the measured metrics under it; the main ones have no heading."""
    present = {name for row in (*results.arms.values(), *results.baselines.values()) for name in row}
    groups = {
        title: {name: metric for name, metric in REPORTED.items() if metric.secondary == beside and name in present}
        for title, beside in (("", False), ("Further metrics", True))
    }
    return {title: metrics for title, metrics in groups.items() if metrics}


def _pairs(comparisons: Sequence[Comparison]) -> dict[tuple[str, str, str], dict[str, Comparison]]:
    """Metric, arm, other arm → the comparison over seeds and over objects."""
    pairs: dict[tuple[str, str, str], dict[str, Comparison]] = {}
    for c in comparisons:
        pairs.setdefault((c.metric, c.arm, c.against), {})[c.over] = c
    return pairs
