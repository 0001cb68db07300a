"""The aggregate scores of the two benches; both refuse to average over a metric that is missing."""

import math
from collections.abc import Mapping

AVERAGED = ("h_acc", "r_acc", "p_acc", "mat_acc", "omae", "l2_em", "sfd", "soi_rho", "csc")
"""Metrics that the average of the touch bench is made of."""

VTV = ("hardness", "protrusion", "elasticity", "friction", "combined", "sfd", "soi", "osc", "tsa")
"""The nine tasks of the VTV protocol, each a share of exact matches in percent.

`combined` is all four attributes right; `soi` picks the most or the least of three (chance 33), `osc` matches three
recordings to three names (chance 16.7), `tsa` chooses one of two scenarios (chance 50).
"""

WORST_OMAE = 2.0
"""Levels between the ends of a scale of three."""


def touch_average(metrics: Mapping[str, float]) -> float:
    """Avg = mean(H, R, P, Mat, 100(1 − OMAE/2), L2-EM, SFD, 100·max(ρ, 0), CSC), 0 to 100.

    The paper prints an Avg whose formula it does not give, and no weighting of its columns reproduces it; this one is
    ours and must not be compared with it.

    Args:
      metrics: `AVERAGED` → value, shares in percent, OMAE in levels, ρ in −1..1.

    Raises:
      ValueError: a metric that is missing or not finite.
    """
    values = _require(metrics, AVERAGED)
    values["omae"] = 100 * (1 - values["omae"] / WORST_OMAE)
    values["soi_rho"] = 100 * max(values["soi_rho"], 0.0)
    return math.fsum(values.values()) / len(values)


def vtv_average(metrics: Mapping[str, float]) -> float:
    """Plain mean of the nine tasks, percent.

    Args:
      metrics: `VTV` → percent.

    Raises:
      ValueError: a task that is missing or not finite.

    Source: the VTV-LLM protocol; the paper's table has the same mean to its rounding.
    """
    return math.fsum(_require(metrics, VTV).values()) / len(VTV)


def _require(metrics: Mapping[str, float], names: tuple[str, ...]) -> dict[str, float]:
    missing = [name for name in names if name not in metrics or not math.isfinite(metrics[name])]
    if missing:
        raise ValueError(
            f"metrics lacks {', '.join(missing)}: an average needs all of {', '.join(names)}; measure them, or report "
            "the others on their own"
        )
    return {name: metrics[name] for name in names}
