"""Whoever reads along with a run: told of every logged line and of every loop, as they come."""

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.core.progress import Loop


class Watcher:
    """Does nothing; a subclass overrides what it has a use for."""

    def rewound(self, stage: str, step: int) -> None:
        """The lines of a stage at or past a step are dropped; every stage is rewound before its first line."""

    def logged(self, stage: str, step: int, scalars: Mapping[str, Any]) -> None:
        """A line stands in `metrics.jsonl`; `scalars` are in JSON's types."""

    def looping(self, loops: Sequence[Loop]) -> None:
        """A loop began, went on or ended; those that are open, the outermost first."""

    def closed(self) -> None:
        """The session is over; nothing more comes."""
