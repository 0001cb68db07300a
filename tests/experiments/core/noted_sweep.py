"""A sweep whose workers note when they begin and end a unit: `python -m` this module, then the words after `sweep`."""

import os
import sys
from pathlib import Path

from experiments.core import sweep

NOTES = "attempts.txt"
"""File in the folder of a sweep: of each beginning and each end the unit's hash and the worker's process."""

_run_unit = sweep._run_unit


def run_noted(name: str, package: str, unit: sweep.SweepUnit) -> None:
    """Run a unit between two notes."""
    _note(unit, "begin")
    _run_unit(name, package, unit)
    _note(unit, "end")


def _note(unit: sweep.SweepUnit, what: str) -> None:
    with (unit.home.parent / NOTES).open("a") as file:
        file.write(f"{unit.digest} {os.getpid()} {what}\n")


def attempts(folder: Path) -> list[tuple[str, int, bool]]:
    """Hash, process, and whether it came to its end, of every attempt so far."""
    path = folder / NOTES
    lines = [line.split() for line in path.read_text().splitlines()] if path.exists() else []
    ended = {(unit, pid) for unit, pid, what in lines if what == "end"}
    return [(unit, int(pid), (unit, pid) in ended) for unit, pid, what in lines if what == "begin"]


if __name__ == "__main__":
    from tests.experiments.core import noted_sweep  # workers import it by this name

    sweep._run_unit = noted_sweep.run_noted
    sys.exit(sweep.main(sys.argv[1:]))
