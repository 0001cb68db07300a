"""Trained policies over all columns of the bench at once: interquartile mean and probability of improvement."""

from collections.abc import Mapping

import numpy as np

from experiments.core.results import Cell, Column, Estimate, Table
from experiments.paper.paper_comparison import COLUMNS
from touchr1_jax.bench.averages import WORST_OMAE
from touchr1_jax.bench.scoring import REPORTED
from touchr1_jax.bench.statistics import Interval, improvement_interval, stratified_bootstrap_iqm

SCALES = {"omae": lambda x: 100 * (1 - x / WORST_OMAE), "soi_rho": lambda x: 100 * x}
"""Columns that are no shares in percent, as shares: 100 is right, higher is better."""


def aggregate_table(rows: Mapping[str, Mapping[str, Estimate]], against: str) -> tuple[Table, ...]:
    """Every row that was trained with two seeds or more, its columns pooled, and how often it beats another row.

    Args:
      rows: row → metric; rows of one seed, baselines, are left out.
      against: the row that the others are held against.

    Returns:
      The table; none where `against` has a single seed.
    """
    trained = {name: row for name, row in rows.items() if all(len(e.per_seed) > 1 for e in row.values())}
    if against not in trained:
        return ()
    columns = [m for m in COLUMNS if all(m in row for row in trained.values())]
    scores = {name: _scores(row, columns) for name, row in trained.items()}
    lines: list[tuple[Cell, ...]] = [
        (
            name,
            *_cells(stratified_bootstrap_iqm(x), ".1f"),
            *(("–", "–") if name == against else _cells(improvement_interval(x, scores[against]), ".2f")),
        )
        for name, x in scores.items()
    ]
    titles = ", ".join(REPORTED[m].title for m in columns)
    table = Table(
        title="Over seeds and columns",
        columns=(
            Column(name="row"),
            Column(name="IQM", unit="%", meaning="interquartile mean over seeds and columns"),
            Column(name="95 % of the IQM", meaning="the seeds of each column resampled on their own"),
            Column(name=f"P(better than {against})", meaning="probability of improvement, ties count half"),
            Column(name="95 % of P", meaning="the seeds of both sides resampled on their own"),
        ),
        rows=tuple(lines),
        note=f"Columns: {titles}; OMAE as 100(1 − OMAE/2), ρ as 100ρ. After Agarwal et al., Deep RL at the Edge of the "
        "Statistical Precipice (2021). Seeds alone: what other objects would change stands in the intervals above.",
    )
    return (table,)


def _scores(row: Mapping[str, Estimate], columns: list[str]) -> np.ndarray:
    """Seeds × columns, percent, higher is better."""
    shares = [SCALES.get(m, lambda x: x)(np.asarray(row[m].per_seed)) for m in columns]
    return np.stack(shares, axis=1)


def _cells(interval: Interval, spec: str) -> tuple[str, str]:
    mean, low, high = (format(x, spec).replace("-", "−") for x in (interval.mean, interval.low, interval.high))
    return mean, f"[{low}, {high}]"
