"""Tables of an index: files that grow, of which the root of the index says as much as is visible, and contacts in them.

A row of `contacts` is 21 bytes and one for each sensor, so that 10⁷ contacts are a quarter of a gigabyte that nobody
parses: it is mapped, and a row is read when it is asked for.
"""

import collections.abc
import dataclasses
import mmap
import os
import pathlib
import zlib
from collections.abc import Mapping
from collections.abc import Sequence as Seq
from typing import Any, Self

import numpy as np

from sensors_io.codec import CorruptRecordsError
from sensors_io.schema import MOTIONS, ContactKey

NO_SENSOR = 255
"""Number in a row that stands for no further sensor."""

SHARD = np.dtype([("number", "<u4"), ("entries", "<u4"), ("bytes", "<u8")])
"""One ArrayRecord file: the number in its name, its entries, and its size, which shows if it is truncated."""

_CHUNK = 1 << 24
_MIX = tuple(np.uint64(x) for x in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0xD6E8FEB86659FD93))


def contact_dtype(sensors: int) -> np.dtype:
    """A row of `contacts`: its key, its first entry of all shards, and its sensors in the order of its entries."""
    key = [("object", "<u4"), ("site", "<u4"), ("trial", "<u4"), ("motion", "u1")]
    return np.dtype([*key, ("entry", "<u8"), ("sensors", "u1", (sensors,))])


@dataclasses.dataclass(frozen=True, kw_only=True)
class GrowingFile:
    """A file of which the first `size` bytes count; `crc32` is theirs.  What lies behind was never published."""

    file: str
    size: int = 0
    crc32: int = 0

    def append(self, root: pathlib.Path, data: bytes) -> Self:
        """The file with more at its end, synced; it becomes visible with the root that states it."""
        path = root / self.file
        with path.open("r+b" if path.exists() else "w+b") as file:
            file.seek(self.size)
            file.write(data)
            file.truncate()
            file.flush()
            os.fsync(file.fileno())
        size = self.size + len(data)
        return dataclasses.replace(self, size=size, crc32=zlib.crc32(data, self.crc32))

    def read(self, path: pathlib.Path, dtype: np.dtype) -> np.ndarray:
        """Its rows, mapped.

        Args:
          path: where it lies.
          dtype: of a row.

        Raises:
          CorruptRecordsError: it is missing or shorter, or its checksum does not hold.
        """
        if fault := self._fault(path, dtype):
            raise CorruptRecordsError(
                f"{path} {fault}; copy it again from its source, or delete {path.parent} and write it again"
            )
        return np.memmap(path, dtype, "r", shape=(self.size // dtype.itemsize,))

    def _fault(self, path: pathlib.Path, dtype: np.dtype) -> str:
        """Reason why it cannot be read; empty if there is none.  No more is read than is there, whatever is stated."""
        if not path.is_file():
            return "is missing"
        there, crc, left = path.stat().st_size, 0, self.size
        if there < self.size:
            return f"has {there} bytes where {self.size} were written"
        with path.open("rb") as file:
            while left > 0 and (chunk := file.read(min(left, _CHUNK))):
                crc, left = zlib.crc32(chunk, crc), left - len(chunk)
        whole = not left and crc == self.crc32 and not self.size % dtype.itemsize
        return "" if whole else "is damaged: its checksum does not hold"


class ContactTable(collections.abc.Sequence[ContactKey]):
    """The keys of all contacts, and where their entries are, by number and by key.

    Args:
      rows: of `contact_dtype`.
      objects: ids that the rows number.
      sensors: names that the rows number.
      motions: names that the rows number.
    """

    def __init__(self, rows: np.ndarray, objects: Seq[str], sensors: Seq[str], motions: Seq[str] = MOTIONS):
        self.rows, self._objects, self._sensors, self._motions = rows, objects, tuple(sensors), tuple(motions)
        self._sorted: np.ndarray | None = None
        self._numbers: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return tuple(self[j] for j in range(*i.indices(len(self))))
        row = self.rows[i]
        try:
            name, motion = self._objects[row["object"]], self._motions[row["motion"]]
        except IndexError as error:  # by which Python ends a loop: contacts would be missing without a word
            raise _of_two(
                f"contact {i} is of object {row['object']} of {len(self._objects)} and motion {row['motion']} of "
                f"{len(self._motions)}"
            ) from error
        return ContactKey(object_id=name, site=int(row["site"]), motion=motion, trial=int(row["trial"]))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, collections.abc.Sequence):
            return NotImplemented
        return len(self) == len(other) and all(a == b for a, b in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def entries(self, i: int) -> Mapping[str, int]:
        """Entry of each sensor that saw contact i, counted through all shards."""
        row = self.rows[i]
        numbers = row["sensors"][row["sensors"] != NO_SENSOR]
        try:
            return {self._sensors[n]: int(row["entry"]) + k for k, n in enumerate(numbers)}
        except IndexError as error:
            raise _of_two(f"contact {i} is of sensors {numbers.tolist()} of {len(self._sensors)}") from error

    def find(self, key: ContactKey) -> int | None:
        """Number of the contact with a key, `None` if there is none; the first search sorts hashes of all keys."""
        if self._sorted is None:
            self._sorted, self._numbers = self._sort(), {name: n for n, name in enumerate(self._objects)}
        number = self._numbers.get(key.object_id)
        if number is None or key.motion not in self._motions or not len(self):
            return None
        wanted = [np.uint64(x) for x in (number, key.site, key.trial, self._motions.index(key.motion))]
        low = _hashed(*wanted) & ~self._mask
        for packed in self._sorted[np.searchsorted(self._sorted, low) :]:
            if packed & ~self._mask != low:
                return None
            if self[found := int(packed & self._mask)] == key:
                return found
        return None

    @property
    def _mask(self) -> np.uint64:
        """Bits of a packed hash that number a contact."""
        return np.uint64((1 << max(1, len(self).bit_length())) - 1)

    def _sort(self) -> np.ndarray:
        """Hashes of all keys, each with the number of its contact in its low bits, ascending: uint64 [contacts]."""
        packed = np.empty(len(self), np.uint64)
        for start in range(0, len(self), _CHUNK >> 4):
            rows = self.rows[start : start + (_CHUNK >> 4)]
            fields = (rows[name].astype(np.uint64) for name in ("object", "site", "trial", "motion"))
            numbers = np.arange(start, start + len(rows), dtype=np.uint64)
            packed[start : start + len(rows)] = (_hashed(*fields) & ~self._mask) | numbers
        packed.sort()
        forget(self.rows)
        return packed


def _of_two(text: str) -> CorruptRecordsError:
    return CorruptRecordsError(f"{text}: root and tables are of two indices; copy all of them again from their source")


def forget(rows: np.ndarray) -> None:
    """Give back the memory of mapped rows that were scanned; they are read again when they are asked for."""
    if isinstance(rows, np.memmap) and hasattr(mmap, "MADV_DONTNEED"):
        rows._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]


def _hashed(*fields: Any) -> Any:
    """A hash of 64 bits of numbers or arrays of them (the finalizer of SplitMix64 after each)."""
    with np.errstate(over="ignore"):
        mixed = _MIX[0]
        for field in fields:
            mixed = (mixed ^ field) * _MIX[1]
            mixed = (mixed ^ (mixed >> np.uint64(27))) * _MIX[2]
            mixed = mixed ^ (mixed >> np.uint64(31))
    return mixed
