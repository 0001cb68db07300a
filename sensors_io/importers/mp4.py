"""Boxes of an MP4 or QuickTime file (ISO/IEC 14496-12), which show whether it is whole."""

import mmap
import pathlib
import struct
from collections.abc import Iterator

import numpy as np

from sensors_io.errors import MALFORMED

SUFFIXES = (".mp4", ".m4v", ".mov")

_MOST = 10**6  # samples that a table is believed


def is_cut_off(path: pathlib.Path, stated: int, count: int) -> bool:
    """True if the end of a video is missing, or pictures within it.

    What OpenCV states counts pictures that an edit list trims; of a file in fragments it is their rate times the length
    of the longest stream.  Such a file is whole if it ends with the index of its fragments, which is written last; one
    without it, as a recorder that is killed leaves it, is judged by what is stated.

    Args:
      path: of the video.
      stated: pictures by OpenCV.
      count: pictures that can be decoded.
    """
    with path.open("rb") as file:
        try:
            return _is_cut_off(memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)), stated, count)
        except (*MALFORMED, StopIteration, OSError):  # the last: of file systems that map no files
            return count < stated


def _is_cut_off(data: memoryview, stated: int, count: int) -> bool:
    moov = next(body for kind, body in _boxes(data) if kind == b"moov")
    fragmented = any(kind == b"mvex" for kind, _ in _boxes(moov))
    try:
        *_, (last, _) = top = list(_boxes(data))
    except (ValueError, struct.error):
        return fragmented or count < stated  # else bytes may follow that are no box
    tracks = (body for kind, body in _boxes(moov) if kind == b"trak")
    track = next(body for body in tracks if _at(body, b"mdia", b"hdlr")[8:12] == b"vide")
    if not fragmented:
        return count < min(stated, _untrimmed(track))
    if last != b"mfra":
        return count < stated
    (number,) = struct.unpack_from(">I", header := _at(track, b"tkhd"), 20 if header[0] else 12)
    return count < sum(_of_fragment(body, number) for kind, body in top if kind == b"moof")


def _boxes(data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Kind and body of every box.

    Raises:
      ValueError: the last one is cut off.
    """
    start = 0
    while start < len(data):
        size, kind = struct.unpack_from(">I4s", data, start)
        head = 8
        if size == 1:
            (size,), head = struct.unpack_from(">Q", data, start + 8), 16
        end = start + size if size else len(data)  # 0: to the end of the file
        if end > len(data) or end < start + head:
            raise ValueError("a box is cut off")
        yield kind, data[start + head : end]
        start = end


def _at(data: memoryview, *kinds: bytes) -> memoryview:
    """The body of a box within boxes.

    Raises:
      ValueError: there is none.
    """
    for kind in kinds:
        found = next((body for other, body in _boxes(data) if other == kind), None)
        if found is None:
            raise ValueError(f"there is no box {kind!r}")
        data = found
    return data


def _of_fragment(moof: memoryview, number: int) -> int:
    """Samples of a track in one fragment."""
    found = 0
    for kind, traf in _boxes(moof):
        if kind == b"traf" and struct.unpack_from(">I", _at(traf, b"tfhd"), 4)[0] == number:
            found += sum(struct.unpack_from(">I", body, 4)[0] for other, body in _boxes(traf) if other == b"trun")
    return found


def _untrimmed(track: memoryview) -> int:
    """Samples whose time of showing is not before that at which an edit list of one part begins."""
    table = _at(track, b"mdia", b"minf", b"stbl")
    steps = _spread(_at(table, b"stts"))
    times = np.cumsum(steps) - steps
    for kind, body in _boxes(table):
        if kind == b"ctts":
            times = times + _spread(body)
    edits = [_at(body, b"elst") for kind, body in _boxes(track) if kind == b"edts"]
    begins = _table(edits[0], 3)[1] if edits and not edits[0][0] else np.zeros(1)  # of 32 bits
    return int((times >= begins[-1]).sum()) if (begins[:-1] == -1).all() else len(times)


def _spread(body: memoryview) -> np.ndarray:
    """A value for each sample, from rows of how many have it and the value."""
    counts, values = _table(body, 2)
    if counts.sum() > _MOST:
        raise ValueError(f"{counts.sum()} samples")
    return np.repeat(values, counts)


def _table(body: memoryview, columns: int) -> np.ndarray:
    """Columns of a table of 32-bit numbers behind version, flags and number of rows, int64."""
    (rows,) = struct.unpack_from(">I", body, 4)
    return np.frombuffer(body, ">i4", rows * columns, 8).reshape(rows, columns).T.astype(np.int64)
