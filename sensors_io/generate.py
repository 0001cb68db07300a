"""Generated scenes as records: written once, resumed where it stopped, known by the hash of its config."""

import dataclasses
import pathlib
from collections.abc import Callable

from sensors_io.index import INDEX, Index, RecordsMeta
from sensors_io.records import RecordWriter
from sensors_io.scenes.cards import object_cards
from sensors_io.scenes.config import SceneConfig, config_hash
from sensors_io.scenes.protocol import contacts
from sensors_io.schema import SENSORS

RECORDS_PER_SHARD = 2880
"""At the several hundred records a second of two cores, a killed generation loses some seconds."""


def generate_records(
    config: SceneConfig,
    out: pathlib.Path,
    *,
    progress: Callable[[int, int], None] | None = None,
    records_per_shard: int = RECORDS_PER_SHARD,
) -> None:
    """Write the generated scenes of `config` as records in `out`; contacts that are there already are kept.

    Args:
      config: what to generate.
      out: directory of the records.
      progress: called with the number of contacts done and their total, first with those of an earlier run.
      records_per_shard: frames of all sensors in one file.

    Raises:
      RecordsExistError: `out` holds records of another config.
    """
    meta = RecordsMeta(
        source="generated",
        licence="that of this code",
        config_hash=config_hash(config),
        sensors=SENSORS,
        notes={"config": dataclasses.asdict(config)},
    )
    if _is_complete(config, out):  # no lock is taken, so that several processes may use the same records
        if progress is not None:
            progress(config.contact_count, config.contact_count)
        return
    per_shard = max(1, records_per_shard // (len(SENSORS) * config.frame_count))
    with RecordWriter(out, meta=meta, contacts_per_shard=per_shard, resume=True) as writer:
        for card in object_cards(config):
            if card.object_id not in writer.objects_done:
                writer.write_object(card)
        if progress is not None:
            progress(writer.contacts_done, config.contact_count)
        for sequences in contacts(config, start=writer.contacts_done):
            writer.write_contact(sequences)
            if progress is not None:
                progress(writer.contacts_done, config.contact_count)


def _is_complete(config: SceneConfig, out: pathlib.Path) -> bool:
    """True if `out` holds all contacts of the configuration."""
    if not (out / INDEX).exists():
        return False
    index = Index.read(out)
    return index.complete and index.meta.config_hash == config_hash(config)
