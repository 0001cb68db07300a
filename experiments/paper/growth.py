"""What a larger policy gains: change of a metric for every doubling of its parameters, beside the paper's claim."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, PALETTE, SHARED, svg
from experiments.core.results import Cell, Column, Estimate, Table
from experiments.paper.paper_comparison import COLUMNS
from experiments.paper.sizes import Cost
from experiments.study import paper_numbers as paper
from experiments.study.study import StudyConfig
from touchr1_jax.bench.averages import touch_average
from touchr1_jax.bench.scoring import REPORTED
from touchr1_jax.bench.statistics import Interval, student_interval

Rows = Mapping[str, Mapping[str, Mapping[str, Estimate]]]
"""Policy → size → metric."""

Sizes = Mapping[str, Cost]

CLAIMED = ("l2_em", "soi_rho", "csc", "avg")
"""What the paper names as growing clearly with the size; it says so of most other metrics as well."""

Sign = Literal["better", "worse", "undecided"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Growth:
    """Change of a metric for each doubling of the parameters, with its interval over seeds."""

    policy: str
    metric: str
    slope: Interval

    @property
    def sign(self) -> Sign:
        """Whether larger is better, worse, or neither beyond chance over seeds."""
        if not self.slope.excludes_zero:
            return "undecided"
        rises = self.slope.mean > 0
        return "better" if rises == (REPORTED[self.metric].better == "higher") else "worse"


def growths(rows: Rows, costs: Sizes, metrics: Sequence[str]) -> tuple[Growth, ...]:
    """Slopes of every policy and metric: for every seed a line m = a + b·log₂ N through its sizes, b over seeds.

    Args:
      rows: policy → size → metric; every policy and size has the same seeds, two at least.
      costs: size → parameters N.
      metrics: those to look at; one that some size lacks is left out.
    """
    doublings = np.log2([costs[name].parameters for name in costs])
    found = []
    for policy, sizes in rows.items():
        for metric in metrics:
            if all(metric in sizes[name] for name in costs):
                values = np.array([sizes[name][metric].per_seed for name in costs])
                slope = student_interval(_slopes(doublings, values))
                found.append(Growth(policy=policy, metric=metric, slope=slope))
    return tuple(found)


def _slopes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Least squares, Σ (x − x̄)(y − y₀) / Σ (x − x̄)²: exactly 0 where y [n, seeds] does not change with x [n]."""
    away = x - x.mean()
    return np.asarray(away @ (y - y[:1]) / (away @ away))


def growth_table(found: Sequence[Growth]) -> Table:
    """Every slope, and what the paper says of the metric."""
    rows: list[tuple[Cell, ...]] = []
    for growth in found:
        metric, slope = REPORTED[growth.metric], growth.slope
        spec = f"+{metric.format}"
        number = lambda x, spec=spec: format(x, spec).replace("-", "−")
        rows.append(
            (
                f"{growth.policy}: {metric.title}",
                number(slope.mean),
                f"[{number(slope.low)}, {number(slope.high)}]",
                growth.sign,
                "grows clearly" if growth.metric in CLAIMED else "grows, if it is among most",
            )
        )
    return Table(
        title="What a doubling of the parameters changes",
        columns=(
            Column(name="policy and metric"),
            Column(name="change"),
            Column(name="95 % over seeds", meaning="Student's t over the slopes of single seeds"),
            Column(name="larger is", meaning="better or worse where the interval excludes 0"),
            Column(name="paper", meaning="its text: consistent growth on most higher-better metrics, these named"),
        ),
        rows=tuple(rows),
        note="Slopes of straight lines through three sizes; the learning rates are those of the default size.",
    )


