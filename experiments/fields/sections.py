"""Sections of a report on fields: the figures, tables and pictures that answer one question."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.core.results import Picture, Requirement, Results, Table


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldSection:
    """Sentences, requirements, tables and pictures of one question."""

    verdict: tuple[str, ...] = ()
    requirements: tuple[Requirement, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()


def joined(sections: Sequence[FieldSection], settings: Mapping[str, Any], data: Mapping[str, Any] = {}) -> Results:
    """Results of all sections in their order."""
    return Results(
        verdict=tuple(sentence for section in sections for sentence in section.verdict),
        requirements=tuple(r for section in sections for r in section.requirements),
        tables=tuple(table for section in sections for table in section.tables),
        pictures=tuple(picture for section in sections for picture in section.pictures),
        settings=settings,
        data=data,
    )
