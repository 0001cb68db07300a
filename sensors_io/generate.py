"""Generated scenes as records: a unit for each shard, resumed where it stopped, known by the hash of its config."""

import dataclasses
import functools
import hashlib
import pathlib
from collections.abc import Callable

from sensors_io.index import INDEX, Index, RecordsMeta
from sensors_io.parts import make_part, part_path, write_by_units
from sensors_io.scenes.cards import object_cards
from sensors_io.scenes.config import SceneConfig, config_hash
from sensors_io.scenes.protocol import contacts
from sensors_io.schema import SENSORS
from sensors_io.shards import shard_file
from sensors_io.units import HERE, Launcher, WorkUnit

RECORDS_PER_SHARD = 2880
"""At the several hundred records a second of two cores, a killed generation loses some seconds."""


def generate_records(
    config: SceneConfig,
    out: pathlib.Path,
    *,
    progress: Callable[[int, int], None] | None = None,
    records_per_shard: int = RECORDS_PER_SHARD,
    launcher: Launcher = HERE,
) -> None:
    """Write the generated scenes of `config` as records in `out`; contacts that are there already are kept.

    Args:
      config: what to generate.
      out: directory of the records, which all workers see.
      progress: called with the number of contacts done and their total, first with those of an earlier run.
      records_per_shard: frames of all sensors in one file.
      launcher: where shards are made; the records do not depend on it.

    Raises:
      RecordsExistError: `out` holds records of another config.
      LauncherError, UnitsError: as `units.finish`.
    """
    report = progress or (lambda done, total: None)
    if _is_complete(config, out):  # no lock is taken, so that several processes may use the same records
        report(config.contact_count, config.contact_count)
        return
    meta = RecordsMeta(
        source="generated",
        licence="that of this code",
        config_hash=config_hash(config),
        sensors=SENSORS,
        notes={"config": dataclasses.asdict(config)},
    )
    per_shard = max(1, records_per_shard // (len(SENSORS) * config.frame_count))
    write_by_units(
        out,
        meta,
        object_cards(config),
        lambda contacts, shards: shard_units(config, out.absolute(), contacts, shards, per_shard),
        launcher,
        lambda done: report(done, config.contact_count),
    )


def shard_units(config: SceneConfig, out: pathlib.Path, start: int, shard: int, per_shard: int) -> list[WorkUnit]:
    """Units that make the contacts from `start` on, `per_shard` each, in shards from number `shard` on."""
    units = []
    for number, first in enumerate(range(start, config.contact_count, per_shard), shard):
        count = min(per_shard, config.contact_count - first)
        digest = hashlib.sha256(f"{config_hash(config)} {number} {first} {count}".encode()).hexdigest()[:16]
        name = f"{pathlib.Path(shard_file('contacts', number)).stem}.{digest}"
        run = functools.partial(make_shard, config, out, number, first, count, name)
        units.append(WorkUnit(name=name, run=run, done=part_path(out, name).exists))
    return units


def make_shard(config: SceneConfig, out: pathlib.Path, number: int, first: int, count: int, name: str) -> None:
    """Write one shard, then the part that describes it."""
    make_part(out, number, SENSORS, contacts(config, first, first + count), part_path(out, name))


def _is_complete(config: SceneConfig, out: pathlib.Path) -> bool:
    """True if `out` holds all contacts of the configuration."""
    if not (out / INDEX).exists():
        return False
    index = Index.read(out)
    return index.complete and index.meta.config_hash == config_hash(config)
