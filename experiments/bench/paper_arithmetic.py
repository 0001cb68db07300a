"""What follows from the printed numbers of Touch-R1 by arithmetic alone, rounding granted.

A printed number stands for every number that rounds to it.
"""

import dataclasses
import math

import numpy as np
from scipy import optimize, special

from experiments.study import paper_numbers as paper

SHARE_ROUNDING, LEVEL_ROUNDING = 0.05, 0.005
"""Half of the last digit of a percentage, and of OMAE and ρ."""

TOUCHES = 1e-6
"""Points; the solver's own error, below which nothing is missed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weighting:
    """The non-negative weights that bring the columns closest to Avg, and by how much they miss it at the worst."""

    weights: np.ndarray
    miss: float


def columns_as_scores() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and greatest columns that round to the printed ones, as scores of 0–100 [models, 9], and Avg [models].

    OMAE counts as 100(1 − OMAE/2), ρ as 100ρ.
    """
    printed = np.array([row for row, _ in paper.MAIN.values()])
    rounding = np.full(len(paper.COLUMNS), SHARE_ROUNDING)
    omae, rho = paper.COLUMNS.index("OMAE"), paper.COLUMNS.index("SOI-ρ")
    printed[:, omae], rounding[omae] = 100 - 50 * printed[:, omae], 50 * LEVEL_ROUNDING
    printed[:, rho], rounding[rho] = 100 * printed[:, rho], 100 * LEVEL_ROUNDING
    return printed - rounding, printed + rounding, np.array([avg for _, avg in paper.MAIN.values()])


def best_weighting(*, sum_to_one: bool) -> Weighting:
    """Minimise t over w ≥ 0 with Σ w·low ≤ Avg + ½ digit + t and Σ w·high ≥ Avg − ½ digit − t for every model.

    A miss of 0 would mean that some weighting of the columns, as they were before rounding, gives Avg.

    Args:
      sum_to_one: whether the weights must be those of a mean.
    """
    low, high, average = columns_as_scores()
    slack = -np.ones((len(average), 1))
    found = optimize.linprog(
        np.eye(low.shape[1] + 1)[-1],
        A_ub=np.block([[low, slack], [-high, slack]]),
        b_ub=np.concatenate([average + SHARE_ROUNDING, SHARE_ROUNDING - average]),
        A_eq=np.append(np.ones(low.shape[1]), 0)[None] if sum_to_one else None,
        b_eq=np.ones(1) if sum_to_one else None,
    )
    return Weighting(weights=found.x[:-1], miss=float(found.x[-1]))


def perfect_average() -> float:
    """The greatest Avg that a perfect model could have under any weights w ≥ 0 that give every printed Avg, 100 Σ w.

    A mean would give 100.

    Raises:
      ValueError: no weights give every Avg.
    """
    low, high, average = columns_as_scores()
    found = optimize.linprog(
        -np.ones(low.shape[1]),
        A_ub=np.concatenate([low, -high]),
        b_ub=np.concatenate([average + SHARE_ROUNDING, SHARE_ROUNDING - average]),
    )
    if found.status != 0:
        raise ValueError(f"MAIN allows no weights: {found.message}; ask for `best_weighting` instead")
    return -100.0 * float(found.fun)


def error_and_distance() -> dict[str, tuple[float, float]]:
    """1 − mean accuracy of the ordinal attributes, and OMAE, of every row that has both; OMAE is never the lesser."""
    rows = {name: (1 - math.fsum(row[:3]) / 300, row[4]) for name, (row, _) in paper.MAIN.items()}
    for name, (row, _) in paper.PER_ATTRIBUTE.items():
        rows[f"{name} (ablation)"] = (1 - math.fsum(row[:3]) / 300, paper.LADDER[name][0])
    return rows


def impossible_distances() -> list[str]:
    """Rows whose OMAE, granted its rounding, is below the share of wrong answers."""
    return [
        name
        for name, (error, omae) in error_and_distance().items()
        if omae + LEVEL_ROUNDING < error - SHARE_ROUNDING / 100
    ]


def gain_interval(ours: float, theirs: float, items: int) -> tuple[float, float, float]:
    """Difference of two shares in percent on n items each, the half width of its 95 % interval, two-sided p.

    Unpaired, since the answers are not published: p̂₁ − p̂₂ ± 1.96 √(Σ p̂(1 − p̂)/n), p with the pooled share.
    """
    p, q = ours / 100, theirs / 100
    pooled = (p + q) / 2
    half = 1.96 * math.sqrt((p * (1 - p) + q * (1 - q)) / items)
    z = (p - q) / math.sqrt(2 * pooled * (1 - pooled) / items)
    return ours - theirs, 100 * half, float(2 * special.ndtr(-abs(z)))


def attainable(share: float, items: int) -> bool:
    """Whether k/n, rounded or cut off to one decimal, prints as this percentage for some k.

    Source: Brown and Heathers, The GRIM test, Soc. Psychol. Personal. Sci. 8 (2017).
    """
    near = round(share * items / 100)
    return any(
        share - SHARE_ROUNDING - 1e-9 <= 100 * k / items < share + 2 * SHARE_ROUNDING - 1e-9
        for k in (near - 1, near, near + 1)
    )
