"""ArrayRecord files as the data set uses them: written under a temporary name, read at random through one numbering."""

import collections
import contextlib
import errno
import os
import pathlib
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
from array_record.python.array_record_data_source import ArrayRecordDataSource
from array_record.python.array_record_module import ArrayRecordReader, ArrayRecordWriter

from sensors_io.codec import CorruptRecordsError, RecordsError
from sensors_io.remote import Mirror, Place, local
from sensors_io.tables import SHARD

_OPTIONS = "group_size:1,zstd:1"
_OPEN = 128
"""Files that stay open: a process may open 1,024 on many systems, and a large data set has more shards."""

_T = TypeVar("_T")


def shard_file(kind: str, number: int) -> str:
    """Name of a shard of `contacts` or `objects`."""
    return f"{kind}-{number:05d}.arrayrecord"


def is_shard(file: str) -> bool:
    """True for a name that `shard_file` gives; copies that people and programs make have others."""
    return re.fullmatch(r"(contacts|objects)-\d{5,}\.arrayrecord", file) is not None


class ShardWriter:
    """An ArrayRecord file under a temporary name until it is published."""

    def __init__(self, root: pathlib.Path, kind: str, number: int):
        self._number, self._path = number, root / shard_file(kind, number)
        self._temporary = root / f".{self._path.name}.{os.getpid()}.tmp"  # two workers may try the same
        with self._writing():
            self._writer = ArrayRecordWriter(array_record_name(self._temporary), _OPTIONS)
        self._count = 0

    def write(self, data: bytes) -> None:
        """Append one entry."""
        with self._writing():
            self._writer.write(data)
        self._count += 1

    def publish(self) -> np.ndarray:
        """Close, count, sync and rename the file; its row.  The writer reports not every failure: counting finds it.

        Raises:
          RecordsError: not all of it reached the disk.
        """
        with self._writing():
            self._writer.close()
        reader = ArrayRecordReader(array_record_name(self._temporary))
        found = reader.num_records() if reader.ok() else 0
        reader.close()
        if found < self._count:
            self._remove()
            raise RecordsError(f"{self._path}: {found} of {self._count} entries reached the disk; check its free space")
        with self._temporary.open("rb") as file:
            os.fsync(file.fileno())
        self._temporary.replace(self._path)
        return np.array((self._number, found, self._path.stat().st_size), SHARD)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            self._remove()
            raise RecordsError(
                f"{self._path} cannot be written ({error}): free some space, or make its folder writable; what was "
                "published before is kept, and the same command goes on"
            ) from error

    def _remove(self) -> None:
        """Remove the temporary file, which nobody would look for if the same command is not run again."""
        with contextlib.suppress(OSError):  # the folder cannot be written, which is what the caller reports
            self._temporary.unlink(missing_ok=True)


class Entries:
    """Entries of several shards, numbered through; files are opened when they are first read, and not all stay open.

    Args:
      root: where they lie.
      kind: `contacts` or `objects`.
      shards: rows of `SHARD`.

    Raises:
      CorruptRecordsError: a file on this machine is missing, or has not the size that it had when it was written.
    """

    def __init__(self, root: Place, kind: str, shards: np.ndarray):
        self._root, self._kind, self._shards = root, kind, shards
        self._ends = np.cumsum(shards["entries"], dtype=np.int64)
        self._open: collections.OrderedDict[int, ArrayRecordDataSource] = collections.OrderedDict()
        self._lock = threading.Lock()
        if isinstance(root, pathlib.Path):
            for number, size in zip(shards["number"].tolist(), shards["bytes"].tolist(), strict=True):
                _check_size(root / shard_file(kind, number), size)

    def decode(self, i: int, decode: Callable[[bytes], _T]) -> _T:
        """Entry i, decoded; errors get the path of its file."""
        shard = int(np.searchsorted(self._ends, i, side="right"))
        place = i - int(self._ends[shard] - self._shards["entries"][shard])
        try:
            return decode(self._source(shard)[place])
        except (RuntimeError, CorruptRecordsError) as error:
            file = f"{self._root}/{shard_file(self._kind, self._shards['number'][shard])}"
            if os.strerror(errno.EMFILE) in str(error):
                raise RecordsError(f"{file} cannot be opened ({error}): raise the limit of open files") from error
            raise CorruptRecordsError(
                f"{file}, entry {place}: {error}; copy the file again from its source, or write the records again"
            ) from error

    def fetch_ahead(self, entries: Iterable[int]) -> None:
        """Begin to copy the files of entries, in their order, if they lie at a URL."""
        if isinstance(self._root, Mirror):
            self._root.fetch_ahead(self._files(entries))

    def _files(self, entries: Iterable[int]) -> Iterator[tuple[str, int]]:
        """Name and bytes of the files of entries, each once."""
        seen = set[int]()
        for i in entries:
            shard = int(np.searchsorted(self._ends, i, side="right"))
            if shard not in seen:
                seen.add(shard)
                yield shard_file(self._kind, self._shards["number"][shard]), int(self._shards["bytes"][shard])
            if len(seen) == len(self._shards):
                return

    def _source(self, shard: int) -> ArrayRecordDataSource:
        with self._lock:
            if shard in self._open:
                self._open.move_to_end(shard)
                return self._open[shard]
        row = self._shards[shard]
        path = local(self._root, shard_file(self._kind, row["number"]), size=int(row["bytes"]))
        spared = f"{array_record_name(path)}[0:{row['entries']}]"  # the range spares opening it to count it
        source = ArrayRecordDataSource([spared])
        with self._lock:
            source = self._open.setdefault(shard, source)
            if len(self._open) > _OPEN:
                self._open.popitem(last=False)  # closed when its last reader is done with it
        return source


def _check_size(path: pathlib.Path, bytes_: int) -> None:
    try:
        size = os.stat(path).st_size
    except FileNotFoundError:
        size = None
    if size != bytes_:
        found = "is missing" if size is None else f"has {size} bytes where {bytes_} were written"
        raise CorruptRecordsError(
            f"{path} {found}: copy it again from its source, or delete {path.parent} and write it again"
        )


def array_record_name(path: pathlib.Path) -> str:
    """The path as ArrayRecord takes it.

    Raises:
      RecordsError: a name of one of its folders is no UTF-8, or of several lines.
    """
    name = str(path)
    if "\n" in name or os.fsencode(name).decode(errors="replace") != name:
        raise RecordsError(f"{name!r} is no path that records can have: must be one line of UTF-8; rename its folder")
    return name
