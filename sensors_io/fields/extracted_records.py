"""Fields extracted from the pictures of records: new records with both, written in units of a shard and resumable."""

import dataclasses
import functools
import hashlib
import json
import pathlib
import zlib
from collections.abc import Callable
from collections.abc import Sequence as Seq

from sensors_io.contents import put_rest_pictures, rest_pictures
from sensors_io.fields.extract import ExtractConfig
from sensors_io.fields.recorded import RecordedGels, RestGel, recorded_fields, with_fields
from sensors_io.fields.types import Calibration, CalibrationError
from sensors_io.importers.keep import Skip
from sensors_io.index import RecordsMeta
from sensors_io.parts import make_part, part_path, write_by_units
from sensors_io.records import RecordStore
from sensors_io.schema import Sequence
from sensors_io.shards import shard_file
from sensors_io.units import HERE, Launcher, WorkUnit

FRAMES_PER_SHARD = 2880
"""At the several hundred pictures a second of one core, a killed extraction loses some seconds."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldsJob:
    """Everything that decides the fields of some records.

    Args:
      records: whose pictures are read.
      sensor: whose pictures are read; sequences of other sensors are copied as they are.
      gel: at rest, where a recording has none of its own.
      calibration: of the colours; `None` gives neither depth nor shear.
      config: of the extraction.
      rows: of the fields; 0 takes those of the pictures.
    """

    records: pathlib.Path
    sensor: str
    gel: RestGel
    calibration: Calibration | None
    config: ExtractConfig
    rows: int = 0

    def __post_init__(self) -> None:
        if self.rows < 0:
            raise CalibrationError(f"rows is {self.rows}: must be ≥ 0; 0 takes the rows of the pictures")
        if self.calibration is not None and self.calibration.sensor != self.sensor:
            raise CalibrationError(
                f"calibration is for {self.calibration.sensor!r}, not {self.sensor!r}: must be equal; set --sensor"
            )

    def hash(self, digest: str) -> str:
        """First 16 hex digits of the SHA-256 of the job and of a digest of its records and their gels at rest."""
        background = b"" if self.gel.background is None else self.gel.background.tobytes()
        made_by = "" if self.calibration is None else self.calibration.hash
        parts = [digest, self.sensor, made_by, self.gel.rest_frames, self.gel.mm_per_px, self.rows]
        text = json.dumps([*parts, dataclasses.asdict(self.config)], default=str)
        return hashlib.sha256(text.encode() + background).hexdigest()[:16]


def write_extracted(
    job: FieldsJob,
    out: pathlib.Path,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
    frames_per_shard: int = FRAMES_PER_SHARD,
    launcher: Launcher = HERE,
) -> tuple[Skip, ...]:
    """Write records with pictures and extracted fields into `out`; contacts that are there already are kept.

    A contact that cannot be read, such as one without a gel at rest, is left out and returned with the reason.

    Args:
      job: what is extracted.
      out: directory of the new records, which all workers see.
      progress: called with the number of contacts done and their total.
      frames_per_shard: frames of all sensors in one file.
      launcher: where shards are made; the records do not depend on it.

    Raises:
      CalibrationError: no sequence of the sensor, `out` is in the folder of the records, or no sequence can be read.
      RecordsExistError: `out` holds other records.
      LauncherError, UnitsError: as `units.finish`.
    """
    store = RecordStore(job.records)
    if out.resolve().is_relative_to(job.records.resolve()):
        raise CalibrationError(
            f"--out is {out}: must not be the records themselves, nor lie in their folder; name another directory"
        )
    contacts, skipped = _readable_contacts(store, job)
    rests = rest_pictures(store.path)
    content = [f"{name} {zlib.crc32(x)}" for name, x in rests.items()]
    content += [f"{i} {store.checksum(i)}" for i in contacts]  # the index knows sizes alone
    fields = {"of": job.sensor, "records": store.digest, "rows": job.rows}
    meta = RecordsMeta(
        source=store.meta.source,
        licence=store.meta.licence,
        config_hash=job.hash(" ".join([store.digest, *content])),
        sensors=store.meta.sensors,
        notes={**store.meta.notes, "fields": fields | {"skipped": [dataclasses.asdict(skip) for skip in skipped]}},
    )
    each = max(1, round(sum(store.frames.values()) / max(len(store), 1)))
    per_shard = max(1, frames_per_shard // each)

    def units_from(done: int, shards: int) -> list[WorkUnit]:
        put_rest_pictures(out, rests)  # not before: `out` may hold other records
        units = []
        for number, first in enumerate(range(done, len(contacts), per_shard), shards):
            last = min(first + per_shard, len(contacts))
            digest = hashlib.sha256(f"{meta.config_hash} {number} {first} {last}".encode()).hexdigest()[:16]
            name = f"{pathlib.Path(shard_file('contacts', number)).stem}.{digest}"
            run = functools.partial(extract_shard, job, out.absolute(), number, contacts[first:last], name)
            units.append(WorkUnit(name=name, run=run, done=part_path(out.absolute(), name).exists))
        return units

    cards = store.objects.values()
    write_by_units(out, meta, cards, units_from, launcher, lambda done: progress(done, len(contacts)))
    return skipped


def extract_shard(job: FieldsJob, out: pathlib.Path, number: int, contacts: Seq[int], name: str) -> None:
    """Write the shard of some contacts, then the part that describes it."""
    store = RecordStore(job.records)
    gels = RecordedGels(store.path, job.gel, job.calibration, job.config)
    made = ([_extracted(sequence, job, gels) for sequence in store.contact(i).values()] for i in contacts)
    make_part(out, number, store.meta.sensors, made, part_path(out, name))


def _extracted(sequence: Sequence, job: FieldsJob, gels: RecordedGels) -> Sequence:
    if sequence.sensor != job.sensor:
        return sequence
    fields = recorded_fields(sequence, gels.extractor(sequence))
    return with_fields(sequence, fields, "" if job.calibration is None else job.calibration.hash, job.rows)


def _readable_contacts(store: RecordStore, job: FieldsJob) -> tuple[tuple[int, ...], tuple[Skip, ...]]:
    """Numbers of the contacts that can be read, and those that cannot; refuses what no contact allows."""
    seen = [i for i in range(len(store)) if job.sensor in store.sensors_of(i)]
    if not seen:
        raise CalibrationError(
            f"--sensor is {job.sensor!r}: must be one of the records', {', '.join(store.meta.sensors)}; correct it"
        )
    gels = RecordedGels(store.path, job.gel, job.calibration, job.config)
    unread: dict[int, Skip] = {}
    first = None
    for i in seen:
        sequence = store.contact(i)[job.sensor]
        try:
            _require_readable(sequence, gels)
        except CalibrationError as error:
            unread[i] = Skip(name=sequence.name, reason=str(error))
        else:
            first = sequence if first is None else first
    if first is None:
        skip = unread[seen[0]]
        raise CalibrationError(f"no contact can be read; the first, {skip.name}: {skip.reason}")
    refused = gels.extractor(first).refused
    if job.calibration is None and len(refused) > 1:
        raise CalibrationError(f"{first.name} carries no field: {'; '.join(refused)}")
    return tuple(i for i in range(len(store)) if i not in unread), tuple(unread.values())


def _require_readable(sequence: Sequence, gels: RecordedGels) -> None:
    have = [name for name in ("depth_mm", "deformation_mm", "shear_mm") if getattr(sequence, name) is not None]
    if have:
        raise CalibrationError(f"has {', '.join(have)} already: must have pictures alone; extract other records")
    gels.require(sequence)
