"""Tables and chart of the ladder and of leave-one-out: our arms, the paper's rows, the change by each component."""

from collections.abc import Mapping, Sequence

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.look import PALETTE, SHARED
from experiments.core.results import Cell, Estimate, Picture, Table, named_table
from experiments.core.text import bounds, interval, number
from experiments.paper.component_effects import LADDER_METRICS, ComponentComparison, ComponentEffect, LadderMetric
from experiments.paper.components import BASE, BASE_ROW, COMPONENTS
from experiments.study import paper_numbers as paper

PER_ATTRIBUTE = {"h_acc": "H-Acc", "r_acc": "R-Acc", "p_acc": "P-Acc", "mat_acc": "Mat-Acc"}

ROWS: tuple[tuple[str, str | None, str], ...] = (
    (BASE, BASE_ROW, "–"),
    *((c.added.name, c.row, f"+ {c.name}") for c in COMPONENTS),
)
"""Of the ladder: arm, the paper's row, the component that the arm adds to the one above it."""

Estimates = Mapping[str, Mapping[str, Estimate]]
"""Row → metric."""


def ladder_table(estimates: Estimates) -> Table:
    """OMAE, CSC and the four-attribute mean of every arm of the ladder, and of the paper's rows."""
    rows: list[dict[str, Cell]] = []
    for arm, published, adds in ROWS:
        row: dict[str, Cell] = {"arm": arm, "adds": adds}
        for metric in LADDER_METRICS:
            row[metric.title] = _cell(estimates[arm].get(metric.metric), metric.format.lstrip("+"))
            row[f"{metric.title}, paper"] = None if published is None else paper.LADDER[published][metric.column]
        rows.append(row)
    return named_table(
        "The ladder",
        rows,
        formats={f"{m.title}, paper": m.format.lstrip("+") for m in LADDER_METRICS},
        note="Means over seeds with 95 % intervals over objects. Avg is the mean of the four accuracies, which is what "
        "the paper's ladder prints under that name.",
    )


def attribute_table(estimates: Estimates) -> Table:
    """Accuracy on each attribute of every arm of the ladder, and of the paper's table (b)."""
    rows: list[dict[str, Cell]] = []
    for arm, published, _ in ROWS:
        row: dict[str, Cell] = {"arm": arm}
        of_paper = paper.PER_ATTRIBUTE.get(published or "")
        for i, (metric, title) in enumerate(PER_ATTRIBUTE.items()):
            row[title] = _cell(estimates[arm].get(metric), ".1f")
            row[f"{title}, paper"] = None if of_paper is None else of_paper[0][i]
        rows.append(row)
    return named_table(
        "Accuracy on each attribute",
        rows,
        formats={f"{title}, paper": ".1f" for title in PER_ATTRIBUTE.values()},
        units={column: "%" for title in PER_ATTRIBUTE.values() for column in (title, f"{title}, paper")},
        note="GRPO asks about hardness, roughness and protrusion; material is asked in the evaluation alone.",
    )


def effects_table(found: ComponentComparison, title: str, note: str) -> Table:
    """The change that each component makes, its sign compared with the paper's, and the failures behind it."""
    rows: list[dict[str, Cell]] = [
        {
            "component and metric": f"{e.step.component}: {e.metric.title}",
            "change": number(e.seeds.mean, e.metric.format),
            "95 % over seeds": bounds(e.seeds.low, e.seeds.high, e.metric.format),
            "p": e.p_seeds,
            "95 % over objects": bounds(e.objects.low, e.objects.high, e.metric.format),
            "p over objects": e.p_objects,
            "paper": number(e.published, e.metric.format),
            "sign": e.sign,
            "failures": "; ".join(found.failures.get(e, ())),
        }
        for e in found.effects
    ]
    return named_table(
        title,
        rows,
        formats={"p": ".3f", "p over objects": ".3f"},
        meanings={
            "95 % over seeds": "Student's t over paired seeds",
            "p": "of sign flips over seeds, corrected over the table (Holm)",
            "95 % over objects": "whole objects resampled, seeds pooled",
            "p over objects": "of sign flips of whole objects, corrected likewise",
            "paper": "difference of the rows of its ladder",
            "sign": "reproduced or opposite where the interval over seeds excludes 0, else undecided",
            "failures": "known failures that the run shows",
        },
        note=note,
    )


def effects_picture(effects: Sequence[ComponentEffect], title: str) -> tuple[Picture, ...]:
    """The chart of all effects, one panel for each metric; none with a single seed."""
    if not effects:
        return ()
    components = list(dict.fromkeys(e.step.component for e in effects))
    caption = (
        "Change that each component makes. The paper prints single numbers; its Avg of the ladder is the mean of four "
        "accuracies, and so is ours here."
    )
    panels = [_panel(metric, effects, components) for metric in dict.fromkeys(e.metric for e in effects)]
    return (Picture(name="changes", title=title, caption=caption, content=draw(panels, share_y=True)),)


def _panel(metric: LadderMetric, effects: Sequence[ComponentEffect], components: Sequence[str]) -> Panel:
    of = [e for e in effects if e.metric == metric]
    places = [components.index(e.step.component) for e in of]
    low, high, mean = ([getattr(e.seeds, end) for e in of] for end in ("low", "high", "mean"))
    published = [(e.published, at) for e, at in zip(of, places, strict=True) if e.published is not None]
    series = [
        Series("here, 95 % over seeds", x=mean, y=places, low=low, high=high, colour=PALETTE[0], marker="o", width=2.4),
        Series(
            "95 % over objects",
            x=mean,
            y=places,
            low=[e.objects.low for e in of],
            high=[e.objects.high for e in of],
            colour=PALETTE[0],
            marker="",
            width=1.0,
            alpha=0.5,
            shift=0.12,
        ),
        Series(
            "paper",
            x=[value for value, _ in published],
            y=[at for _, at in published],
            colour=PALETTE[1],
            marker="D",
            hollow=True,
            shift=-0.2,
        ),
    ]
    rows = [f"+ {component}" for component in components]
    return Panel(series, rows=rows, x_label=f"change of {metric.title}", rules=[Rule(x=0, line="-", colour=SHARED)])


def _cell(found: Estimate | None, spec: str) -> Cell:
    return None if found is None else interval(found, spec)
