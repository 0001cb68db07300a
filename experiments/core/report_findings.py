"""The self-contained report of a measuring experiment: requirements, tables, pictures in one HTML file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.core.artifacts import write_bytes, write_text
from experiments.core.findings import Cell, Column, Findings, Picture, Requirement, Table
from experiments.core.page import Html, document, image, row, table, tag
from experiments.core.report_parts import appendix, data_and_time, header, number

MEDIA = {"svg": "svg+xml", "png": "png"}

LONG = 80
"""Characters of a cell beyond which it is given room: in a narrow column a paragraph is a tower."""


def write_findings(directory: Path, findings: Findings, *, about: str, description: Mapping[str, Any]) -> Path:
    """Write `report.html` and `plots/*` of a run and return the path of the report.

    Args:
      directory: the run's.
      about: docstring of the experiment; its first line is the question.
      description: content of the run's `config.json`.
    """
    question, _, rest = about.strip().partition("\n")
    page = document(
        f"{description['experiment']} · {description['scale']}",
        header(question, rest.strip(), description, findings.settings, findings.verdict),
        requirement_section(findings.requirements),
        *[picture_section(directory, p) for p in findings.pictures],
        *[table_section(t) for t in findings.tables],
        data_and_time(findings.data, findings.timing),
        appendix(description),
    )
    path = directory / "report.html"
    write_text(path, page)
    return path


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
