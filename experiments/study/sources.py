"""The data of an experiment: generated scenes, imported recordings, or existing records."""

import dataclasses
import functools
import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from experiments.core import numerics
from experiments.core.context import Context
from experiments.core.progress import ProgressCallback
from experiments.study.dataset import Dataset, has_measured_force, open_dataset, require_same_records
from sensors_io.generate import generate_records
from sensors_io.importers.catalogue import import_catalogue
from sensors_io.importers.physiclear import PhysiclearConfig, list_physiclear
from sensors_io.locks import RecordsBusyError
from sensors_io.pipeline import ClipConfig
from sensors_io.quality import oddities, recorded_digest
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig, config_hash
from sensors_io.schema import FRAME_ARRAYS, Flag, Sequence

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
        path = scenes_folder(context.cache_dir, config.scenes)
        make = functools.partial(generate_records, config.scenes, path)
        _make(context, "making scenes", lambda report: make(progress=report))
        return path
    if config.data == "records":
        return config.data_dir
    source, settings = config.data_dir.resolve(), config.physiclear
    decoding = {name: x for name, x in numerics.environment().items() if name.startswith("OPENCV_")}
    about = [str(source), dataclasses.asdict(settings), *filter(None, [decoding])]
    path = context.cache_dir / f"physiclear-{_digest(about)}"
    importing = lambda report: import_catalogue(list_physiclear(source, settings), path, progress=report)
    _make(context, "importing videos", importing)
    return path


def scenes_folder(cache_dir: Path, scenes: SceneConfig) -> Path:
    """Directory of generated records, which depend on the settings of JAX and XLA in their last bits."""
    return cache_dir / f"scenes-{_digest([config_hash(scenes), numerics.settings()])}"


def _digest(about: object) -> str:
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]


def open_source(
    config: SourceConfig,
    clip: ClipConfig,
    grpo_share: float | None,
    context: Context,
    *,
    memory_gib: float = 0.0,
    threads: int = 1,
) -> Dataset:
    """The records, of recordings without odd contacts if these are dropped; other arguments as of `open_dataset`.

    `ConfigurationError` if they are others than the run began with.
    """
    path = prepare_records(config, context)
    found = survey_contacts(config, path, context, clip.rejected)
    left_out = found.odd if config.drop_odd else ()
    data = open_dataset(path, clip, grpo_share, memory_gib, threads, left_out, found.content, found.has_force)
    require_same_records(data, context)
    for line in (*data.levels(), *data.unlearned_sensors()) if config.data != "generated" else ():
        context.print(line)
    return data


class SurveyedContacts(NamedTuple):
    """Findings of a reading of every contact of recordings; of scenes nothing, as their configuration decides it."""

    odd: tuple[int, ...] = ()  # contacts that teach nothing about touch
    content: str = ""  # hash of all that was recorded
    has_force: bool | None = None


def survey_contacts(
    config: SourceConfig, path: Path, context: Context, rejected: Collection[Flag] = ()
) -> SurveyedContacts:
    """Read every contact of recordings and print, by reason, those that teach nothing about touch.

    `rejected` are the flags of frames that no clip shows where a sequence has others.
    """
    if config.data == "generated":
        return SurveyedContacts()
    store, reasons, content = RecordStore(path), dict[str, dict[int, str]](), hashlib.sha256()
    alike, films = dict[str, dict[str, int]](), {sensor: Counter[str]() for sensor in store.meta.sensors}
    with_force = 0
    for i in context.each("looking for odd contacts", range(len(store))):
        contact = store.contact(i)
        with_force += has_measured_force(contact)
        for sensor, sequence in contact.items():
            films.setdefault(sensor, Counter())[_film(sequence)] += 1
            for reason in (odd := oddities(sequence, rejected=rejected)):
                reasons.setdefault(reason, {})[i] = sequence.name
            shown = recorded_digest(sequence)
            if not odd:  # else black pictures would be copies of each other
                alike.setdefault(shown, {})[sequence.name] = i
            content.update(f"{sequence.name} {shown} {sequence.contact_region_px} {sequence.mm_per_px}".encode())
            _add_arrays(content, [getattr(sequence, name) for name in FRAME_ARRAYS if name != "frames"])
    for same in (list(names.items()) for names in alike.values()):
        sources = {(store.contacts[i].object_id, name.rpartition("/")[2]) for name, i in same}
        copies = same if len(sources) > 1 else same[1:]  # of one object and sensor the first is no copy
        for name, i in copies:
            reasons.setdefault("the same recording twice", {})[i] = name
    for sensor, kinds in films.items():
        listed = _listed([f"{n} of {kind}" for kind, n in kinds.most_common()])
        context.print(f"{sensor}: {listed or 'not recorded in any contact'}")
    what = "are left out" if config.drop_odd else "are trained on (option drop-odd leaves them out)"
    for reason, named in sorted(reasons.items()):
        context.print(f"{reason}: {len(named)} of {len(store)} contacts {what}: {_listed([*named.values()])}")
    _survey_objects(store, content, with_force, context)
    return SurveyedContacts(
        tuple(sorted({i for rows in reasons.values() for i in rows})), content.hexdigest()[:16], with_force > 0
    )


def _survey_objects(store: RecordStore, content: "hashlib._Hash", with_force: int, context: Context) -> None:
    """Add the pictures of the objects to the hash, and print what contacts and objects lack that others have."""
    touched, with_view = {key.object_id for key in store.contacts}, 0
    found: dict[str, list[str]] = {"without any contact": [], "without any label": [], "picture of one colour": []}
    for name, card in store.objects.items():
        _add_arrays(content, [card.view])
        with_view += card.view is not None
        unlabelled = card.split != "unlabelled" and max(card.label_row()) < 0
        for names, holds in zip(found.values(), (name not in touched, unlabelled, _is_even(card.view)), strict=True):
            if holds:
                names.append(name)
    count = len(store.objects)
    some = ("measured force", with_force, len(store), "contacts"), ("picture", with_view, count, "objects")
    for what, n, of, kind in some:
        if 0 < n < of:
            context.print(f"{what}: {n} of {of} {kind}; the others are learned and asked without it")
    for what, names in found.items():
        if names:
            context.print(f"{what}: {len(names)} of {count} objects, such as {names[0]}")


def _is_even(picture: np.ndarray | None) -> bool:
    """True of a picture of one colour; most others end with the first row."""
    return picture is not None and all((row == picture[0, 0]).all() for row in picture)


def _add_arrays(content: "hashlib._Hash", arrays: Iterable[np.ndarray | None]) -> None:
    for x in arrays:
        content.update(b"-" if x is None else f"{x.dtype.str} {x.shape} ".encode() + np.ascontiguousarray(x).tobytes())


def _listed(words: list[str]) -> str:
    return ", ".join(words[:MOST_NAMED]) + (" …" if len(words) > MOST_NAMED else "")


def _film(sequence: Sequence) -> str:
    """Size of its pictures, or of its fields, and its rate in whole frames a second."""
    shown = next(x for x in (sequence.frames, sequence.depth_mm, sequence.deformation_mm) if x is not None)
    rows, columns = shown.shape[1:3]
    spent_s = 1e-9 * float(np.ptp(sequence.host_time_ns))
    return f"{rows} × {columns}" + (f" at {(len(sequence) - 1) / spent_s:.0f}/s" if spent_s else "")


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
