"""Sections of a report: requirements, tables, pictures."""

from collections.abc import Sequence
from pathlib import Path

from experiments.core.artifacts import write_bytes
from experiments.core.page import Html, image, row, table, tag
from experiments.core.results import Cell, Column, Picture, Requirement, Table
from experiments.core.text import number

MEDIA = {"svg": "svg+xml", "png": "png"}

LONG = 80
"""Characters of a cell beyond which it is given room: in a narrow column a paragraph is a tower."""


def requirement_section(requirements: tuple[Requirement, ...]) -> Html:
    """Figures against their bounds; empty where there are none."""
    if not requirements:
        return Html("")
    sign = {"lower": "≤", "higher": "≥"}
    rows = [
        row(
            r.name,
            tag("b" if r.met else "span", f"{number(r.measured, '.4g')} {r.unit}".strip()),
            f"{sign[r.better]} {number(r.bound, '.4g')} {r.unit}".strip(),
            "met" if r.met else "NOT MET",
            tag("td", r.note, class_="text"),
            head=1,
        )
        for r in requirements
    ]
    head = ["Requirement", "measured", "bound", "", tag("th", "How", class_="text")]
    return tag("section", tag("h2", "Requirements"), table(head, rows))


def picture_section(directory: Path, picture: Picture) -> Html:
    """A picture under its title, and its file in the run's `plots/`."""
    write_bytes(directory / "plots" / f"{picture.name}.{picture.kind}", picture.content)
    shown = image(picture.content, MEDIA[picture.kind], picture.title)
    return tag("section", tag("h2", picture.title), tag("figure", shown, tag("figcaption", picture.caption)))


def table_section(shown: Table) -> Html:
    """A table under its title, with what its columns mean."""
    head = [_head(c, [cells[i] for cells in shown.rows]) for i, c in enumerate(shown.columns)]
    rows = [
        row(*(_cell(value, c.format) for value, c in zip(cells, shown.columns, strict=True)), head=1)
        for cells in shown.rows
    ]
    meanings = [tag("p", f"{c.name}: {c.meaning}.", class_="note") for c in shown.columns if c.meaning]
    return tag(
        "section",
        tag("h2", shown.title),
        tag("p", shown.note, class_="note") if shown.note else "",
        table(head, rows),
        tag("details", tag("summary", "What the columns mean", class_="note"), *meanings) if meanings else "",
    )


def _head(column: Column, cells: Sequence[Cell]) -> Html | str:
    """The name of a column over its cells: on the left where they are text."""
    name = f"{column.name} ({column.unit})" if column.unit else column.name
    text = any(isinstance(cell, str) for cell in cells)
    return tag("th", name, class_="text") if text else name


def _cell(value: Cell, spec: str) -> Html | str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return tag("td", value, class_="text long" if len(value) > LONG else "text")
    return number(value, spec if isinstance(value, float) else ",")
