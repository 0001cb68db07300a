"""What each part of the chart of fields hands in."""

import dataclasses

from experiments.core.results import Picture, Requirement, Table


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldSection:
    """Requirements, tables and pictures of one field, and what they say."""

    verdict: tuple[str, ...] = ()
    requirements: tuple[Requirement, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
