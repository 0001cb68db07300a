"""An experiment from its config to its report, small enough for a test."""

import dataclasses
from pathlib import Path
from types import ModuleType
from typing import Any

from experiments.core.runner import run_experiment


def run_shrunk(module: ModuleType, config: Any, home: Path, *arguments: str) -> Path:
    """Run `module.EXPERIMENT` with `config` in place of its default one; its one run directory under `home`."""
    small = dataclasses.replace(module.EXPERIMENT, config=config)
    assert run_experiment(small, ["--runs-dir", str(home), *arguments], module.__doc__) == 0
    return only_run(home, small.name)


def only_run(home: Path, name: str) -> Path:
    """The one run directory of an experiment; next to it lies a link to the latest."""
    (directory,) = (path for path in (home / name).iterdir() if not path.is_symlink())
    return directory
