"""The architecture picture, drawn from the imports.

    make picture

writes `experiments/figures/architecture.svg`.  A part stands right above the highest part that it imports; a line is
an import that does not follow from the others.
"""

import dataclasses
import html
import itertools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from experiments.core.artifacts import write_text
from experiments.core.charts import PALETTE
from experiments.core.imports import condensed, part_graph, reduced, rows, within
from experiments.core.runs import NoCheckoutError, checkout

PICTURE = Path("experiments/figures/architecture.svg")
"""Relative to the checkout."""

COLOUR = {"touchr1_jax": PALETTE[0], "sensors_io": PALETTE[2], "experiments": PALETTE[1]}

SWEEPS = 8
"""Passes up and down that order the parts of a row; it settles after four."""

CHARACTER, PADDING, HEIGHT, GAP, ROW, MARGIN, HEAD = 7.0, 20.0, 28.0, 14.0, 62.0, 22.0, 40.0
"""In pixels: a character, what a box has beside its text, a box, between boxes, between rows, around, of a title."""

THREAD = "~"
"""Begins the names of places that belong to a line."""

Point = tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Panel:
    """One package: its size, where its parts stand, px from its upper left corner, and the points of every line."""

    package: str
    centre: Mapping[str, Point]
    lines: Sequence[Sequence[Point]]
    size: Point


def draw(root: Path) -> str:
    """The picture as SVG text; the same imports give the same text.

    Args:
      root: the folder that the packages lie in.
    """
    graph = part_graph(root)
    left, right = (layout(p, condensed(within(graph, p))) for p in ("touchr1_jax", "sensors_io"))
    across, between = MARGIN * 3 + left.size[0] + right.size[0], ROW
    top = layout("experiments", condensed(within(graph, "experiments")), least=across - 2 * MARGIN)
    panels = {panel.package: panel for panel in (left, right, top)}
    width = top.size[0] + 2 * MARGIN
    lower = MARGIN + top.size[1] + between
    height = lower + max(left.size[1], right.size[1]) + MARGIN
    places = {
        "experiments": (MARGIN, MARGIN),
        "touchr1_jax": ((width - across) / 2 + MARGIN, lower),
        "sensors_io": ((width - across) / 2 + 2 * MARGIN + left.size[0], lower),
    }
    used = {part: {name.split(".")[0] for name in names} for part, names in graph.items()}
    body = [_panel(panels[package], places[package], used) for package in COLOUR]
    arrows = [
        _arrow((places[p][0] + panels[p].size[0] / 2, lower - between + 3), lower - 5, COLOUR[p])
        for p in ("touchr1_jax", "sensors_io")
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" font-size="12" '
        'font-family="ui-monospace, SFMono-Regular, Menlo, Consolas, monospace">\n'
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="white"/>\n' + "\n".join([*body, *arrows]) + "\n</svg>\n"
    )


def layout(package: str, graph: Mapping[str, frozenset[str]], least: float = 0.0) -> Panel:
    """Rows by what imports what, the lowest at the bottom; each row ordered to lie near what it is joined to.

    A line that spans several rows has a place of its own in each, so that it runs between the boxes.

    Args:
      package: whose parts.
      graph: part → parts that it imports, acyclic.
      least: width of the panel, px, where its rows need no more.
    """
    stack = rows(graph)
    level = {part: i for i, row in enumerate(stack) for part in row}
    chains = [_chain(p, q, level) for p, names in reduced(graph).items() for q in sorted(names)]
    for chain in chains:
        for step, place in enumerate(chain[1:-1], 1):
            stack[level[chain[0]] - step].append(place)
    centre = _ordered(stack, chains, max(*(_needed(row) for row in stack), least - 2 * MARGIN))
    height = {place: len(stack) - 1 - i for i, row in enumerate(stack) for place in row}
    points = {place: (MARGIN + x, HEAD + HEIGHT / 2 + height[place] * ROW) for place, x in centre.items()}
    size = (max(*map(_needed, stack), least - 2 * MARGIN) + 2 * MARGIN, HEAD + (len(stack) - 1) * ROW + HEIGHT + MARGIN)
    return Panel(
        package=package,
        centre={part: points[part] for part in graph},
        lines=[[points[place] for place in chain] for chain in chains],
        size=size,
    )


def _chain(part: str, other: str, level: Mapping[str, int]) -> list[str]:
    """The places of a line from a part to one that it imports, one in each row; those between are its own."""
    between = range(level[part] - 1, level[other], -1)
    return [part, *(f"{THREAD}{part} {other} {i}" for i in between), other]


def _ordered(stack: Sequence[list[str]], chains: Sequence[Sequence[str]], width: float) -> dict[str, float]:
    """Sort every row by the mean place of what its members are joined to; their centres, px from the left."""
    joined: dict[str, list[str]] = {place: [] for row in stack for place in row}
    for a, b in (pair for chain in chains for pair in itertools.pairwise(chain)):
        joined[a].append(b)
        joined[b].append(a)
    centre = {place: x for row in stack for place, x in _spread(row, width).items()}
    for sweep in range(SWEEPS):
        for row in stack if sweep % 2 == 0 else stack[::-1]:
            row.sort(key=lambda p: (sum(centre[q] for q in joined[p]) / max(len(joined[p]), 1), p))
            centre |= _spread(row, width)
    return centre


