"""The self-contained report of a run: one HTML file without scripts that needs nothing from outside itself."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.core import charts, curves
from experiments.core.artifacts import write_bytes, write_text
from experiments.core.context import read_metrics
from experiments.core.page import Html, document, image, row, table, tag
from experiments.core.report_findings import picture_section, requirement_section, table_section
from experiments.core.report_parts import appendix, curve_figure, curve_section, data_and_time, header
from experiments.core.report_rollouts import rollouts
from experiments.core.results import Comparison, Estimate, Results
from experiments.core.text import bounds, number
from touchr1_jax.bench.scoring import REPORTED

ARROW = {"higher": " ↑", "lower": " ↓", "none": ""}


def write_report(directory: Path, results: Results, *, about: str, description: Mapping[str, Any]) -> Path:
    """Write `report.html` and `plots/*.svg` of a run and return the path of the report.

    Args:
      directory: the run's; its `metrics.jsonl` holds the curves.
      about: docstring of the experiment; its first line is the question.
      description: content of the run's `config.json`.
    """
    question, _, rest = about.strip().partition("\n")
    colour = charts.colours(results.arms)
    arms = bool(results.arms)
    page = document(
        f"{description['experiment']} · {description['scale']}",
        _header(results, question, rest.strip(), description),
        requirement_section(results.requirements),
        _answers(results, colour) if arms else Html(""),
        *[picture_section(directory, p) for p in results.pictures],
        *[table_section(t) for t in results.tables],
        _comparisons(results),
        _middle(directory, results, colour) if arms else Html(""),
        _curves(directory, results, colour) if arms else Html(""),
        rollouts(results.examples, colour),
        data_and_time(results.data, results.timing),
        appendix(description),
    )
    path = directory / "report.html"
    write_text(path, page)
    return path


def is_best(metric: str, arm: str, results: Results) -> bool:
    """Whether an arm has the best mean of all arms and every other arm is behind it by a paired interval without 0."""
    better = REPORTED[metric].better
    rivals = {name: values[metric].mean for name, values in results.arms.items() if metric in values}
    others = [name for name in rivals if name != arm]
    if better == "none" or arm not in rivals or not others:
        return False
    sign = 1.0 if better == "higher" else -1.0
    return all(
        sign * (rivals[arm] - rivals[other]) > 0 and _beyond_doubt(metric, {arm, other}, results) for other in others
    )


def _beyond_doubt(metric: str, pair: set[str], results: Results) -> bool:
    """Whether the two are compared on the metric and every interval between them excludes 0."""
    found = [c for c in results.comparisons if c.metric == metric and {c.arm, c.against} == pair]
    return bool(found) and all(c.ci95[0] > 0 or c.ci95[1] < 0 for c in found)


def _header(results: Results, question: str, rest: str, description: Mapping[str, Any]) -> Html:
    settings = dict(results.settings)
    if results.arms:
        settings["seeds"] = len(next(iter(next(iter(results.arms.values())).values())).per_seed)
    return header(question, rest, description, settings, results.verdict)


def _answers(results: Results, colour: Mapping[str, str]) -> Html:
    note = (
        "Means over seeds; below them 95 % intervals that resample whole objects. Bold: ahead of every other arm "
        "by a paired interval that excludes 0. Shares in %. Baselines stand in grey."
    )
    tables = []
    for beside in (False, True):
        present = {m for values in (*results.arms.values(), *results.baselines.values()) for m in values}
        metrics = [name for name, metric in REPORTED.items() if metric.beside == beside and name in present]
        if metrics:
            tables.append(tag("h3", "Beside them") if beside else "")
            tables.append(_metric_table(metrics, results, colour))
            tables.append(_legend(metrics))
    return tag("section", tag("h2", "Answers on held-out objects"), tag("p", note, class_="note"), *tables)


def _metric_table(metrics: list[str], results: Results, colour: Mapping[str, str]) -> Html:
    head = [
        "",
        *(tag("span", REPORTED[m].title, tag("span", ARROW[REPORTED[m].better], class_="better")) for m in metrics),
    ]
    rows = [
        row(_named(arm, colour), *(_cell(m, values.get(m), is_best(m, arm, results)) for m in metrics), head=1)
        for arm, values in results.arms.items()
    ]
    for i, (name, values) in enumerate(results.baselines.items()):
        kind = "baseline" if i else "baseline first"
        rows.append(row(name, *(_cell(m, values.get(m), False) for m in metrics), head=1, class_=kind))
    return table(head, rows)


def _cell(metric: str, value: Estimate | None, best: bool) -> Html | str:
    if value is None:
        return "–"
    shown = tag("b" if best else "span", number(value.mean, REPORTED[metric].format))
    return tag("td", shown, tag("span", bounds(*value.ci95, REPORTED[metric].format), class_="ci"))


def _legend(metrics: list[str]) -> Html:
    lines = [f"{REPORTED[m].title}{_unit(REPORTED[m].unit)}: {REPORTED[m].meaning}." for m in metrics]
    return tag(
        "details", tag("summary", "What the columns mean", class_="note"), *[tag("p", x, class_="note") for x in lines]
    )


def _comparisons(results: Results) -> Html:
    """One row per metric and pair, its intervals over seeds and over objects side by side."""
    if not results.comparisons:
        return Html("")
    sizes = ", ".join(f"{n} {over}" for n, over in dict.fromkeys((c.n, c.over) for c in results.comparisons))
    note = (
        f"Paired differences ({sizes}). Over seeds: Student's t interval of the per-seed differences, p-value of the "
        "sign-flip test (2 / 2ⁿ at best for n seeds), and the probability that a run of the first beats a run of "
        "the second. Over objects: bootstrap of whole objects. Bold intervals exclude 0."
    )
    head = [
        "Metric",
        tag("th", "Pair", class_="text"),
        "Difference",
        "95 % over seeds",
        "p",
        "P(better)",
        "95 % over objects",
    ]
    pairs: dict[tuple[str, str, str], dict[str, Comparison]] = {}
    for c in results.comparisons:
        pairs.setdefault((c.metric, c.arm, c.against), {})[c.over] = c
    rows = []
    above = ""
    for (metric, arm, against), found in pairs.items():
        rows.append(_comparison(metric, f"{arm} − {against}", found, first=metric != above))
        above = metric
    return tag("section", tag("h2", "Paired comparisons"), tag("p", note, class_="note"), table(head, rows))


def _comparison(metric: str, pair: str, found: Mapping[str, Comparison], first: bool) -> Html:
    shown, seeds = REPORTED[metric], found.get("seeds")
    spec = "+" + shown.format
    return row(
        shown.title + ARROW[shown.better] if first else "",
        tag("td", pair, class_="text"),
        number(next(iter(found.values())).difference, spec) + _unit(shown.unit, bare=True),
        _bounds(seeds, spec),
        f"{seeds.p_value:.3f}" if seeds and seeds.p_value is not None else "–",
        f"{seeds.improvement:.2f}" if seeds and seeds.improvement is not None else "–",
        _bounds(found.get("objects"), spec),
        head=1,
        class_="first" if first else "more",
    )


def _bounds(c: Comparison | None, spec: str) -> Html:
    if c is None:
        return tag("td", "–")
    interval = bounds(*c.ci95, spec)
    return tag("td", tag("b", interval) if c.ci95[0] > 0 or c.ci95[1] < 0 else interval)


def _middle(directory: Path, results: Results, colour: Mapping[str, str]) -> Html:
    svg = curves.accuracy_against_middle(results.arms, results.baselines, colour)
    if svg is None:
        return Html("")
    write_bytes(directory / "plots" / "accuracy_against_middle.svg", svg)
    caption = (
        "A policy that is paid for near misses can gain by answering the middle level whatever it feels. It would lie "
        "to the right without lying higher. Large marks: means with 95 % intervals over objects; small ones: seeds."
    )
    picture = image(svg, "svg+xml", "Accuracy over the rate of middle answers, one mark per arm and baseline")
    return tag(
        "section", tag("h2", "Accuracy against middle answers"), tag("figure", picture, tag("figcaption", caption))
    )


def _curves(directory: Path, results: Results, colour: Mapping[str, str]) -> Html:
    figures = {}
    for phase, scalars in curves.curves_by_phase(read_metrics(directory)).items():
        wanted = results.curves.get(phase, tuple(scalars))
        drawn = {name: scalars[name] for name in wanted if name in scalars}
        if drawn:
            svg = curves.training_curves(drawn, colour)
            write_bytes(directory / "plots" / f"curves_{phase}.svg", svg)
            figures[phase] = curve_figure(phase, tuple(drawn), svg)
    return curve_section("Training curves", figures)


def _named(arm: str, colour: Mapping[str, str]) -> Html:
    return tag("th", tag("span", class_="swatch", style=f"background:{colour[arm]}"), arm)


def _unit(unit: str, bare: bool = False) -> str:
    if not unit:
        return ""
    return f" {'points' if unit == '%' else unit}" if bare else f" ({unit})"
