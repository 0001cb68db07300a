"""Generated scenes as records: a unit for each shard, resumed where it stopped, known by the hash of its config."""

import collections
import dataclasses
import functools
import hashlib
import itertools
import pathlib
from collections.abc import Callable

from sensors_io.contents import PartWriter
from sensors_io.index import INDEX, Index, Part, RecordsMeta
from sensors_io.json_files import read_json, write_json
from sensors_io.records import RecordWriter
from sensors_io.scenes.cards import object_cards
from sensors_io.scenes.config import SceneConfig, config_hash
from sensors_io.scenes.protocol import contacts
from sensors_io.schema import SENSORS
from sensors_io.shards import shard_file
from sensors_io.units import HERE, Launcher, WorkUnit, finish

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
    kept = {f"{path.name.partition('.')[0]}.arrayrecord" for path in out.glob("*.part")}
    with RecordWriter(out, meta=meta, resume=True, kept=kept.__contains__) as writer:
        report(writer.contacts_done, config.contact_count)
        units = shard_units(config, out.absolute(), writer.contacts_done, writer.shards_done, per_shard)
        waiting = collections.deque(part_path(out.absolute(), unit.name) for unit in units)
        for stale in set(out.absolute().glob("*.part")) - set(waiting):  # adopted already, or of another division
            stale.unlink()
        ended = finish(units, launcher)
        first = next(ended, None)  # an engine that is not there is named before anything is computed
        for card in object_cards(config):
            if card.object_id not in writer.objects_done:
                writer.write_object(card)
        for _ in itertools.chain([first], ended):
            while waiting and waiting[0].exists():  # parts are adopted in order
                writer.adopt(Part.of(read_json(waiting[0])))
                waiting.popleft().unlink()
                report(writer.contacts_done, config.contact_count)


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


def part_path(out: pathlib.Path, name: str) -> pathlib.Path:
    """File that says that a unit's shard is in its place, and what it holds, until the index does."""
    return out / f"{name}.part"


def make_shard(config: SceneConfig, out: pathlib.Path, number: int, first: int, count: int, name: str) -> None:
    """Write one shard, then the part that describes it."""
    shard = PartWriter(out, number, SENSORS)
    for sequences in contacts(config, first, first + count):
        shard.write(sequences)
    write_json(part_path(out, name), dataclasses.asdict(shard.publish()))


def _is_complete(config: SceneConfig, out: pathlib.Path) -> bool:
    """True if `out` holds all contacts of the configuration."""
    if not (out / INDEX).exists():
        return False
    index = Index.read(out)
    return index.complete and index.meta.config_hash == config_hash(config)
