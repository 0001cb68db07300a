"""Where the data of an experiment comes from: generated scenes, imported recordings, or existing records."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from experiments.core.context import Context
from experiments.core.progress import ProgressCallback
from sensors_io.generate import generate_records
from sensors_io.importers.physiclear import PhysiclearConfig, import_physiclear
from sensors_io.scenes.config import SceneConfig, config_hash

Source = Literal["generated", "physiclear", "records"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SourceConfig:
    """Which data; `directory` holds the recordings or records, and is not used for generated scenes.

    Raises:
      ValueError: recordings or records without a directory, or a directory given for generated scenes.
    """

    kind: Source
    directory: Path | None
    scenes: SceneConfig
    physiclear: PhysiclearConfig

    def __post_init__(self) -> None:
        if (self.directory is None) != (self.kind == "generated"):
            need = "takes no data_dir: drop it" if self.kind == "generated" else "needs data_dir: the folder to read"
            raise ValueError(f"data_dir is {self.directory}: data {self.kind!r} {need}")


def prepare_records(config: SourceConfig, context: Context) -> Path:
    """Directory of the records, made or imported first where the cache lacks them; an interrupted making goes on."""
    if config.directory is None:
        path = context.cache_dir / f"scenes-{config_hash(config.scenes)}"
        _make(context, "making scenes", lambda tell: generate_records(config.scenes, path, progress=tell))
        return path
    if config.kind == "records":
        return config.directory
    source = config.directory.resolve()
    identity = json.dumps([str(source), dataclasses.asdict(config.physiclear)], sort_keys=True)
    path = context.cache_dir / f"physiclear-{hashlib.sha256(identity.encode()).hexdigest()[:16]}"
    _make(
        context,
        "importing videos",
        lambda tell: import_physiclear(source, path, config=config.physiclear, progress=tell),
    )
    return path


def _make(context: Context, title: str, make: Callable[[ProgressCallback], object]) -> None:
    """Run `make` under a progress bar."""
    with context.timed("data"), context.progress_callback(title) as report:
        context.processes.write_once(lambda: make(report))
