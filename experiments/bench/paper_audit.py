"""Do the published numbers of Touch-R1 agree with one another?

    make experiment EXP=paper_audit [ARGS="--vtv-items N"]

`study/paper_numbers.py` contains every number of the paper on which a conclusion depends, with its table or section.
Each check recomputes a statement of the paper from these numbers, within rounding.  The experiment trains nothing and
reads no data.

Cost: seconds.

Expected: fifteen statements that its own numbers contradict, do not support or leave open, and ten that they confirm.
So results here are compared with the directions of the paper, never with its values.
"""

import dataclasses

import numpy as np

from experiments.bench import paper_checks
from experiments.core.charts import Panel, Series, draw
from experiments.core.context import Context
from experiments.core.look import PALETTE, SHARED
from experiments.core.results import Cell, Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds
from experiments.study import paper_numbers as paper


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperAuditConfig:
    """The number of questions about each property in VTV150K's test set."""

    vtv_items: int = paper.VTV_ITEMS

    def __post_init__(self) -> None:
        if self.vtv_items < 1:
            raise ValueError(f"vtv_items is {self.vtv_items}: must be ≥ 1; give the size of the test set")


def run(config: PaperAuditConfig, context: Context) -> Results:
    """Compute every check."""
    del context
    wrong, right = paper_checks.inconsistencies(), paper_checks.confirmed()
    unseen, failed = (sum((c.verdict == "holds") == holds for c in cs) for cs, holds in ((wrong, True), (right, False)))
    count = {name: sum(c.verdict == name for c in wrong) for name in ("contradiction", "unsupported", "not given")}
    return Results(
        verdict=(
            f"{len(wrong)} statements do not hold: {count['contradiction']} are contradicted, {count['unsupported']} "
            f"not supported, {count['not given']} left open; {len(right)} others are confirmed to the rounding.",
        ),
        requirements=(
            at_most("known inconsistencies that do not show", unseen, 0),
            at_most("statements taken to hold that fail", failed, 0),
        ),
        tables=(
            _statement_table("Statements that do not hold", wrong),
            _statement_table("Statements that hold", right),
            _average_table(),
            _distance_table(),
            _vtv_table(config),
        ),
        pictures=(
            Picture(
                name="distance",
                title="OMAE against the error rate",
                caption="Each wrong answer is at least one level off, so no row can lie below the diagonal; Touch-R1 "
                "and the upper steps of its ablation do.",
                content=distance_chart(),
            ),
            Picture(
                name="average",
                title="Avg against the mean of its columns",
                caption="OMAE as 100(1 − OMAE/2), ρ as 100ρ.",
                content=average_chart(),
            ),
        ),
    )


def _statement_table(title: str, checks: tuple[paper_checks.StatementCheck, ...]) -> Table:
    statement = lambda c: {"statement, and where": f"{c.title} ({c.where})", "verdict": c.verdict}
    return named_table(title, [statement(c) | {"published": c.published, "recomputed": c.recomputed} for c in checks])


def _average_table() -> Table:
    low, high, average = paper_checks.columns_as_scores()
    weights, _ = paper_checks.best_weighting()
    rows: list[dict[str, Cell]] = [
        {"model": name, "printed": float(a), "mean of nine": float(m.mean()), "best weights": float(m @ weights)}
        for name, a, m in zip(paper.MAIN, average, (low + high) / 2, strict=True)
    ]
    used = [f"{column} {w:.2f}" for column, w in zip(paper.COLUMNS, weights, strict=True) if w > 0.005]
    return named_table(
        "Avg",
        rows,
        formats=dict.fromkeys(("printed", "mean of nine", "best weights"), ".1f"),
        meanings={"best weights": "the mean with weights ≥ 0 whose largest miss is smallest"},
        note=f"Best weights: {', '.join(used)}",
    )


def _distance_table() -> Table:
    impossible = paper_checks.impossible_distances()
    rows: list[dict[str, Cell]] = [
        {"row": name, "1 − Acc": error, "OMAE": omae, "possible": name not in impossible}
        for name, (error, omae) in paper_checks.error_and_distance().items()
    ]
    meanings = {"1 − Acc": "of the mean of H-, R- and P-Acc: least possible OMAE"}
    return named_table("OMAE and its bound", rows, formats={"1 − Acc": ".3f", "OMAE": ".2f"}, meanings=meanings)


def _vtv_table(config: PaperAuditConfig) -> Table:
    rows: list[dict[str, Cell]] = []
    ours, theirs = paper.VTV["Ours"][0][:5], paper.VTV["VTV-LLM-7B"][0][:5]
    for column, a, b in zip(paper.VTV_COLUMNS[:5], ours, theirs, strict=True):
        gain, half, p = paper_checks.gain_interval(a, b, config.vtv_items)
        span = bounds(gain - half, gain + half, ".1f")
        rows.append({"property": column, "Touch-R1": a, "VTV-LLM": b, "gain": gain, "95 %": span, "p": p})
    return named_table(
        f"Gains on VTV150K, {config.vtv_items} questions a property",
        rows,
        formats={"Touch-R1": ".1f", "VTV-LLM": ".1f", "gain": ".1f", "p": ".2f"},
        units={"Touch-R1": "%", "VTV-LLM": "%", "gain": "points"},
        meanings={"95 %": "unpaired: the answers are not published"},
    )


def distance_chart() -> bytes:
    """OMAE over the error rate of the same row; no answers can lie below the diagonal."""
    impossible, ends = paper_checks.impossible_distances(), np.array([0.25, 0.75])
    diagonal = Series("OMAE = 1 − Acc; below it is impossible", x=ends, y=ends, marker="", line=":", colour=SHARED)
    shaded = Series(x=ends, y=ends, low=[0, 0], band=True, marker="", line="", colour=PALETTE[1], alpha=0.4)
    series = [shaded, diagonal]
    every = paper_checks.error_and_distance()
    for table, marker in (("main table", "o"), ("ablation", "D")):
        rows = {name: row for name, row in every.items() if name.endswith("(ablation)") == (table == "ablation")}
        x, y = zip(*rows.values(), strict=True)
        labels = [name if name in impossible and not name.startswith("+") else "" for name in rows]
        colour = [PALETTE[1] if name in impossible else PALETTE[0] for name in rows]
        series.append(Series(table, x=x, y=y, marker=marker, line="", colour=colour, labels=labels))
    x_label, y_label = "1 − mean of H-, R-, P-Acc", "OMAE, levels"
    return draw([Panel(series, x_label=x_label, y_label=y_label, x_limits=(0.25, 0.75), y_limits=(0.15, 0.95))])


def average_chart() -> bytes:
    """Printed Avg and the plain mean of the nine columns, for every model."""
    low, high, average = paper_checks.columns_as_scores()
    mean = ((low + high) / 2).mean(1)
    joined = Series(
        x=average, low=np.minimum(average, mean), high=np.maximum(average, mean), marker="", colour="#cfd4da"
    )
    printed = Series("Avg as printed", x=average, colour=PALETTE[1], marker="o")
    plain = Series("mean of the nine columns", x=mean, colour=PALETTE[0], marker="o")
    return draw([Panel([joined, printed, plain], rows=list(paper.MAIN), x_label="points")])


DEFAULT = PaperAuditConfig()

EXPERIMENT = Experiment(name="paper_audit", config=DEFAULT, scales={"smoke": DEFAULT}, run=run)
