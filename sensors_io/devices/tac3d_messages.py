"""Tac3D messages: the datagrams of the vendor's program, decoded without YAML, and the recordings that it saves.

A datagram starts with `=IHH`: number of the message, packets of data in it, number of this packet.  Packet 0 is an
ASCII layout in YAML, flow or block style; packets 1, 2, … joined are the data that its offsets point into.  Layouts
differ only by counter and time stamp from message to message, so that the list of arrays is parsed once and found again
by its bytes.  `$C` sent back makes the sensor take its present state as zero, `$Q` ends the vendor's program.

Frame of reference.  The vendor's x, y, z are right-handed with z out of the gel; a press has Fz < 0 and u_z < 0.  Its
20 × 20 points run from +x to −x along a row and from +y to −y over the rows; turning the grid by 180° gives the
schema's x right, y down.  Nothing is mirrored: the components of vectors stay as they are, depth is −u_z.
"""

import collections
import dataclasses
import math
import pathlib
import re
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from sensors_io.arrays import ArraysError, load_arrays
from sensors_io.devices.errors import DeviceDataError, DeviceNotFoundError

GRID = 20
"""Points along either side."""

_PACKET = struct.Struct("=IHH")
_MAX_PACKETS = 1024  # of one message: 64 MB, far above the 50 kB that a sensor sends
_LARGEST = _MAX_PACKETS << 16  # bytes of a message, and so numbers along a side of an array, though another side be 0
_IN_FLIGHT = 8  # messages whose packets may come interleaved
_CACHED_LAYOUTS = 16

