"""Arrays of .npy and .npz files that come from outside: read whole, or refused with the reason."""

import lzma
import math
import os
import pathlib
import struct
import tokenize
import zipfile
import zlib
from typing import IO

import numpy as np

from sensors_io.errors import MALFORMED, UserError, of_system
from sensors_io.json_files import require_regular

_BROKEN = (
    *MALFORMED, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, tokenize.TokenError,
)  # fmt: skip
"""Errors that damaged bytes raise in NumPy and zipfile."""

_LONGEST_END = 2**16 + 22
"""Bytes of the end of a zip archive with the longest comment; it states the number of entries."""


class ArraysError(UserError, ValueError):
    """A file that holds no readable arrays."""


def load_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Arrays of an .npz by name; of an .npy its one array, by the file's stem.

    No memory is reserved before an array's stated size was seen to be that of its bytes, and nothing is unpickled.

    Raises:
      ArraysError: the file is absent, damaged, or holds objects.
    """
    path = pathlib.Path(path)
    try:
        require_regular(path)
        if path.suffix == ".npy":
            with path.open("rb") as file:
                return {path.stem: _array(file, path.stat().st_size)}
        with zipfile.ZipFile(path) as archive:
            _require_all(archive, path)
            found = {}
            for member in archive.infolist():
                with archive.open(member) as file:
                    found[member.filename.removesuffix(".npy")] = _array(file, member.file_size)
            if len(found) < len(archive.infolist()):
                raise ValueError("it holds two arrays of one name")
            return found
    except _BROKEN as error:
        if of_system(error):
            raise
        reason = str(error).partition("\n")[0][:200]  # NumPy's further lines say how to trust the file
        raise ArraysError(f"{path} cannot be read as arrays ({reason}); copy it again from its source") from error


def _require_all(archive: zipfile.ZipFile, path: pathlib.Path) -> None:
    """Refuse an archive of which some entries are hidden, as by a flipped bit in the length of a comment."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _LONGEST_END))
        end = file.read()
    (stated,) = struct.unpack_from("<H", end, end.rfind(b"PK\5\6") + 10)
    if stated not in (len(archive.infolist()), 0xFFFF):  # more than 2¹⁶ are counted elsewhere
        raise ValueError(f"it states {stated} entries and shows {len(archive.infolist())}")


def _array(file: IO[bytes], size: int) -> np.ndarray:
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"its format is {version}: must be (1, 0) or (2, 0)")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    wanted = file.tell() + math.prod(shape) * dtype.itemsize
    if wanted != size:
        raise ValueError(f"its header states {wanted} bytes of {size}")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
