"""Sections of a report on fields, each a list of parts: sentences of the verdict, requirements, tables, pictures."""

from collections.abc import Iterable, Mapping
from typing import Any

from experiments.core.results import Picture, Requirement, Results, Table

ReportPart = str | Requirement | Table | Picture


def assemble(parts: Iterable[ReportPart], settings: Mapping[str, Any], data: Mapping[str, Any] = {}) -> Results:
    """Results of parts; those of one kind keep their order."""
    every = tuple(parts)
    return Results(
        verdict=tuple(part for part in every if isinstance(part, str)),
        requirements=tuple(part for part in every if isinstance(part, Requirement)),
        tables=tuple(part for part in every if isinstance(part, Table)),
        pictures=tuple(part for part in every if isinstance(part, Picture)),
        settings=settings,
        data=data,
    )