_TYPES: Mapping[str, np.dtype[Any]] = {"f64": np.dtype("<f8"), "i32": np.dtype("<i4")}
_NAME = re.compile(rb"[A-Za-z_]\w*")
_LATEST_S = 9e9  # what nanoseconds in 64 bits carry
_DATA = re.compile(rb"^data:[^\n]*(?:\n[ \t-][^\n]*)*", re.MULTILINE)
_FLOW_ITEM = re.compile(r"\{([^{}]*)\}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Message:
    """One decoded message.

    Args:
      index: the sensor's frame counter.
      serial: the sensor's; its prefix states the model.
      send_time_s: on the clock of the vendor's program, since its start.
      note: what the vendor's program has to say, mostly nothing.
      matrices: by the vendor's names, such as `3D_Displacements` [400, 3] mm; views of the datagrams' bytes.
    """

    index: int
    serial: str
    send_time_s: float
    note: str
    matrices: Mapping[str, np.ndarray]

    @property
    def initialised(self) -> int:
        """Percentage of the vendor's program's start-up; the fields mean nothing before it is 100."""
        return int(self.matrices.get("InitializeProgress", np.array(100)).flat[0])


@dataclasses.dataclass(frozen=True)
class _Item:
    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    count: int
    offset: int
    end: int


class Tac3dDecoder:
    """Decodes messages; layouts that were seen before are not parsed again."""

    def __init__(self) -> None:
        self._layouts: collections.OrderedDict[bytes, tuple[_Item, ...]] = collections.OrderedDict()

    def decode(self, layout: bytes, data: bytes) -> Message:
        """One message from its layout and its joined data.

        Raises:
          DeviceDataError: a field that is missing or malformed, or an array that lies outside the data.
        """
        found = _DATA.search(layout)
        if found is None:
            raise DeviceDataError(f"Tac3D layout {layout[:60]!r} has no `data:` list; update this decoder")
        block = found.group()
        items = self._layouts.get(block)
        if items is None:
            items = self._learn(block)
        lines = (line.partition(b":") for line in (layout[: found.start()] + layout[found.end() :]).split(b"\n"))
        scalars = {name: value.strip() for name, colon, value in lines if colon and _NAME.fullmatch(name)}
        matrices = {}
        for item in items:
            if item.end > len(data):
                raise DeviceDataError(
                    f"Tac3D array {item.name} ends at byte {item.end} of {len(data)}: data are cut off"
                )
            matrices[item.name] = np.frombuffer(data, item.dtype, item.count, item.offset).reshape(item.shape)
        started = matrices.get("InitializeProgress", np.array(100)).ravel()[:1]
        if not len(started) or not np.isfinite(started[0]):
            raise DeviceDataError(f"Tac3D InitializeProgress is {started}: must be a percentage; look at its program")
        try:
            send_time_s = float(scalars[b"timestamp"])
            index = int(scalars[b"index"])
            if not abs(send_time_s) <= _LATEST_S or abs(index) >= 1 << 63:
                raise DeviceDataError(
                    f"Tac3D message {index} at {send_time_s} s: must be within ±2^63 and ±{_LATEST_S:g} s; look at the "
                    "vendor's program"
                )
            return Message(
                index=index,
                serial=_plain(scalars[b"SN"]),
                send_time_s=send_time_s,
                note=_plain(scalars.get(b"msg", b"")),
                matrices=matrices,
            )
        except (KeyError, ValueError) as error:
            raise DeviceDataError(f"Tac3D layout lacks a readable index, SN or timestamp ({error!r})") from error

    def _learn(self, block: bytes) -> tuple[_Item, ...]:
        items = parse_layout(block.decode("ascii", "strict") if block.isascii() else "")
        self._layouts[block] = items
        if len(self._layouts) > _CACHED_LAYOUTS:
            self._layouts.popitem(last=False)
        return items


def parse_layout(block: str) -> tuple[_Item, ...]:
    """The arrays that a `data:` list names; items that are no numbers, such as pictures, are left out.

    Raises:
      DeviceDataError: no item, or one without name, type, shape, offset or length that agree.
    """
    flow = _FLOW_ITEM.findall(block)
    texts = [t.replace(",", "\n") for t in flow] or re.split(r"^[ \t]*-[ \t]*", block, flags=re.MULTILINE)[1:]
    items = [_item(dict(_pairs(text))) for text in texts]
    if not items:
        raise DeviceDataError(f"Tac3D layout {block[:60]!r} lists no array; update this decoder")
    return tuple(item for item in items if item is not None)


def _pairs(text: str) -> list[tuple[str, str]]:
    lines = (line.partition(":") for line in text.splitlines() if ":" in line)
    return [(key.strip().strip("\"'"), value.strip().strip("\"'")) for key, _, value in lines]


def _item(pairs: Mapping[str, str]) -> _Item | None:
    try:
        kind = pairs["type"]
        if kind == "img":
            return None
        dtype = _TYPES[pairs["dtype"] if kind == "mat" else kind]
        shape = (int(pairs["height"]), int(pairs["width"])) if kind == "mat" else ()
        name, offset, length = pairs["name"], int(pairs["offset"]), int(pairs["length"])
    except (KeyError, ValueError) as error:
        raise DeviceDataError(f"Tac3D layout item {dict(pairs)} cannot be read ({error!r})") from error
    count = math.prod(shape)
    sizes = (offset, *shape)
    if min(sizes) < 0 or max(sizes) > _LARGEST or count * dtype.itemsize != length:
        raise DeviceDataError(f"Tac3D layout item {name}: {shape} of {dtype} are not {length} bytes at {offset}")
    return _Item(name, dtype, shape, count, offset, offset + length)


def _plain(text: bytes) -> str:
    return text.decode("ascii", "replace").strip("\"'")


class Assembler:
    """Joins datagrams to messages; packets may come in any order, and what is never completed is counted."""

    def __init__(self) -> None:
        self._parts: collections.OrderedDict[tuple[object, int], list[bytes | None]] = collections.OrderedDict()
        self._left: dict[tuple[object, int], int] = {}
        self.incomplete = 0

    def add(self, datagram: bytes, sender: object = None) -> tuple[bytes, bytes] | None:
        """Layout and data of a message that this datagram completes, else `None`.

        Args:
          datagram: its bytes.
          sender: address that it came from; two programs on one port number their messages alike.

        Raises:
          DeviceDataError: a datagram that is too short, numbers its packets wrongly, or contradicts one before it.
        """
        if len(datagram) < _PACKET.size:
            raise DeviceDataError(f"Tac3D datagram of {len(datagram)} bytes: its header alone has {_PACKET.size}")
        message, count, packet = _PACKET.unpack_from(datagram)
        serial = (sender, message)
        parts = self._parts.get(serial)
        if not 0 < count <= _MAX_PACKETS or packet > count or (parts is not None and len(parts) != count + 1):
            raise DeviceDataError(f"Tac3D datagram {packet} of {count} in message {message} is misnumbered")
        if parts is None:
            parts = self._parts[serial] = [None] * (count + 1)
            self._left[serial] = count + 1
        if parts[packet] is None:
            parts[packet] = datagram[_PACKET.size :]
            self._left[serial] -= 1
        elif parts[packet] != datagram[_PACKET.size :]:  # else packets of two programs would make one message
            del self._parts[serial], self._left[serial]
            raise DeviceDataError(
                f"Tac3D packet {packet} of message {message} came twice with other bytes: two programs send from one "
                "address; let each send to a port of its own"
            )
        if not self._left[serial]:
            del self._parts[serial], self._left[serial]
            whole = [part for part in parts if part is not None]
            return whole[0], whole[1] if count == 1 else b"".join(whole[1:])
        if len(self._parts) > _IN_FLIGHT:
            dropped, _ = self._parts.popitem(last=False)
            del self._left[dropped]
            self.incomplete += 1
        return None


def to_schema(matrices: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The vendor's arrays of one message as those of the schema.

    Returns:
      `deformation_mm` [20, 20, 2], `depth_mm` [20, 20], `force_n` [3], `moment_nmm` [3], float32; each where the
      vendor's array is there.

    Raises:
      DeviceDataError: an array of another size.
    """
    sizes = {"3D_Displacements": GRID * GRID * 3, "3D_ResultantForce": 3, "3D_ResultantMoment": 3}
    for name, size in sizes.items():
        if name in matrices and matrices[name].size != size:
            raise DeviceDataError(f"Tac3D array {name} has {matrices[name].size} numbers: must have {size}")
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is not finite, and flagged as such
        theirs = {name: matrices[name].astype(np.float32) for name in sizes if name in matrices}
    fields: dict[str, np.ndarray] = {}
    if "3D_Displacements" in theirs:
        grid = theirs["3D_Displacements"].reshape(GRID, GRID, 3)[::-1, ::-1]
        fields["deformation_mm"] = np.ascontiguousarray(grid[..., :2])
        fields["depth_mm"] = -grid[..., 2]
    for name, ours in (("3D_ResultantForce", "force_n"), ("3D_ResultantMoment", "moment_nmm")):
        if name in theirs:
            fields[ours] = theirs[name].reshape(3)
    return fields


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tac3dArrays:
    """A recording as the vendor saves it, N messages.

    Args:
      index: the sensor's counter.
      send_time_s: on the clock of the vendor's program.
      receive_time_s: on the clock of who recorded it; `None` where it was not saved.
      matrices: by the vendor's names, each [N, …].
    """

    index: np.ndarray
    send_time_s: np.ndarray
    receive_time_s: np.ndarray | None
    matrices: Mapping[str, np.ndarray]


def load_recording(path: pathlib.Path) -> Tac3dArrays:
    """Read a folder of .npy files or one .npz.

    Raises:
      DeviceNotFoundError: it is neither.
      DeviceDataError: it is damaged, lacks counter or time stamps, or its arrays differ in length.
    """
    if path.is_dir():
        files = sorted(path.glob("*.npy"))
    elif path.suffix == ".npz" and path.is_file():
        files = [path]
    else:
        raise DeviceNotFoundError(f"{path} is neither a folder of .npy files nor an .npz; give a Tac3D recording")
    try:
        arrays = {name: array for file in files for name, array in load_arrays(file).items()}
    except ArraysError as error:
        raise DeviceDataError(str(error)) from error
    if not {"index", "sendTimestamp"} <= arrays.keys():
        raise DeviceDataError(f"{path} holds {sorted(arrays)}: index and sendTimestamp must be among them")
    matrices = {name: a for name, a in arrays.items() if name.startswith("3D_")}
    for name in ("index", "sendTimestamp", "recvTimestamp", *matrices):
        if name in arrays:
            _require_numbers(path, name, arrays[name])
    index, times = arrays["index"].ravel(), arrays["sendTimestamp"].ravel().astype(np.float64)
    received = arrays["recvTimestamp"].ravel().astype(np.float64) if "recvTimestamp" in arrays else None
    if any(
        len(a) != len(index) for a in (times, received if received is not None else times, *matrices.values())
    ) or not len(index):
        raise DeviceDataError(f"{path}: its arrays must be of one length > 0; copy the recording again")
    return Tac3dArrays(index=index, send_time_s=times, receive_time_s=received, matrices=matrices)


def _require_numbers(path: pathlib.Path, name: str, array: np.ndarray) -> None:
    """Refuse times, counts or fields that are no numbers, times or counts beyond 64 bits, counts that are not whole."""
    count = name == "index"
    top = _LATEST_S if name.endswith("Timestamp") else 2.0**63 if count else None
    numbers = array.ndim > 0 and array.dtype.kind in "fiu" and not (count and np.any(array != np.trunc(array)))
    if not numbers or (top is not None and not np.all(np.abs(array.astype(np.float64)) < top)):
        raise DeviceDataError(
            f"{path}: {name} is {array.dtype}{list(array.shape)}: must hold a {'whole ' * count}number for each message"
            + ("" if top is None else f", finite and below {top:g}")
            + "; copy the recording again"
        )
