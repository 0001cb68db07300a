"""How levels that were answered relate to the true ones: confusions, reliability, and what agreement says of both."""

import dataclasses
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.core.charts import LOOK, MARKERS, colours, svg
from experiments.core.results import Cell, Column, Table
from experiments.core.text import interval
from touchr1_jax.bench.metrics import BOTTOM
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap

RESAMPLES = 1_000
"""Of each interval over objects; its ends are then good to a tenth of its width."""

Words = Mapping[str, Sequence[str]]
"""Attribute → what its levels are called, in order."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Levels:
    """Answers of one policy, its seeds one after the other.

    Attributes:
      answer: int [N, A], `BOTTOM` where nothing could be read.
      label: int [N, A], `BOTTOM` where not asked.
      objects: [N], the object of each question.
      agree: int [N, A], how many sensors, asked alone, say what all of them together say; `None` if nobody asked.
    """

    answer: np.ndarray
    label: np.ndarray
    objects: np.ndarray
    agree: np.ndarray | None = None


def confusion_chart(rows: Mapping[str, Levels], words: Words) -> bytes:
    """One panel per policy and attribute: the share of each answer among the questions with one label.

    Args:
      rows: policy → answers; attribute a of them is the a-th of `words`.
      words: attribute → levels.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(2.75 * len(words), 2.3 * len(rows)), layout="constrained")
        panels = figure.subplots(len(rows), len(words), squeeze=False)
        for line, (name, said) in zip(panels, rows.items(), strict=True):
            for a, (attribute, levels) in enumerate(words.items()):
                draw_confusion(line[a], said.answer[:, a], said.label[:, a], levels)
                line[a].set_title(f"{name}: {attribute}", fontsize=9, loc="left")
        return svg(figure)


def draw_confusion(axes: Axes, answer: np.ndarray, label: np.ndarray, levels: Sequence[str]) -> None:
    """Labels down, answers across, shares of a row in per cent; a last column where some answer could not be read.

    Args:
      axes: to draw into.
      answer, label: int [N].
      levels: what they are called.
    """
    asked = label != BOTTOM
    columns = [*levels, "unread"] if np.any(answer[asked] == BOTTOM) else list(levels)
    count = np.zeros((len(levels), len(levels) + 1), int)
    np.add.at(count, (label[asked], answer[asked]), 1)  # an unread answer, −1, falls into the last column
    count = count[:, : len(columns)]
    share = count / np.maximum(count.sum(1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in np.ndindex(*count.shape):
        axes.text(j, i, f"{share[i, j]:.0%}\n{count[i, j]}", ha="center", va="center", fontsize=7.5,
                  color="white" if share[i, j] > 0.55 else "black")  # fmt: skip
    axes.set_xticks(range(len(columns)), columns, fontsize=8 if len(columns) == len(levels) else 6.5)
    axes.set_yticks(range(len(levels)), levels, fontsize=8)
    axes.set(xlabel="answered", ylabel="label")
    axes.grid(visible=False)


def reliability_table(rows: Mapping[str, Levels], words: Words) -> Table:
    """Of every level: how often it is answered, how often that is right, and how often it is found where it is true."""
    lines: list[tuple[Cell, ...]] = []
    for name, said in rows.items():
        for a, (attribute, levels) in enumerate(words.items()):
            asked = said.label[:, a] != BOTTOM
            answer, label, objects = said.answer[asked, a], said.label[asked, a], said.objects[asked]
            for k, level in enumerate(levels):
                right = _share(label == k, answer == k, objects)
                found = _share(answer == k, label == k, objects)
                lines.append((f"{name}: {attribute} {level}", 100 * float(np.mean(answer == k)), right, found))
    return Table(
        title="Reliability of the levels",
        columns=(
            Column(name="policy and level"),
            Column(name="answered", unit="%", format=".1f", meaning="of all questions about the attribute"),
            Column(name="right when answered", unit="%", meaning="95 % over objects"),
            Column(name="found where true", unit="%", meaning="95 % over objects"),
        ),
        rows=tuple(lines),
        note="An answer that favours a level finds it often and is right about it seldom.",
    )


def trust_chart(rows: Mapping[str, Levels]) -> bytes:
    """Share of right answers over the number of sensors that, asked alone, say the same; areas are shares of answers.

    Args:
      rows: policy → answers whose `agree` is known.
    """
    colour = colours(rows)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.6, 3.6), layout="constrained")
        axes = figure.add_subplot()
        for i, (name, said) in enumerate(rows.items()):
            counts, right, weight = trust(said)
            shift = 0.06 * (i - (len(rows) - 1) / 2)
            x = np.array(counts) + shift
            axes.plot(x, [r.mean for r in right], color=colour[name], lw=1.3, label=name)
            axes.vlines(x, [r.low for r in right], [r.high for r in right], color=colour[name], lw=1, alpha=0.6)
            axes.scatter(
                x, [r.mean for r in right], s=12 + 300 * weight, color=colour[name], marker=MARKERS[i % len(MARKERS)]
            )
        axes.set(xlabel="sensors that, asked alone, say the same", ylabel="right (%)", ylim=(0, 100))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        figure.legend(loc="outside right upper")
        return svg(figure)


def trust(said: Levels) -> tuple[list[int], list[Interval], np.ndarray]:
    """Of each number of agreeing sensors: the share of right answers with its interval, and its share of all answers.

    Raises:
      ValueError: no sensor was asked alone.
    """
    if said.agree is None:
        raise ValueError("agree is None: trust needs answers of single sensors; ask each sensor alone")
    read = (said.label != BOTTOM) & (said.answer != BOTTOM)
    objects = np.broadcast_to(said.objects[:, None], read.shape)[read]
    agree, right = said.agree[read], (said.answer == said.label)[read]
    counts, intervals, weight = [], [], []
    for count in np.unique(agree):
        at = agree == count
        if len(np.unique(objects[at])) > 1:
            counts.append(int(count))
            intervals.append(clustered_bootstrap(100.0 * right[at], objects[at], resamples=RESAMPLES))
            weight.append(float(np.mean(at)))
    return counts, intervals, np.array(weight)


def _share(hit: np.ndarray, of: np.ndarray, objects: np.ndarray) -> str | None:
    """Per cent of `hit` among `of`, with its interval; nothing where fewer than two objects are left."""
    if len(np.unique(objects[of])) < 2:
        return None
    return interval(clustered_bootstrap(100.0 * hit[of], objects[of], resamples=RESAMPLES), ".1f")
