"""What do a billion generated records cost, and what limits them on 1, 10, 100 and 1,000 machines?

    python -m experiments scale_records
    python -m experiments scale_records --machine.hourly-price 0.8 --machine.bandwidth-gb-s 0.5      (your machines)

Measures the CPU time and the bytes of a record, the requests to write a shard to a store and to read it, and the index
of 10⁴ and 10⁷ contacts.  The report multiplies them by the counts of a billion records: all figures of its last two
tables are marked as simulated, from measured units and from the assumed machine of the configuration.  The driver adds
one shard after the other to the index, so that its time does not fall with the number of machines.

Cost: about two and a half minutes on one core, half of it the index; `--scale smoke` one minute.

Expected: some 750 hours of a core and 17 TB.  Computation limits on up to 100 machines and the driver,
which waits for its disk with each shard, on 1,000; larger shards move that limit.
"""

import collections
import dataclasses
import functools
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import fsspec
import numpy as np

from experiments.core.context import Context
from experiments.core.results import Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.scenes.scale_index import index_cost
from experiments.scenes.throughput_rates import write_rate
from sensors_io.generate import RECORDS_PER_SHARD
from sensors_io.pipeline import ClipConfig, make_clip
from sensors_io.records import RecordStore
from sensors_io.remote import Mirror
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS
from touchr1_jax.validation import above

MOST_OPEN_S, MOST_MB, MOST_FIND_MS, MOST_GROWTH = 3.0, 500.0, 1.0, 1.5
"""Requirements on the index: to open it, its memory, a contact by key, publishing late over publishing early."""

Units = Mapping[str, float]  # measured figures by name: those of `measure_units`, or of `index_cost`