def size_table(models: Mapping[str, str], costs: Sizes, config: StudyConfig) -> Table:
    """What each size is and takes.

    Args:
      models: size → its shape in words.
      costs: size → what it takes.
      config: of the studies.
    """
    rows: list[tuple[Cell, ...]] = [
        (
            name,
            cost.parameters,
            models[name],
            1e3 * cost.sft_s,
            1e3 * cost.grpo_s,
            1e3 * cost.question_s,
            cost.training_s(config),
        )
        for name, cost in costs.items()
    ]
    return Table(
        title="Sizes",
        columns=(
            Column(name="size"),
            Column(name="parameters"),
            Column(name="shape", meaning="layers × width of the tactile encoder, the picture tower, the decoder"),
            Column(name="SFT step", unit="ms", format=".0f", meaning="measured in turns with the other sizes"),
            Column(name="GRPO step", unit="ms", format=".0f", meaning="as it ran"),
            Column(name="question", unit="ms", format=".1f", meaning="pictures to answer, to its full length"),
            Column(name="training", unit="s", format=".0f", meaning="both stages of a seed, by the steps' times"),
        ),
        rows=tuple(rows),
    )


def beside_sizes(rows: Mapping[str, Mapping[str, Estimate]]) -> Table:
    """The full model of every size in the columns of the paper's main table, and the paper's own sizes.

    Args:
      rows: size → metric.
    """
    ours: list[tuple[Cell, ...]] = [
        (name, *(row[m].mean if m in row else None for m in COLUMNS), row["avg"].mean if "avg" in row else None)
        for name, row in rows.items()
    ]
    values, _ = paper.MAIN["Touch-R1-7B"]
    printed = {7: (*values, touch_average(dict(zip(COLUMNS, values, strict=True))))}
    theirs: list[tuple[Cell, ...]] = [
        (f"Touch-R1-{size}B (paper)", *printed.get(size, (None,) * (len(COLUMNS) + 1))) for size in paper.BACKBONES
    ]
    return Table(
        title="Beside the paper's sizes",
        columns=(
            Column(name="size"),
            *(Column(name=REPORTED[m].title, unit=REPORTED[m].unit, format=REPORTED[m].format) for m in COLUMNS),
            Column(name="Avg", format=".1f", meaning="mean of the nine columns, OMAE as 100(1 − OMAE/2), ρ as 100ρ"),
        ),
        rows=(*ours, *theirs),
        note="The paper draws 3 and 14 billion as bars without numbers, and leaves OMAE out; there is no Qwen2.5-VL of "
        "14 billion.",
    )


def growth_chart(rows: Rows, costs: Sizes, config: StudyConfig, metrics: Sequence[str]) -> bytes:
    """One row of panels for each metric, against parameters and against seconds of training.

    Args:
      rows: policy → size → metric.
      costs: size → what it takes.
      config: of the studies.
      metrics: those to draw.
    """
    axis = {
        "parameters (million)": [cost.parameters / 1e6 for cost in costs.values()],
        "training of a seed (s)": [cost.training_s(config) for cost in costs.values()],
    }
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(8.2, 2.5 * len(metrics) + 0.5), layout="constrained")
        panels = figure.subplots(len(metrics), len(axis), sharey="row", squeeze=False)
        for line, metric in zip(panels, metrics, strict=True):
            for axes, (label, x) in zip(line, axis.items(), strict=True):
                _panel(axes, {policy: [row[name][metric] for name in costs] for policy, row in rows.items()}, x)
                axes.set_xlabel(label if metric == metrics[-1] else "")
            unit = f" ({REPORTED[metric].unit})" if REPORTED[metric].unit else ""
            line[0].set_ylabel(f"{REPORTED[metric].title}{unit}")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(labels))
        return svg(figure)


def _panel(axes: Axes, estimates: Mapping[str, Sequence[Estimate]], x: Sequence[float]) -> None:
    """A line for each policy, its 95 % intervals over objects, a dot for every seed."""
    for (policy, found), colour in zip(estimates.items(), (*PALETTE[:2], SHARED), strict=False):
        mean = np.array([e.mean for e in found])
        low, high = np.array([e.ci95 for e in found]).T
        axes.errorbar(x, mean, (mean - low, high - mean), color=colour, marker="o", ms=5, lw=1.6, elinewidth=1,
                      label=policy)  # fmt: skip
        for at, e in zip(x, found, strict=True):
            axes.plot([at] * len(e.per_seed), e.per_seed, "o", color=colour, ms=3, alpha=0.35, mew=0)
    axes.set_xscale("log", base=2)
    axes.set_xticks(x, [format(value, ".2g") if value < 10 else format(value, ".0f") for value in x])
    axes.minorticks_off()
