"""An append-only file that a killed process leaves readable up to its last whole entry.

    magic (4 bytes) | size of the body (u32) | crc32 of the body (u32) | body | …
    body: length of the header (u32) | header (JSON: kind, plain values, type and shape of each array) | arrays

Every entry is one `writev`, after which its bytes belong to the kernel: whatever ends the process, a SIGKILL too, they
reach the file.  A loss of power may cost what was written since the last `fsync`, at most a second.
"""

import contextlib
import dataclasses
import json
import mmap
import os
import pathlib
import re
import struct
import time
import zlib
from collections.abc import Iterator, Mapping
from typing import Any, Self

import numpy as np

from sensors_io.errors import MALFORMED, UserError
from sensors_io.json_files import require_regular

_MAGIC = b"TJR1"
_PREFIX = struct.Struct("<4sII")
_HEADER_SIZE = struct.Struct("<I")
_SYNC_EVERY_S = 1.0


class JournalError(UserError, ValueError):
    """A file that is no journal, or is damaged before its end."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JournalEntry:
    """One entry: its kind, plain values and arrays."""

    kind: str
    plain: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]


class JournalWriter:
    """Appends entries to a new file; leaving the block closes it.

    Raises:
      FileExistsError: the file is there already.
    """

    def __init__(self, path: pathlib.Path):
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        self._synced_s = time.monotonic()

    def append(self, kind: str, plain: Mapping[str, Any], **arrays: np.ndarray) -> None:
        """Hand one entry to the operating system.

        Raises:
          OSError: the disk is full; what was written before stays readable.
        """
        data = {name: np.asarray(a, order="C") for name, a in arrays.items()}
        described = [[name, a.dtype.str, list(a.shape)] for name, a in data.items()]
        header = json.dumps({"kind": kind, "plain": plain, "arrays": described}, allow_nan=False).encode()
        parts: list[bytes] = [_HEADER_SIZE.pack(len(header)), header, *(a.tobytes() for a in data.values())]
        checksum = 0
        for part in parts:
            checksum = zlib.crc32(part, checksum)
        size = sum(len(part) for part in parts)
        self._write([_PREFIX.pack(_MAGIC, size, checksum), *parts])
        now_s = time.monotonic()
        if now_s - self._synced_s >= _SYNC_EVERY_S:
            os.fdatasync(self._file)
            self._synced_s = now_s

    @property
    def size(self) -> int:
        """Bytes of all entries so far."""
        return os.fstat(self._file).st_size

    @contextlib.contextmanager
    def only_since(self, size: int) -> Iterator[None]:
        """Forget the entries before a former `size`; what the block appends precedes the others."""
        others, at = list[bytes](), size
        while part := os.pread(self._file, self.size - at, at):  # at most 2 GiB at a time
            others.append(part)
            at += len(part)
        os.ftruncate(self._file, 0)
        yield
        self._write(others)

    def close(self) -> None:
        """Bring everything to the disk."""
        os.fsync(self._file)
        os.close(self._file)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _write(self, parts: list[bytes]) -> None:
        size = sum(len(part) for part in parts)
        written = os.writev(self._file, parts)
        if written < size:  # a signal or a nearly full disk cut it: the rest, or an error that says why
            rest = memoryview(b"".join(parts))[written:]
            while rest:
                rest = rest[os.write(self._file, rest) :]


def read_journal(path: pathlib.Path) -> list[JournalEntry]:
    """All whole entries, without a last one that was cut off.

    Raises:
      JournalError: an entry that is damaged though others follow it, or no file.
    """
    try:
        require_regular(path)
    except ValueError as error:
        raise JournalError(f"{path} is no journal ({error}): move it away") from error
    with path.open("rb") as file:  # mapped: a long contact is gigabytes
        size = os.fstat(file.fileno()).st_size
        try:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
        except OSError:  # a file system without maps
            data = path.read_bytes()
    return list(_entries(path, memoryview(data)))


def _entries(path: pathlib.Path, data: memoryview) -> Iterator[JournalEntry]:
    start = 0
    while start + _PREFIX.size <= len(data):
        magic, size, checksum = _PREFIX.unpack_from(data, start)
        end = start + _PREFIX.size + size
        body = data[start + _PREFIX.size : end]
        torn = end > len(data)
        whole = zlib.crc32(body) == checksum
        if magic != _MAGIC or torn == whole or (torn and _goes_on(data[start + len(_MAGIC) :])):
            raise JournalError(f"{path} is damaged at byte {start}: move it away, its contact has to be recorded again")
        if torn:
            return
        try:
            entry = _decode(body)
        except MALFORMED as error:
            raise JournalError(
                f"{path} holds an entry of another layout at byte {start} ({error!r}): move it away, or bring it in "
                "with the version that wrote it"
            ) from error
        yield entry
        start = end


def _goes_on(rest: memoryview) -> bool:
    """True if a whole entry lies behind one that seems cut off: its size is damaged, and nothing was cut off."""
    for match in re.finditer(re.escape(_MAGIC), rest):
        if match.start() + _PREFIX.size <= len(rest):
            _, size, checksum = _PREFIX.unpack_from(rest, match.start())
            body = rest[match.start() + _PREFIX.size :][:size]
            if len(body) == size and zlib.crc32(body) == checksum:
                return True
    return False


def _decode(body: memoryview) -> JournalEntry:
    (length,) = _HEADER_SIZE.unpack_from(body)
    start = _HEADER_SIZE.size + length
    header = json.loads(bytes(body[_HEADER_SIZE.size : start]))
    arrays = {}
    for name, kind, shape in header["arrays"]:
        dtype, count = np.dtype(kind), int(np.prod(shape))
        arrays[name] = np.frombuffer(body, dtype, count, start).reshape(shape) if count else np.zeros(shape, dtype)
        start += count * dtype.itemsize
    return JournalEntry(kind=header["kind"], plain=dict(header["plain"]), arrays=arrays)
