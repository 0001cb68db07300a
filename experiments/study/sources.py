"""The data of an experiment: generated scenes, imported recordings, or existing records."""

import dataclasses
import functools
import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from experiments.core.context import Context
from experiments.core.progress import ProgressCallback
from sensors_io.generate import generate_records
from sensors_io.importers.physiclear import PhysiclearConfig, import_physiclear
from sensors_io.locks import RecordsBusyError
from sensors_io.quality import oddities
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig, config_hash

Source = Literal["generated", "physiclear", "records"]

MOST_NAMED = 3  # odd contacts that a line names


@dataclasses.dataclass(frozen=True, kw_only=True)
class SourceConfig:
    """Where the data come from; the configuration of every experiment on data begins with it.

    Raises:
      ValueError: recordings or records without a folder, or a folder for generated scenes.
    """

    data: Source = "generated"
    """Generated scenes, PhysiCLeAR's videos, or a folder of records."""
    data_dir: Path | None = None
    """Folder of the videos or records."""
    drop_odd: bool = False
    """Leave out contacts that teach nothing about touch, such as those of black pictures; they are listed anyway."""
    scenes: SceneConfig = SceneConfig()
    physiclear: PhysiclearConfig = PhysiclearConfig()

    def __post_init__(self) -> None:
        if (self.data_dir is None) != (self.data == "generated"):
            need = "takes no data_dir: drop it" if self.data == "generated" else "needs data_dir: the folder to read"
            raise ValueError(f"data_dir is {self.data_dir}: data {self.data!r} {need}")


def prepare_records(config: SourceConfig, context: Context) -> Path:
    """Directory of the records, made or imported first where the cache lacks them; an interrupted one resumes."""
    if config.data_dir is None:
        path = context.cache_dir / f"scenes-{config_hash(config.scenes)}"
        make = functools.partial(generate_records, config.scenes, path)
        _make(context, "making scenes", lambda report: make(progress=report))
        return path
    if config.data == "records":
        return config.data_dir
    source, settings = config.data_dir.resolve(), config.physiclear
    identity = json.dumps([str(source), dataclasses.asdict(settings)], sort_keys=True)
    path = context.cache_dir / f"physiclear-{hashlib.sha256(identity.encode()).hexdigest()[:16]}"
    _make(context, "importing videos", lambda report: import_physiclear(source, path, config=settings, progress=report))
    return path


def odd_contacts(config: SourceConfig, path: Path, context: Context) -> tuple[int, ...]:
    """Contacts of recordings of which a sequence teaches nothing about touch, printed by reason; none of scenes."""
    if config.data == "generated":
        return ()
    store, reasons = RecordStore(path), dict[str, dict[int, str]]()
    for i in context.each("looking for odd contacts", range(len(store))):
        for sequence in store.contact(i).values():
            for reason in oddities(sequence):
                reasons.setdefault(reason, {})[i] = sequence.name
    what = "are left out" if config.drop_odd else "are trained on (--drop-odd leaves them out)"
    for reason, named in sorted(reasons.items()):
        names = ", ".join([*named.values()][:MOST_NAMED]) + (" …" if len(named) > MOST_NAMED else "")
        context.print(f"{reason}: {len(named)} of {len(store)} contacts {what}: {names}")
    untouched = sorted(store.objects.keys() - {key.object_id for key in store.contacts})
    if untouched:
        context.print(f"without any contact: {len(untouched)} of {len(store.objects)} objects, such as {untouched[0]}")
    return tuple(sorted({i for rows in reasons.values() for i in rows}))


def _after_others(make: Callable[[], object], context: Context) -> object:
    """Make records, or wait for another run of a sweep that is making the same ones."""
    waits = False
    while True:
        try:
            return make()
        except RecordsBusyError as error:
            if not waits:
                context.print(f"waiting: {error}")
            waits = True
            time.sleep(1)


def _make(context: Context, title: str, make: Callable[[ProgressCallback], object]) -> None:
    with context.timed("data"), context.progress_callback(title) as report:
        context.processes.write_once(lambda: _after_others(lambda: make(report), context))
