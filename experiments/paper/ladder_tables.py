"""The tables of the ladder: rungs beside the paper's, what each component changes and why a sign does not come out."""

from collections.abc import Mapping, Sequence

from experiments.core.results import Cell, Column, Estimate, Table
from experiments.paper.deltas import MEASURES, Delta
from experiments.paper.ladder_arms import LADDER
from experiments.study import paper_numbers as paper
from touchr1_jax.bench.statistics import Interval

PER_ATTRIBUTE = ("h_acc", "r_acc", "p_acc", "mat_acc")

DIFFERS: tuple[tuple[str, str, str], ...] = (
    ("policy", "Qwen2.5-VL, 7 billion pretrained parameters", "0.6 million parameters, from scratch"),
    ("base", "the pretrained model, asked without training", "the commonest level of each attribute"),
    ("data", "14,700 recorded sequences by four sensors", "2,400 generated objects, a press by four sensors"),
    ("questions", "4,800, authored and audited", "all four attributes of every unseen object"),
    ("learning rate", "1e-6 in GRPO, 1e-5 in SFT", "the same times 200 falling to 10, and times 100"),
    ("grounding γ, clip", "not given", ".01, .2"),
    ("tactile use", "in the abstract alone", "a rung of its own, above the paper's last"),
    ("Avg of the ladder", "equals the mean of its four accuracies", "that mean"),
    ("seeds, intervals", "none", "paired seeds; seeds and objects, corrected over the table"),
)
"""What, in the paper, here: why the figures are not expected to agree beyond their signs."""


def rung_table(estimates: Mapping[str, Mapping[str, Estimate]]) -> Table:
    """OMAE, CSC and the four-attribute mean of every rung beside the paper's ladder.

    Args:
      estimates: row → metric, `FOUR` among them.
    """
    rows: list[tuple[Cell, ...]] = []
    for rung in LADDER:
        published = None if rung.published is None else paper.LADDER[rung.published]
        row: list[Cell] = [rung.name, f"+ {rung.adds}" if rung.adds else "–"]
        for measure in MEASURES:
            found = estimates[rung.name].get(measure.metric)
            row.append(None if found is None else _with_interval(found, measure.format.lstrip("+")))
            row.append(None if published is None else published[measure.column])
        rows.append(tuple(row))
    return Table(
        title="The ladder",
        columns=(
            Column(name="rung"),
            Column(name="adds"),
            *(
                column
                for m in MEASURES
                for column in (Column(name=m.title), Column(name=f"{m.title}, paper", format=m.format.lstrip("+")))
            ),
        ),
        rows=tuple(rows),
        note="Means over seeds with 95 % intervals over objects. Avg is the mean of the four accuracies, which is what "
        "the paper's ladder prints under that name.",
    )


def attribute_table(estimates: Mapping[str, Mapping[str, Estimate]]) -> Table:
    """Accuracy on each attribute, every rung beside the paper's table (b)."""
    rows: list[tuple[Cell, ...]] = []
    for rung in LADDER:
        published = paper.PER_ATTRIBUTE.get(rung.published or "")
        row: list[Cell] = [rung.name]
        for i, metric in enumerate(PER_ATTRIBUTE):
            found = estimates[rung.name].get(metric)
            row.append(None if found is None else _with_interval(found, ".1f"))
            row.append(None if published is None else published[0][i])
        rows.append(tuple(row))
    names = ("H-Acc", "R-Acc", "P-Acc", "Mat-Acc")
    return Table(
        title="Accuracy on each attribute",
        columns=(
            Column(name="rung"),
            *(c for n in names for c in (Column(name=n, unit="%"), Column(name=f"{n}, paper", unit="%", format=".1f"))),
        ),
        rows=tuple(rows),
        note="GRPO asks about hardness, roughness and protrusion; material is only asked in the examination.",
    )


def delta_table(found: Sequence[Delta], why: Mapping[Delta, Sequence[str]], title: str, note: str) -> Table:
    """What each component changes, whether the paper's sign comes out, and what shows where it does not.

    Args:
      found: the differences.
      why: failures that show, for those whose sign does not come out.
      title, note: of the table.
    """
    rows: list[tuple[Cell, ...]] = [
        (
            f"{d.step.adds}: {d.measure.title}",
            _number(d.seeds.mean, d.measure.format),
            _span(d.seeds, d.measure.format),
            d.p_seeds,
            _span(d.objects, d.measure.format),
            d.p_objects,
            "–" if d.published is None else _number(d.published, d.measure.format),
            d.sign,
            "; ".join(why.get(d, ())),
        )
        for d in found
    ]
    return Table(
        title=title,
        columns=(
            Column(name="component and measure"),
            Column(name="change"),
            Column(name="95 % over seeds", meaning="Student's t over paired seeds"),
            Column(name="p", format=".3f", meaning="of sign flips over seeds, corrected over the table (Holm)"),
            Column(name="95 % over objects", meaning="whole objects resampled, seeds pooled"),
            Column(name="p over objects", format=".3f", meaning="of sign flips of whole objects, corrected likewise"),
            Column(name="paper", meaning="difference of the rows of its ladder"),
            Column(
                name="sign",
                meaning="reproduced or opposite where the interval over seeds excludes 0, else undecided",
            ),
            Column(name="what shows", meaning="known failures that the run shows"),
        ),
        rows=tuple(rows),
        note=note,
    )


def _with_interval(found: Estimate, spec: str) -> str:
    low, high = (_number(x, spec) for x in found.ci95)
    return f"{_number(found.mean, spec)} [{low}, {high}]"


def _span(interval: Interval, spec: str) -> str:
    return f"[{_number(interval.low, spec)}, {_number(interval.high, spec)}]"


def _number(value: float, spec: str) -> str:
    return format(value, spec).replace("-", "−")
