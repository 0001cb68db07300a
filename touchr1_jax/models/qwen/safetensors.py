"""The safetensors file format, read tensor by tensor into memory of its own, and written as it comes.

A file is a little-endian uint64 n, n bytes of JSON {name: {dtype, shape, data_offsets}} and the tensors' bytes in
row-major order, offsets counted from the end of the JSON.  The published library maps files into memory, where the
pages of a shard of several gigabytes count as long as it is open; here one tensor at a time is read and let go.
"""

import json
import math
import os
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

DTYPES: Mapping[str, np.dtype] = {
    "F32": np.dtype(np.float32),
    "F16": np.dtype(np.float16),
    "BF16": np.dtype(jnp.bfloat16),
}
"""Types of tensors that can be weights, by the format's names."""

STORED: Mapping[str, np.dtype] = {**DTYPES, "I8": np.dtype(np.int8)}
"""Types of tensors that are read and written; whole numbers are weights only together with a scale."""

METADATA = "__metadata__"
POINTER = b"version "
"""Begins what stands in the place of a file that Git LFS has not fetched."""

MAX_HEADER = 100_000_000
"""Longest header, bytes; the format forbids more, and a file of another format would seem to ask for exabytes."""


ReportBytes = Callable[[int, int], None]
"""Called with the bytes done, and all bytes."""


class TensorEntry(NamedTuple):
    """Where a tensor lies: its type by the format's name, its shape, its bytes from `start` to `end` of the file."""

    path: Path
    dtype: str
    shape: tuple[int, ...]
    start: int
    end: int

    @property
    def size(self) -> int:
        """Its bytes."""
        return self.end - self.start


class Deferred(NamedTuple):
    """A tensor that is made when it is written."""

    dtype: np.dtype
    shape: tuple[int, ...]
    make: Callable[[], np.ndarray]


def read_header(path: Path) -> dict[str, TensorEntry]:
    """Tensors of a file.

    Raises:
      ValueError: not this format, not fetched, cut off, or an entry that contradicts itself.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        prefix = file.read(8)
        if prefix == POINTER:
            raise ValueError(f"{path} points to a file of Git LFS that was not fetched; fetch it by `git lfs pull`")
        length = struct.unpack("<Q", prefix)[0] if len(prefix) == 8 else MAX_HEADER + 1
        if length > min(MAX_HEADER, size - 8):
            raise ValueError(f"{path} is no safetensors file or was cut off: its header does not fit; fetch it again")
        try:
            header = json.loads(file.read(length))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: the header is no JSON ({error}); fetch it again") from error
    if not isinstance(header, dict):
        raise ValueError(f"{path}: the header is no JSON object; fetch it again")
    tensors = {name: x for name, x in header.items() if name != METADATA}
    return {name: _entry(path, name, x, 8 + length, size) for name, x in tensors.items()}


def read_tensor(entry: TensorEntry) -> np.ndarray:
    """One tensor, read into fresh memory.

    Raises:
      ValueError: the file got shorter since its header was read.
    """
    dtype = STORED[entry.dtype]
    with entry.path.open("rb") as file:
        data = np.fromfile(file, dtype, entry.size // dtype.itemsize, offset=entry.start)
    if data.nbytes != entry.size:
        raise ValueError(f"{entry.path} ends inside a tensor, {data.nbytes} bytes of {entry.size}")
    return data.reshape(entry.shape)


def write_file(
    path: Path,
    tensors: Mapping[str, np.ndarray | Deferred],
    progress: ReportBytes = lambda done_bytes, all_bytes: None,
) -> None:
    """Write tensors to a file, whole or not at all, one after the other.

    Args:
      path: of the file.
      tensors: by name.
      progress: called after each tensor.

    Raises:
      ValueError: a tensor of a type that is not stored, or a deferred one that is made unlike its description.
    """
    names = {dtype: name for name, dtype in STORED.items()}
    header: dict[str, dict[str, Any]] = {}
    end = 0
    for name, x in tensors.items():
        if x.dtype not in names:
            raise ValueError(f"{name} is {x.dtype}: must be one of {', '.join(map(str, names))}; cast it")
        size = math.prod(x.shape) * x.dtype.itemsize
        header[name] = {"dtype": names[x.dtype], "shape": x.shape, "data_offsets": (end, end + size)}
        end += size
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)  # tensors start at a multiple of 8, as the format recommends
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for name, x in tensors.items():
            made = x.make() if isinstance(x, Deferred) else x
            if (made.dtype, made.shape) != (x.dtype, x.shape):
                raise ValueError(f"{name} is {made.dtype} {made.shape}: must be {x.dtype} {x.shape}; correct it")
            file.write(np.ascontiguousarray(made).reshape(-1).view(np.uint8).data)  # `tofile` hides the system's error
            progress(header[name]["data_offsets"][1], end)
    os.replace(partial, path)


def _entry(path: Path, name: str, found: Any, body: int, size: int) -> TensorEntry:
    """One entry of a header whose tensors start at byte `body`, checked against its own shape and the file."""
    fields = {"dtype", "shape", "data_offsets"} - {*(found if isinstance(found, dict) else ())}
    if fields:
        raise ValueError(f"{path}: {name} lacks {', '.join(sorted(fields))}; fetch the file again")
    sizes = [found["shape"], found["data_offsets"]]
    whole = all(isinstance(x, list) and all(type(n) is int and 0 <= n < 2**60 for n in x) for x in sizes)
    if not whole or len(found["data_offsets"]) != 2:
        raise ValueError(f"{path}: shape and data_offsets of {name} are {sizes}: must be sizes; fetch the file again")
    if not isinstance(found["dtype"], str):
        raise ValueError(f"{path}: dtype of {name} is {found['dtype']}: must be a type's name; fetch the file again")
    start, end = (body + offset for offset in found["data_offsets"])
    entry = TensorEntry(path, found["dtype"], tuple(found["shape"]), start, end)
    if entry.dtype in STORED:
        needed = STORED[entry.dtype].itemsize * math.prod(entry.shape)
        if entry.size != needed:
            raise ValueError(
                f"{entry.path}: {name} has {entry.size} bytes, its type and shape need {needed}; fetch the file again"
            )
    if entry.end > size:
        raise ValueError(f"{entry.path} was cut off: {name} ends at byte {entry.end} of {size}; fetch it again")
    return entry
