"""Records that several units write, a shard each: on any machine, resumed where they stopped, adopted in order."""

import collections
import dataclasses
import itertools
import pathlib
from collections.abc import Callable, Iterable
from collections.abc import Sequence as Seq

from sensors_io.contents import PartWriter
from sensors_io.index import Part, RecordsMeta
from sensors_io.json_files import read_json, write_json
from sensors_io.records import RecordWriter
from sensors_io.schema import ObjectCard, Sequence
from sensors_io.units import Launcher, WorkUnit, finish


def write_by_units(
    out: pathlib.Path,
    meta: RecordsMeta,
    cards: Iterable[ObjectCard],
    units_from: Callable[[int, int], Seq[WorkUnit]],
    launcher: Launcher,
    report: Callable[[int], object],
) -> None:
    """Write records shard by shard; contacts that are there already are kept.

    Args:
      out: directory of the records, which all workers see.
      meta: of the records.
      cards: of all objects.
      units_from: the units that are left after some contacts and shards, in the order of their shards; each is named as
        `part_path` takes it and calls `make_part`.
      launcher: where they run.
      report: called with the number of contacts done, first with those of an earlier run.

    Raises:
      RecordsExistError: `out` holds records of another config.
      LauncherError, UnitsError: as `units.finish`.
    """
    kept = {f"{path.name.partition('.')[0]}.arrayrecord" for path in out.glob("*.part")}
    with RecordWriter(out, meta=meta, resume=True, kept=kept.__contains__) as writer:
        writer.begin()
        report(writer.contacts_done)
        units = units_from(writer.contacts_done, writer.shards_done)
        waiting = collections.deque(part_path(out.absolute(), unit.name) for unit in units)
        for stale in set(out.absolute().glob("*.part")) - set(waiting):  # adopted already, or of another division
            stale.unlink()
        ended = finish(units, launcher)
        first = next(ended, None)  # an engine that is not there is named before anything is computed
        for card in cards:
            if card.object_id not in writer.objects_done:
                writer.write_object(card)
        for _ in itertools.chain([first], ended):
            while waiting and waiting[0].exists():  # parts are adopted in order
                writer.adopt(Part.of(read_json(waiting[0])))
                waiting.popleft().unlink()
                report(writer.contacts_done)


def part_path(out: pathlib.Path, name: str) -> pathlib.Path:
    """File that says that a unit's shard is in its place, and what it holds, until the index does."""
    return out / f"{name}.part"


def make_part(
    out: pathlib.Path, number: int, sensors: Seq[str], contacts: Iterable[Seq[Sequence]], part: pathlib.Path
) -> None:
    """Write one shard, then the part that describes it."""
    shard = PartWriter(out, number, sensors)
    for sequences in contacts:
        shard.write(sequences)
    write_json(part, dataclasses.asdict(shard.publish()))
