"""TensorBoard's event files of a run, a folder for every stage.

python -m experiments NAME --tensorboard
tensorboard --logdir runs/NAME/latest/events
"""

import importlib
import importlib.util
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.core.progress import Watcher

PACKAGE = "tensorboardX"

HINT = (
    f"--tensorboard needs the package {PACKAGE}, which is not installed: "
    "pip install 'touchr1-jax[tensorboard]', or leave the flag out"
)

FLUSH_S = 10
"""Seconds until a line is on the disk."""


def installed() -> bool:
    """True if event files can be written."""
    return importlib.util.find_spec(PACKAGE) is not None


class Events(Watcher):
    """Writes every number of every logged line.

    A continued stage gets one more file, whose first event makes TensorBoard drop the events of the last session at or
    past its step.  Events have a time, lines of `metrics.jsonl` do not.

    Args:
      folder: a folder for each stage is made in it.

    Raises:
      ModuleNotFoundError: tensorboardX is not installed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._make = importlib.import_module(PACKAGE).SummaryWriter
        self._writers: dict[str, Any] = {}

    def rewound(self, stage: str, step: int) -> None:
        """Begin a file of the stage."""
        if stage in self._writers:
            self._writers[stage].close()
        self._writers[stage] = self._make(
            str(self._folder / stage),
            purge_step=step,
            flush_secs=FLUSH_S,
            filename_suffix=f".{time.time_ns()}",  # two files of one second would be one
        )

    def logged(self, stage: str, step: int, scalars: Mapping[str, Any]) -> None:
        """Write the numbers among the scalars."""
        for name, value in scalars.items():
            if isinstance(value, int | float):
                self._writers[stage].add_scalar(name, value, step)

    def closed(self) -> None:
        """Write what is left and close the files."""
        for writer in self._writers.values():
            writer.close()