def _needed(row: Sequence[str]) -> float:
    return sum(map(_width, row)) + GAP * (len(row) - 1)


def _spread(row: Sequence[str], width: float) -> dict[str, float]:
    """Centres of the boxes of a row, px from the left, spread over the width."""
    free = (width - sum(map(_width, row))) / len(row)
    centres, x = {}, free / 2
    for part in row:
        centres[part] = x + _width(part) / 2
        x += _width(part) + free
    return centres


def _width(place: str) -> float:
    return 0.0 if place.startswith(THREAD) else len(place) * CHARACTER + PADDING


def _panel(panel: Panel, place: Point, used: Mapping[str, set[str]]) -> str:
    colour = COLOUR[panel.package]
    lines = [_line(points, colour) for points in panel.lines]
    boxes = [_box(part, centre, colour) for part, centre in panel.centre.items()]
    dots = [d for part, centre in panel.centre.items() for d in _dots(panel.package, part, centre, used)]
    title = f'<text x="{MARGIN:.0f}" y="24" font-size="15" font-weight="bold" fill="{colour}">{panel.package}</text>'
    legend = [_legend(panel.size[0])] if panel.package == "experiments" else []
    frame = (
        f'<rect width="{panel.size[0]:.1f}" height="{panel.size[1]:.1f}" rx="10" fill="{colour}" fill-opacity=".06" '
        f'stroke="{colour}" stroke-opacity=".4"/>'
    )
    inside = "\n".join([frame, title, *legend, *lines, *boxes, *dots])
    return f'<g transform="translate({place[0]:.1f} {place[1]:.1f})">\n{inside}\n</g>'


def _line(points: Sequence[Point], colour: str) -> str:
    """A curve from the lower edge of the first box to the upper edge of the last, upright at every point."""
    (x, y), (end_x, end_y) = points[0], points[-1]
    through = [(x, y + HEIGHT / 2), *points[1:-1], (end_x, end_y - HEIGHT / 2)]
    path = f"M{through[0][0]:.1f} {through[0][1]:.1f}"
    for (x0, y0), (x1, y1) in itertools.pairwise(through):
        middle = (y0 + y1) / 2
        path += f"C{x0:.1f} {middle:.1f} {x1:.1f} {middle:.1f} {x1:.1f} {y1:.1f}"
    return f'<path d="{path}" fill="none" stroke="{colour}" stroke-opacity=".55" stroke-width="1.3"/>'


def _box(part: str, centre: Point, colour: str) -> str:
    x, y, width = centre[0], centre[1], _width(part)
    return (
        f'<rect x="{x - width / 2:.1f}" y="{y - HEIGHT / 2:.1f}" width="{width:.1f}" height="{HEIGHT:.0f}" rx="5" '
        f'fill="white" stroke="{colour}"/>'
        f'<text x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle" fill="#20262e">{html.escape(part)}</text>'
    )


def _dots(package: str, part: str, centre: Point, used: Mapping[str, set[str]]) -> list[str]:
    """One dot for each other package that a part of `experiments` imports."""
    if package != "experiments":
        return []
    names = {name for member in part.split(" + ") for name in used[f"{package}.{member}"]}
    others = [p for p in COLOUR if p != package and p in names]
    x = centre[0] + _width(part) / 2 - 4
    return [
        f'<circle cx="{x - 9 * i:.1f}" cy="{centre[1] - HEIGHT / 2:.1f}" r="3.6" fill="{COLOUR[p]}"/>'
        for i, p in enumerate(others)
    ]


def _legend(width: float) -> str:
    words = "".join(
        f'<tspan fill="{COLOUR[p]}">  ●</tspan><tspan fill="#4d5560"> imports {p}</tspan>'
        for p in ("touchr1_jax", "sensors_io")
    )
    return f'<text x="{width - MARGIN:.1f}" y="24" text-anchor="end">{words}</text>'


def _arrow(start: Point, end: float, colour: str) -> str:
    x, y = start
    return (
        f'<path d="M{x:.1f} {y:.1f}V{end - 9:.1f}" stroke="{colour}" stroke-width="3"/>'
        f'<path d="M{x - 7:.1f} {end - 10:.1f}h14l-7 10z" fill="{colour}"/>'
    )


def main() -> int:
    """Draw the picture of this checkout; returns the exit status."""
    try:
        root = checkout()
    except NoCheckoutError as error:
        Console(stderr=True, soft_wrap=True).print(str(error), markup=False, highlight=False)
        return 1
    write_text(root / PICTURE, draw(root))
    Console().print(str(PICTURE), markup=False, highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