TITLES = {
    "cpu_ms": "one core, ms", "bytes": "size, bytes", "sent": "requests to send", "read": "requests to read",
    "clip_ms": "a clip, ms", "open_s": "opening, s", "open_cpu_s": "opening, s of a core", "peak_mb": "memory, MB",
    "find_ms": "a contact by key, ms", "sort_s": "first search, s", "publish_ms": "one more shard, ms of a core",
    "published_ms": "one more shard, ms",
}  # fmt: skip
"""Headings of measured figures."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AssumedMachine:
    """The machine that is assumed: nothing of it is measured."""

    cores: int = 16
    hourly_price: float = 0.5  # of a machine
    bandwidth_gb_s: float = 1.0  # to the store, of a machine
    latency_ms: float = 30.0  # of a request
    requests_per_s: float = 3500.0  # uploads that the store takes under one prefix, from all machines

    def __post_init__(self) -> None:
        above(self, 0, "cores", "bandwidth_gb_s", "requests_per_s")

    @property
    def described(self) -> str:
        """The machine in words."""
        return (
            f"{self.cores} cores at {self.hourly_price:g} an hour, {self.bandwidth_gb_s:g} GB/s and "
            f"{self.latency_ms:g} ms a request to a store that takes {self.requests_per_s:,.0f} requests a second"
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class BillionConfig:
    """Scenes that are made to measure, sizes of the indexes, and what is asked for."""

    scenes: SceneConfig = SceneConfig(objects=16, sequences=64 * len(SENSORS))
    indexed: tuple[int, int] = (10**4, 10**7)
    publications: int = 50
    records: int = 10**9
    machines: tuple[int, ...] = (1, 10, 100, 1000)
    batch: int = 64  # contacts of the first batch, each in a shard of its own
    machine: AssumedMachine = AssumedMachine()


def run(config: BillionConfig, context: Context) -> Results:
    """Measure the units, multiply."""
    units = context.once("units/0", functools.partial(measure_units, config, context))
    few, many = (context.once(f"index/{n}", functools.partial(_index, n, config.publications)) for n in config.indexed)
    growth = many["publish_ms"] / few["publish_ms"]
    rows = [simulated(config, units, many, machines) for machines in config.machines]
    shards = -(-config.records // RECORDS_PER_SHARD)
    hours = config.records * units["cpu_ms"] / 3.6e6
    return Results(
        verdict=(
            f"Simulated: {config.records:,} records cost {hours:,.0f} hours of a core and "
            f"{config.records * units['bytes'] / 1e12:.3g} TB in {shards:,} shards, {shards * units['sent']:,.0f} "
            f"requests to write and {shards * units['read']:,.0f} to read all of them once.",
            "What limits: " + ", ".join(f"{row['limit']} on {row['machines']:,}" for row in rows) + " machines.",
        ),
        requirements=(
            at_most("opens", many["open_s"], MOST_OPEN_S, "s", f"{many['contacts']:,} contacts"),
            at_most("memory", many["peak_mb"], MOST_MB, "MB", "with a search and a split"),
            at_most("contact by key", many["find_ms"], MOST_FIND_MS, "ms"),
            at_most("one more shard, late over early", growth, MOST_GROWTH, note="time of a core"),
        ),
        tables=(
            measured_table("Measured: a record", [{"unit": "here", **units}], note="Requests are those of a shard."),
            measured_table("Measured: the index", [few, many]),
            cost_table(config, units, many),
            named_table(f"Simulated: {config.records:,} records", rows, note="The slowest of the four limits."),
        ),
        settings={"assumed machine": config.machine.described},
    )


def measured_table(title: str, rows: Sequence[Mapping[str, Any]], note: str = "") -> Table:
    """Measured figures under headings in words."""
    titled = [{TITLES.get(name, name): value for name, value in row.items()} for row in rows]
    size = TITLES["bytes"]
    return named_table(title, titled, formats={size: ",.0f"} if size in titled[0] else {}, note=note)


def _index(contacts: int, publications: int) -> Units:
    with tempfile.TemporaryDirectory() as folder:
        return index_cost(Path(folder), contacts, publications)


def measure_units(config: BillionConfig, context: Context) -> Units:
    """Make the scenes, send them to a store, and read them from there.

    Milliseconds of a core and bytes of a record; requests of a shard sent and read; milliseconds to make a clip.
    """
    with tempfile.TemporaryDirectory() as folder:
        out, bucket = Path(folder) / "records", f"/{Path(folder).name}"
        with context.progress_callback("making scenes") as report:
            rate, size = write_rate(config.scenes, out, report)
        records = RecordStore(out)
        shards = [name for name in records.files if name.startswith("contacts-")]
        mirror, calls = Mirror(f"memory:/{bucket}"), collections.Counter[str]()
        _count(mirror, calls)
        mirror.publish(out, shards)
        sent = calls.total() - calls["find"]  # one for all shards
        calls.clear()
        for name in shards:
            mirror.fetch(name)
        took = _clip_ms(records)
        fsspec.filesystem("memory").rm(bucket, recursive=True)
    requests = {"sent": sent / len(shards), "read": calls.total() / len(shards)}
    return {"cpu_ms": rate.cpu_ms, "bytes": size, **requests, "clip_ms": took}


def _count(mirror: Mirror, calls: collections.Counter[str]) -> None:
    """Count the requests of a mirror."""
    store = mirror._store

    class Counted:
        def __getattr__(self, name: str) -> Any:
            calls[name] += 1
            return getattr(store, name)

    mirror._store = Counted()


def _clip_ms(records: RecordStore) -> float:
    """Median milliseconds to make a clip of a contact."""
    took = []
    for i in range(min(len(records), 16)):
        began = time.perf_counter()
        make_clip(records.contact(i, fields=False), records.objects[records.contacts[i].object_id], ClipConfig())
        took.append(1e3 * (time.perf_counter() - began))
    return float(np.median(took))


def simulated(config: BillionConfig, units: Units, index: Units, machines: int) -> dict[str, Any]:
    """Hours to make all records on so many machines, what limits them, and a machine's time to its first batch."""
    assumed, shards = config.machine, config.records / RECORDS_PER_SHARD
    hours = {
        "compute": config.records * units["cpu_ms"] / 3.6e6 / assumed.cores / machines,
        "upload": config.records * units["bytes"] / 1e9 / assumed.bandwidth_gb_s / 3600 / machines,
        "the driver": shards * index["published_ms"] / 3.6e6,
        "requests": shards * units["sent"] / assumed.requests_per_s / 3600,
    }
    limit = max(hours, key=lambda name: hours[name])
    contacts = config.records / len(SENSORS) / config.scenes.frame_count
    shard_bytes, index_bytes = RECORDS_PER_SHARD * units["bytes"], index["bytes"] * contacts / index["contacts"]
    loaded_s = (config.batch * shard_bytes + index_bytes) / 1e9 / assumed.bandwidth_gb_s
    asked_s = (config.batch * units["read"] + 2) * assumed.latency_ms / 1e3 / assumed.cores
    opened_s = index["open_s"] * contacts / index["contacts"]
    return {
        "machines": machines,
        "limit": limit,
        **{f"{name}, h": value for name, value in hours.items()},
        "wall, h": hours[limit],
        "price": hours[limit] * machines * assumed.hourly_price,
        "first batch, s": loaded_s + asked_s + opened_s + config.batch * units["clip_ms"] / 1e3 / assumed.cores,
    }


def cost_table(config: BillionConfig, units: Units, index: Units) -> Table:
    """Counts of all records."""
    shards = config.records / RECORDS_PER_SHARD
    contacts = config.records / len(SENSORS) / config.scenes.frame_count
    figures = {
        "hours of a core": config.records * units["cpu_ms"] / 3.6e6,
        "TB": config.records * units["bytes"] / 1e12,
        "contacts": contacts,
        "shards": shards,
        "requests to write": shards * units["sent"],
        "requests to read all once": shards * units["read"],
        "GB of the index": index["bytes"] * contacts / index["contacts"] / 1e9,
        "s to open the index": index["open_s"] * contacts / index["contacts"],
        "MB of memory of a reader": index["peak_mb"] * contacts / index["contacts"],
    }
    rows = [{"figure": name, "simulated": round(value) if value >= 1000 else value} for name, value in figures.items()]
    return named_table(f"Simulated: all of {config.records:,} records", rows, formats={"simulated": ",.4g"})


SMOKE = BillionConfig(
    scenes=SceneConfig(objects=4, sequences=8 * len(SENSORS), image_px=28, contact_grid=24),
    indexed=(10**3, 10**5),
    publications=5,
)

EXPERIMENT = Experiment(name="scale_records", config=BillionConfig(), scales={"smoke": SMOKE}, run=run)
