"""A file for HDF5, whose library crashes at its close after a write that failed."""

import io
import os
import pathlib

from sensors_io.exporters.selection import ExportError


class KeptFile(io.RawIOBase):
    """A new file of which no write fails: from the first that does on, as on a full disk, what is written is kept.

    Whoever asks `require_written` after each array has no more to keep than what the library itself had not written.
    """

    def __init__(self, path: pathlib.Path) -> None:
        super().__init__()
        self._file = path.open("w+b", buffering=0)
        self._path, self._at, self._end = path, 0, 0
        self._error: OSError | None = None
        self._kept: list[tuple[int, bytes]] = []

    def require_written(self) -> None:
        """Refuse to go on after a write that failed.

        Raises:
          ExportError: one did.
        """
        if self._error is not None:
            raise ExportError(
                f"{self._path} cannot be written ({self._error.strerror}): free some space, or name another path"
            )

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._end}[whence]
        return self._at

    def write(self, data: object) -> int:
        content = bytes(data)  # type: ignore[call-overload]
        try:
            if self._error is None:
                self._file.seek(self._at)
                rest = memoryview(content)
                while rest:
                    rest = rest[self._file.write(rest) :]
        except OSError as error:
            self._error = error
        if self._error is not None:
            self._kept.append((self._at, content))
        self._at += len(content)
        self._end = max(self._end, self._at)
        return len(content)

    def readinto(self, buffer: object) -> int:
        view = memoryview(buffer).cast("B")  # type: ignore[arg-type]
        self._file.seek(self._at)
        size = min(len(view), max(self._end - self._at, 0))
        view[:size] = self._file.read(size).ljust(size, b"\0")
        for start, content in self._kept:
            first, last = max(start, self._at), min(start + len(content), self._at + size)
            if first < last:
                view[first - self._at : last - self._at] = content[first - start : last - start]
        self._at += size
        return size

    def truncate(self, size: int | None = None) -> int:
        self._end = self._at if size is None else size
        try:
            self._file.truncate(self._end)
        except OSError as error:
            self._error = self._error or error
        return self._end

    def close(self) -> None:
        self._file.close()
        super().close()
