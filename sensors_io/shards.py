"""ArrayRecord files as the data set uses them: written under a temporary name, read at random through one numbering."""

import dataclasses
import os
import pathlib
from collections.abc import Callable
from collections.abc import Sequence as Seq
from typing import TypeVar

from array_record.python.array_record_data_source import ArrayRecordDataSource
from array_record.python.array_record_module import ArrayRecordReader, ArrayRecordWriter

from sensors_io.codec import CorruptRecordsError, RecordsError

_OPTIONS = "group_size:1,zstd:1"
_T = TypeVar("_T")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shard:
    """One ArrayRecord file: its name, its number of entries and its size, which tells a truncated file at once."""

    file: str
    entries: int
    bytes: int

    def check(self, root: pathlib.Path) -> None:
        """Hold the file to the size that it had when it was written.

        Raises:
          CorruptRecordsError: it is missing, or shorter or longer.
        """
        path = root / self.file
        size = path.stat().st_size if path.is_file() else None
        if size != self.bytes:
            found = "is missing" if size is None else f"has {size} bytes where {self.bytes} were written"
            raise CorruptRecordsError(
                f"{path} {found}: copy it again from its source, or delete {root} and write it again"
            )


class ShardWriter:
    """An ArrayRecord file under a temporary name until it is published."""

    def __init__(self, root: pathlib.Path, name: str):
        self._path = root / f"{name}.arrayrecord"
        self._temporary = root / f".{name}.arrayrecord.tmp"
        self._writer = ArrayRecordWriter(_name(self._temporary), _OPTIONS)
        self._count = 0

    def write(self, data: bytes) -> int:
        """Append one entry and return its number in the shard."""
        self._writer.write(data)
        self._count += 1
        return self._count - 1

    def publish(self) -> Shard:
        """Close, count, sync and rename the file.  The writer reports no failure of its own: counting finds it."""
        self._writer.close()
        reader = ArrayRecordReader(_name(self._temporary))
        found = reader.num_records() if reader.ok() else 0
        reader.close()
        if found < self._count:
            raise RecordsError(f"{self._path}: {found} of {self._count} entries reached the disk; check its free space")
        with self._temporary.open("rb") as file:
            os.fsync(file.fileno())
        self._temporary.replace(self._path)
        return Shard(file=self._path.name, entries=found, bytes=self._path.stat().st_size)


class Entries:
    """Entries of several shards, numbered through; files are opened when they are first read."""

    def __init__(self, root: pathlib.Path, shards: Seq[Shard]):
        for shard in shards:
            shard.check(root)
        self._files = [(root / shard.file, shard.entries) for shard in shards]
        paths = [
            f"{_name(file)}[0:{entries}]" for file, entries in self._files
        ]  # the range spares opening each to count it
        self._source = ArrayRecordDataSource(paths) if paths else []

    def decode(self, i: int, decode: Callable[[bytes], _T]) -> _T:
        """Entry i, decoded; errors get the path of its file."""
        try:
            return decode(self._source[i])
        except (RuntimeError, CorruptRecordsError) as error:
            file, position = self._locate(i)
            raise CorruptRecordsError(
                f"{file}, entry {position}: {error}; copy the file again from its source, or write the records again"
            ) from error

    def _locate(self, i: int) -> tuple[pathlib.Path, int]:
        for file, entries in self._files:
            if i < entries:
                return file, i
            i -= entries
        raise IndexError(i)


def _name(path: pathlib.Path) -> str:
    """The path as ArrayRecord takes it.

    Raises:
      RecordsError: a name of one of its folders is no UTF-8, or of several lines.
    """
    name = str(path)
    if "\n" in name or os.fsencode(name).decode(errors="replace") != name:
        raise RecordsError(f"{name!r} is no path that records can have: must be one line of UTF-8; rename its folder")
    return name
