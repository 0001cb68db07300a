"""Rows of the bench beside the paper's main table, and what the bench asks."""

import collections
from collections.abc import Mapping, Sequence

from experiments.core.results import Cell, Column, Estimate, Table
from experiments.study import paper_numbers as paper
from touchr1_jax.bench.averages import touch_average
from touchr1_jax.bench.items import KINDS, Ask
from touchr1_jax.bench.scoring import REPORTED

COLUMNS = ("h_acc", "r_acc", "p_acc", "mat_acc", "omae", "l2_em", "sfd", "soi_rho", "csc")
"""Ours, in the order of the paper's main table."""

SHOWN = ("Qwen2.5-VL-7B", "GPT-4o", "Octopi-13B", "SToLa", "Touch-R1-7B")
"""Rows of the paper that stand below ours."""


def beside_table(rows: Mapping[str, Mapping[str, Estimate]]) -> Table:
    """Every row of ours, then the paper's, in its columns; the last column is the same average of both.

    Args:
      rows: row → metric.
    """
    ours: list[tuple[Cell, ...]] = [
        (name, *(row[m].mean if m in row else None for m in COLUMNS), row["avg"].mean if "avg" in row else None, None)
        for name, row in rows.items()
    ]
    theirs: list[tuple[Cell, ...]] = [
        (f"{name} (paper)", *values, touch_average(dict(zip(COLUMNS, values, strict=True))), average)
        for name, (values, average) in ((name, paper.MAIN[name]) for name in SHOWN)
    ]
    columns = [Column(name=REPORTED[m].title, unit=REPORTED[m].unit, format=REPORTED[m].format) for m in COLUMNS]
    return Table(
        title="Beside the paper's main table",
        columns=(
            Column(name="row"),
            *columns,
            Column(name="Avg", format=".1f", meaning="mean of the nine columns, OMAE as 100(1 − OMAE/2), ρ as 100ρ"),
            Column(name="Avg as printed", format=".1f", meaning="the paper's own, whose formula is not given"),
        ),
        rows=(*ours, *theirs),
        note="Direction, not parity: other objects, other sizes, no pretrained model. Intervals stand in the table "
        "above.",
    )


def tier_table(asks: Sequence[Ask]) -> Table:
    """How many questions of each kind, about how many objects."""
    counts = collections.Counter(ask.kind for ask in asks)
    rows: list[tuple[Cell, ...]] = [
        (
            kind,
            about.tier,
            counts[kind],
            len({touch.object for ask in asks if ask.kind == kind for touch in ask.touches}),
            about.meaning,
        )
        for kind, about in KINDS.items()
        if counts[kind]
    ]
    return Table(
        title="Questions",
        columns=(
            Column(name="kind"),
            Column(name="tier", format="d"),
            Column(name="questions", format="d"),
            Column(name="objects", format="d"),
            Column(name="asks for"),
        ),
        rows=tuple(rows),
    )
