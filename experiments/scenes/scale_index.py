"""The index of a data set of many contacts that were never recorded: what it costs to open, search and extend it."""

import multiprocessing
import re
import statistics
import time
from pathlib import Path

import numpy as np

from sensors_io.index import Index, Part, RecordsMeta
from sensors_io.schema import MOTIONS, SENSORS, ContactKey
from sensors_io.tables import SHARD

META = RecordsMeta(source="synthetic", licence="none", config_hash="none", sensors=SENSORS)
PER_SHARD, PER_OBJECT, SEARCHES = 1000, 100, 200


def index_cost(root: Path, contacts: int, publications: int) -> dict[str, float]:
    """Write the index of so many contacts in an empty folder, then measure it in a process of its own.

    Returns:
      `open_s`, `open_cpu_s`: seconds of the clock and of a core to open it; `peak_mb`: memory of a process that opens
      it, searches it and draws a split, above that of the imports; `find_ms`: of the clock for one contact by its key,
      after the first search, which sorts for `sort_s`; `publish_ms`: median of a core to make one more shard visible;
      `published_ms`: of the clock for the same, which waits for the disk; `contacts`, `bytes` of its files.
    """
    index = _written(root, contacts)
    size = sum(file.stat().st_size for file in root.iterdir())
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        read = pool.apply(_read, (root, contacts))
    numbers = {name: n for n, name in enumerate(index.objects)}
    spent = []
    for n in range(publications):
        rows = tuple(("object_0", contacts + n, trial, MOTIONS[0], SENSORS) for trial in range(PER_SHARD))
        part = Part(shard=(contacts + n, len(rows) * len(SENSORS), 1), contacts=rows, frames={})
        began = time.process_time(), time.perf_counter()
        index.add_part(root, part, numbers, (contacts + n * PER_SHARD) * len(SENSORS))
        index.write(root)
        spent.append((time.process_time() - began[0], time.perf_counter() - began[1]))
    cpu_ms, ms = (1e3 * statistics.median(each) for each in zip(*spent, strict=True))
    return {"contacts": contacts, **read, "publish_ms": cpu_ms, "published_ms": ms, "bytes": size}


def _written(root: Path, contacts: int) -> Index:
    index, objects = Index.new(META), max(1, contacts // PER_OBJECT)
    index.objects = [f"object_{n}" for n in range(objects)]
    index.add_objects(root, np.zeros(0, SHARD), dict.fromkeys(index.objects, "train"))
    for start in range(0, contacts, 10**6):
        n = np.arange(start, min(start + 10**6, contacts))
        rows = np.zeros(len(n), index.contacts.rows.dtype)
        rows["object"], rows["trial"], rows["entry"] = n % objects, n // objects, n * len(SENSORS)
        rows["sensors"] = np.arange(len(SENSORS))
        index.tables["contacts"] = index.tables["contacts"].append(root, rows.tobytes())
    shards = np.zeros(-(-contacts // PER_SHARD), SHARD)
    shards["number"], shards["entries"], shards["bytes"] = np.arange(len(shards)), PER_SHARD * len(SENSORS), 1
    index.tables["contact-shards"] = index.tables["contact-shards"].append(root, shards.tobytes())
    index.complete = True
    index.write(root)
    return index


def _read(root: Path, contacts: int) -> dict[str, float]:
    """In a process of its own, whose memory is that of the index."""
    kept = _memory_mb("VmRSS")
    began, began_cpu = time.perf_counter(), time.process_time()
    index = Index.read(root)
    open_s, open_cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
    objects = len(index.objects)
    key = lambda n: ContactKey(object_id=f"object_{n % objects}", site=0, motion=MOTIONS[0], trial=n // objects)
    began = time.perf_counter()
    index.contacts.find(key(0))
    sort_s, drawn = time.perf_counter() - began, np.random.default_rng(0).integers(contacts, size=SEARCHES).tolist()
    began = time.perf_counter()
    found = [index.contacts.find(key(n)) for n in drawn]
    find_ms = 1e3 * (time.perf_counter() - began) / SEARCHES
    if found != drawn:
        raise RuntimeError(f"the index finds {found[:3]} where {drawn[:3]} were asked for: mend `ContactTable.find`")
    np.flatnonzero(np.ones(objects, bool)[index.contacts.rows["object"]])  # as `RecordStore.contacts_of_split`
    peak_mb = _memory_mb("VmHWM") - kept
    return {"open_s": open_s, "open_cpu_s": open_cpu_s, "peak_mb": peak_mb, "find_ms": find_ms, "sort_s": sort_s}


def _memory_mb(name: str) -> float:
    """Memory of this process now, `VmRSS`, or its peak, `VmHWM`; that of getrusage would be the parent's too."""
    (found,) = re.findall(rf"^{name}:\s+(\d+) kB$", Path("/proc/self/status").read_text(encoding="utf-8"), re.MULTILINE)
    return int(found) / 1024
