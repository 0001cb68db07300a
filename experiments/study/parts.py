"""The policies of a study as units of work: workers train them into the cache, from which the study takes them."""

import contextlib
import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from experiments.core import numerics, runs
from experiments.core.artifacts import write_json
from experiments.core.context import Context
from experiments.core.errors import DataError
from experiments.study.cache import NEVER, fingerprint, source_digest
from sensors_io.units import WorkUnit, finish
from touchr1_jax.training.compilation import compilations_kept, compiled_quickly

PARTS, PROGRAMS = "units", "compiled"
"""Folders of the cache: of the units, each with its checkpoints until it is done, and of compiled programs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyPart:
    """One policy of one seed; those that are `first` are what the others start from."""

    name: str
    seed: int
    first: bool


Train = Callable[[StudyPart, Context], None]


def train_parts(
    train: Train, parts: Sequence[StudyPart], values: Mapping[str, Any], share: bool, context: Context
) -> None:
    """Have workers train the policies of a study that are not in the cache yet; they depend on `values` alone.

    Raises:
      DataError: the study takes no policies from the cache.
      LauncherError, UnitsError: as `units.finish`.
    """
    if not share:
        raise DataError("share is False: workers hand policies over by the cache; leave --launcher out, or set --share")
    listed = {part: _unit(train, part, values, context.cache_dir.absolute()) for part in parts}
    for first in (True, False):
        units = [unit for part, unit in listed.items() if part.first == first]
        for done, unit in enumerate(finish(units, context.launcher, context.print), 1):
            context.print(f"{done} of {len(units)} policies {'to start from ' if first else ''}trained: {unit.name}")


def _unit(train: Train, part: StudyPart, values: Mapping[str, Any], cache_dir: Path) -> WorkUnit:
    digest = fingerprint({**values, "part": part}, {}, source_digest(NEVER))
    folder, machine = cache_dir / PARTS / digest, {**numerics.machine(), **numerics.settings()}
    quick = bool(jax.config.values["jax_disable_most_optimizations"])
    run = functools.partial(_work, train, part, cache_dir, folder, machine, quick)
    return WorkUnit(name=f"{part.name}/{part.seed} {digest}", run=run, done=_result(folder).exists)


def _result(folder: Path) -> Path:
    return folder.with_suffix(".json")


def _work(
    train: Train, part: StudyPart, cache_dir: Path, folder: Path, machine: Mapping[str, Any], quick: bool
) -> None:
    """Train one policy, in a worker; one that was killed goes on from its checkpoints."""
    with compiled_quickly() if quick else contextlib.nullcontext(), compilations_kept(cache_dir / PROGRAMS):
        if changes := numerics.changed(machine, {**numerics.machine(), **numerics.settings()}):
            raise DataError(
                f"this worker computes other bits than the driver ({', '.join(changes)}): the study would not take its "
                "policies; use workers of the driver's kind"
            )
        logging.getLogger("orbax").setLevel(logging.ERROR)
        folder.mkdir(parents=True, exist_ok=True)
        with runs.locked(folder), contextlib.closing(Context(folder, cache_dir, Console(quiet=True))) as context:
            train(part, context)
            write_json(_result(folder), dataclasses.asdict(part))
