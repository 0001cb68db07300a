"""Training curves of a run, and accuracy against the rate of middle answers, as SVG."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.look import MARKERS, SHARED, Mark, marks
from experiments.core.results import Estimate
from touchr1_jax.bench.metrics import METRICS

MOST_POINTS = 160  # of a drawn line: a panel is as many points wide

POINTS_OF_CHART = 25_000
"""Of all lines of a chart, so that its SVG stays under a megabyte; a line keeps at least `FEWEST_POINTS`."""

FEWEST_POINTS = 25

WORDS = {
    "degenerate_share": "groups whose rewards are all equal",
    "echo_share": "share of answers with one level in all slots",
    "entropy": "entropy (nat a token)",
    "grounding": "KL to the answers without a stream (nat)",
    "held_out": "score on validation objects",
    "kl": "KL to the reference (nat a token)",
    "length": "length (tokens)",
    "middle_rate": "share of middle levels",
    "mode_share": "share of the commonest level",
    "parse_rate": "share of readable answers",
}
"""Scalar → its name in a chart, where the words in that of the log say too little."""

OF_TEXT = {"sft", "decoder", "blind"}
"""Phases whose loss is that of the tokens of answers; losses of other phases have units of their own."""

Curve = tuple[np.ndarray, np.ndarray]  # steps and values of one logged scalar of one stage


def curves_by_phase(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[tuple[str, str], Curve]]]:
    """Sort logged lines into phase → scalar → (arm, seed) → curve; the arm is empty where the stage names none.

    Of several lines with one step the last counts.
    """
    points: dict[str, dict[str, dict[tuple[str, str], dict[int, float]]]] = {}
    for line in rows:
        phase, *middle = line["stage"].split("/")
        seed = middle.pop() if middle else "0"
        for name, value in line.items():
            if name not in ("stage", "step") and isinstance(value, int | float):
                series = points.setdefault(phase, {}).setdefault(name, {})
                series.setdefault(("/".join(middle), seed), {})[line["step"]] = float(value)
    curve = lambda found: (np.array(sorted(found)), np.array([found[step] for step in sorted(found)]))
    return {
        phase: {name: {key: curve(found) for key, found in series.items()} for name, series in scalars.items()}
        for phase, scalars in points.items()
    }


class PhaseCurves(NamedTuple):
    """Training curves of one phase: the chart, the scalars in it, and how many logged ones are not in it."""

    svg: bytes
    names: tuple[str, ...]
    undrawn: int


def draw_phases(
    rows: Sequence[Mapping[str, Any]],
    wanted: Mapping[str, Sequence[str]],
    mark: Mapping[str, Mark] | None = None,
    *,
    most: int | None = None,
) -> dict[str, PhaseCurves]:
    """Draw the training curves in logged lines by phase.

    Args:
      wanted: phase → scalars to draw; of a phase that is not named all, or the first `most`.
      mark: that of each arm; by default in the order of their first line.
    """
    drawn = {}
    for phase, scalars in curves_by_phase(rows).items():
        names = tuple(name for name in wanted.get(phase, tuple(scalars)[:most]) if name in scalars)
        if names:
            shown = {name: scalars[name] for name in names}
            arms = dict.fromkeys(arm for series in shown.values() for arm, _ in series if arm)
            svg = training_curves(shown, marks(arms) if mark is None else mark, phase)
            drawn[phase] = PhaseCurves(svg, names, len(scalars) - len(names))
    return drawn


def training_curves(
    scalars: Mapping[str, Mapping[tuple[str, str], Curve]], mark: Mapping[str, Mark], phase: str = ""
) -> bytes:
    """Draw one panel per scalar: a thin line per seed, a bold one for the running mean over the seeds of an arm."""
    columns = min(3, len(scalars))
    lines = sum(len(series) + len({arm for arm, _ in series}) for series in scalars.values())
    most = min(MOST_POINTS, max(FEWEST_POINTS, POINTS_OF_CHART // lines))
    words = {**WORDS, "loss": "loss (nat a token)"} if phase in OF_TEXT else WORDS
    panels = [
        Panel(
            _seeds_and_means(series, mark, most),
            title=words.get(name, name.replace("_", " ")),
            x_label="step" if i >= len(scalars) - columns else "",
        )
        for i, (name, series) in enumerate(scalars.items())
    ]
    return draw(panels, size=(3.35 * columns, 0.35 + 2.15 * math.ceil(len(scalars) / columns)))


def _seeds_and_means(series: Mapping[tuple[str, str], Curve], mark: Mapping[str, Mark], most: int) -> list[Series]:
    """All thin lines first, so that no seed covers a mean; a line has at most `most` points."""
    seeds, means = [], []
    for arm in dict.fromkeys(arm for arm, _ in series):
        curves = [curve for (a, _), curve in series.items() if a == arm]
        own = mark.get(arm, Mark(SHARED))
        look: dict[str, Any] = {"colour": own.colour, "line": own.line, "marker": ""}
        seeds += [Series(x=thin(x, most), y=thin(y, most), width=0.6, alpha=0.25, **look) for x, y in curves]
        common = np.array(sorted(set.intersection(*(set(steps.tolist()) for steps, _ in curves))))
        if len(common):
            mean = running_mean(np.mean([values[np.isin(steps, common)] for steps, values in curves], axis=0))
            marker = "o" if len(common) == 1 else ""
            look = {**look, "marker": marker, "width": 1.8}
            means.append(Series(arm, x=thin(common, most), y=thin(mean, most), **look))
    return seeds + means


def thin(values: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of the values [n], evenly spaced and the last among them, so that a chart stays small."""
    stride = -(-len(values) // most)
    return values[::-1][:: max(stride, 1)][::-1]


def accuracy_against_middle(
    arms: Mapping[str, Mapping[str, Estimate]],
    baselines: Mapping[str, Mapping[str, Estimate]],
    mark: Mapping[str, Mark],
) -> bytes | None:
    """Draw accuracy over the rate of middle answers: a small dot per seed, a large mean; `None` if not measured."""
    series = []
    for name, row in arms.items():
        own = mark.get(name, Mark(SHARED))
        series += _point(name, row, own.colour, own.marker)
    for (name, row), marker in zip(baselines.items(), itertools.cycle(MARKERS[1:]), strict=False):
        series += _point(name, row, SHARED, marker)
    x_label, y_label = f"{METRICS['middle_rate'].meaning} (%)", f"{METRICS['acc'].title} (%)"
    return draw([Panel(series, x_label=x_label, y_label=y_label)], size=(6.6, 3.2)) if series else None


def _point(name: str, row: Mapping[str, Estimate], colour: str, marker: str) -> list[Series]:
    if "acc" not in row or "middle_rate" not in row:
        return []
    middle, acc = row["middle_rate"], row["acc"]
    look: dict[str, Any] = {"colour": colour, "marker": marker, "line": ""}
    seeds = Series(x=middle.per_seed, y=acc.per_seed, size=14, alpha=0.4, **look)
    mean = Series(name, x=[middle.mean], y=[acc.mean], low=[acc.low], high=[acc.high], size=62, **look)
    return [seeds, mean] if len(acc.per_seed) > 1 else [mean]


def running_mean(values: np.ndarray) -> np.ndarray:
    """Centred mean of values [n] over a twentieth of them, the window cut off at the ends."""
    half = len(values) // 40
    total = np.concatenate([[0.0], np.cumsum(values)])
    low = np.maximum(np.arange(len(values)) - half, 0)
    high = np.minimum(np.arange(len(values)) + half + 1, len(values))
    return (total[high] - total[low]) / (high - low)
