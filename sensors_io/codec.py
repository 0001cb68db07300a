"""One `Sequence` or `ObjectCard` as bytes: a JSON header that describes itself, then the arrays; no pickle.

    magic (4 bytes) | crc32 of all that follows (u32) | header length (u32) | header | array | array | …

Little-endian; the header and every array are padded to 8 bytes.  Camera frames are stored as differences in time, along
the rows or both, whichever the frames want (`deltas`; the header says which); times as they are, masks as packed bits,
fields and forces as int16 counts of a recorded scale:

    counts = round(x / scale),   scale = the smallest power of two with max|x| ≤ 32767 · scale

The error is at most scale/2 and must not exceed `TOLERANCE`; forces and moments past that range are stored as float32,
up to `LARGEST`.
A power of two makes decoding exact in float32, so that storing a decoded sequence again gives the same bytes: copies of
a data set never drift.

Entries of the first version, TCH1, stored their frames as they are and are read as well.
"""

import contextlib
import dataclasses
import json
import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from sensors_io.deltas import FILTERS, accumulate, choose_filter, difference
from sensors_io.errors import MALFORMED, UserError
from sensors_io.schema import FRAME_ARRAYS, ContactKey, ObjectCard, SchemaError, Sequence, Spec

TOLERANCE: Mapping[str, float] = {
    "deformation_mm": 5e-4,
    "shear_mm": 5e-4,
    "depth_mm": 5e-4,
    "force_n": 1e-3,
    "target_force_n": 1e-3,
    "moment_nmm": 1e-2,  # 1 mN on a lever of 10 mm
}
"""Largest storage error of each quantised array, in the unit of its name."""

FIELDS = ("deformation_mm", "shear_mm", "depth_mm", "valid")

WIDEST: Mapping[str, float] = {
    name: 32767 * 2.0 ** math.floor(math.log2(2 * tolerance)) for name, tolerance in TOLERANCE.items()
}
"""Largest value of each quantised array that int16 carries within its tolerance: 32 mm, 64 N, 512 N mm."""

LARGEST: Mapping[str, float] = {**WIDEST, "force_n": 1e6, "target_force_n": 1e6, "moment_nmm": 1e9}
"""Largest value that is stored.  No gel bears a greater force, and squares of 10²⁰ N leave float32 in training."""

_MAGIC, _OLD_MAGIC = b"TCH2", b"TCH1"
_PREFIX = struct.Struct("<4sII")
_TOP = 32767
_LEAST_SCALE = 2.0**-40  # keeps the scale of an all but vanishing array a normal float32
_PLAIN = ("key", "sensor", "serial", "calibration", "camera", "contact_region_px", "mm_per_px")
_CARD_ARRAYS: Mapping[str, Spec] = {
    "view": Spec(np.uint8, ("Hv", "Wv", "3"), optional=True),
    "view_depth_mm": Spec(np.float32, ("Hv", "Wv"), optional=True),  # the distance to a camera is past int16
}


class RecordsError(UserError, ValueError):
    """Records that cannot be written or read; the message names the path, the problem and the fix."""


class CorruptRecordsError(RecordsError):
    """Bytes on disk that are not what was written."""


def encode_sequence(sequence: Sequence) -> bytes:
    """One sequence as bytes.

    Raises:
      SchemaError: a field that is not finite or too large for its tolerance, or camera settings that JSON cannot carry.
    """
    plain = {name: getattr(sequence, name) for name in _PLAIN} | {"key": dataclasses.asdict(sequence.key)}
    arrays = {name: getattr(sequence, name) for name in FRAME_ARRAYS}
    return _pack("sequence", plain, arrays, where=sequence.name)


def require_storable(sequence: Sequence) -> None:
    """Check before anything is written that no array is beyond what is stored, at a small part of the cost of encoding.

    Raises:
      SchemaError: as `encode_sequence` for arrays.
    """
    for name in TOLERANCE:
        array = getattr(sequence, name)
        if array is not None and not _wide(name, array):
            quantise(name, array, where=sequence.name)


def decode_sequence(data: bytes, *, fields: bool = True) -> Sequence:
    """The sequence that `encode_sequence` packed; its arrays are read-only views of `data` where possible.

    Args:
      data: bytes of one entry.
      fields: False leaves out the fields of a sequence that has camera frames, which spares most of the decoding.

    Raises:
      CorruptRecordsError: the checksum or the layout does not hold.
    """
    with _checked():
        return _sequence(data, fields)


def _sequence(data: bytes, fields: bool) -> Sequence:
    header, payload = _open(data, "sequence")
    seen = {array["name"] for array in header["arrays"]}
    skip = FIELDS if not fields and "frames" in seen else ()
    plain = header["plain"]
    region = plain["contact_region_px"]
    plain |= {"key": ContactKey(**plain["key"]), "contact_region_px": None if region is None else tuple(region)}
    return Sequence(**plain, **_unpack(header, payload, skip))


def encode_card(card: ObjectCard) -> bytes:
    """One object card as bytes, with the view and its depth exactly as they are."""
    plain = {f.name: getattr(card, f.name) for f in dataclasses.fields(card) if f.name not in _CARD_ARRAYS}
    plain["labels"] = {attribute: int(level) for attribute, level in card.labels.items()}
    plain["truth"] = {quantity: float(value) for quantity, value in card.truth.items()}
    return _pack("object", plain, {name: getattr(card, name) for name in _CARD_ARRAYS}, where=card.object_id)


def decode_card(data: bytes) -> ObjectCard:
    """The card that `encode_card` packed.

    Raises:
      CorruptRecordsError: the checksum or the layout does not hold.
    """
    with _checked():
        header, payload = _open(data, "object")
        return ObjectCard(**header["plain"], **_unpack(header, payload, ()))


@contextlib.contextmanager
def _checked() -> Iterator[None]:
    """Name an entry whose checksum holds and whose content this code did not write."""
    try:
        yield
    except CorruptRecordsError:
        raise
    except MALFORMED as error:
        reason = error if isinstance(error, UserError) else repr(error)
        raise CorruptRecordsError(f"the entry is not laid out as this version writes it ({reason})") from error


def quantise(name: str, x: np.ndarray, *, where: str) -> tuple[np.ndarray, float]:
    """Counts (int16) and scale of a float array, by the formula of this module.

    Raises:
      SchemaError: values that are not finite, or a range that int16 cannot carry within `TOLERANCE[name]`.
    """
    top = float(np.abs(x).max(initial=0.0))
    if not math.isfinite(top):
        raise SchemaError(f"{where}: {name} holds a value that is not finite; put 0 there and clear `valid`")
    mantissa, exponent = math.frexp(max(top / _TOP, _LEAST_SCALE))
    scale = math.ldexp(1.0, exponent - (mantissa == 0.5))
    if scale > 2 * TOLERANCE[name]:
        raise SchemaError(
            f"{where}: {name} reaches {top:g}: records hold at most {LARGEST[name]:g}; check the unit or drop the "
            "broken frames"
        )
    return np.rint(x / np.float32(scale)).astype(np.int16), scale


def _pack(kind: str, plain: Mapping[str, Any], arrays: Mapping[str, np.ndarray | None], *, where: str) -> bytes:
    described = list[dict[str, Any]]()
    payloads = list[memoryview]()  # not copied: minutes of pictures are gigabytes
    for name, array in arrays.items():
        if array is None:
            continue
        entry: dict[str, Any] = {"name": name, "shape": list(array.shape)}
        if name in TOLERANCE and not _wide(name, array):
            array, entry["scale"] = quantise(name, array, where=where)
        elif array.dtype == np.bool_:
            array, entry["bits"] = np.packbits(array), True
        elif name == "frames":
            entry["filter"] = choose_filter(array)
            array = difference(array, entry["filter"])
        entry["dtype"] = array.dtype.newbyteorder("<").str
        described.append(entry)
        stored = np.ascontiguousarray(array).astype(entry["dtype"], copy=False).reshape(-1)
        payloads += [stored.view(np.uint8).data, memoryview(_padding(stored.nbytes))]
    header = {"kind": kind, "plain": plain, "arrays": described}
    try:
        text = json.dumps(header, allow_nan=False).encode()
        text += _padding(_PREFIX.size + len(text), b" ")
    except (TypeError, ValueError) as error:
        raise SchemaError(
            f"{where}: its settings cannot be stored as JSON ({error}); use plain numbers and text"
        ) from error
    checksum = zlib.crc32(struct.pack("<I", len(text)))
    for part in (memoryview(text), *payloads):
        checksum = zlib.crc32(part, checksum)
    return b"".join([_PREFIX.pack(_MAGIC, checksum, len(text)), text, *payloads])


def _wide(name: str, x: np.ndarray) -> bool:
    """True of a force or moment that int16 cannot carry; a field past its range is a broken sample or another unit."""
    return name not in FIELDS and WIDEST[name] < float(np.abs(x).max(initial=0.0)) <= LARGEST[name]


def _open(data: bytes, kind: str) -> tuple[dict[str, Any], memoryview]:
    """Header and array bytes of an entry, after its checksum was verified."""
    if len(data) < _PREFIX.size or data[:4] not in (_MAGIC, _OLD_MAGIC):
        raise CorruptRecordsError(f"the entry starts with {data[:4]!r}, not with {_MAGIC!r} or {_OLD_MAGIC!r}")
    _, checksum, length = _PREFIX.unpack_from(data)
    if zlib.crc32(memoryview(data)[8:]) != checksum:
        raise CorruptRecordsError("the entry's checksum does not hold")
    header = json.loads(data[_PREFIX.size : _PREFIX.size + length])
    if header["kind"] != kind:
        raise CorruptRecordsError(f"the entry is of kind {header['kind']!r}, not {kind!r}")
    return header, memoryview(data)[_PREFIX.size + length :]


def _unpack(header: Mapping[str, Any], payload: memoryview, skip: tuple[str, ...]) -> dict[str, Any]:
    arrays: dict[str, Any] = {}
    start = 0
    for entry in header["arrays"]:
        shape, dtype = tuple(entry["shape"]), np.dtype(entry["dtype"])
        count = math.prod(shape)
        stored = (count + 7) // 8 if "bits" in entry else count
        if entry["name"] not in skip:
            array = np.frombuffer(payload, dtype, stored, start)
            if "bits" in entry:
                array = np.unpackbits(array, count=count).view(np.bool_)
            elif "scale" in entry:
                if not 0 < entry["scale"] < math.inf:
                    raise CorruptRecordsError(f"{entry['name']} has scale {entry['scale']}: must be finite and > 0")
                array = array * np.float32(entry["scale"])
            arrays[entry["name"]] = _undo(array.reshape(shape), entry)
        start += -(-stored * dtype.itemsize // 8) * 8
    return arrays


def _undo(array: np.ndarray, entry: Mapping[str, Any]) -> np.ndarray:
    """The array itself, where differences of it were stored."""
    if "filter" not in entry:
        return array
    if entry["filter"] not in FILTERS:
        raise CorruptRecordsError(
            f"{entry['name']} went through filter {entry['filter']!r}: must be one of {[*FILTERS]}"
        )
    return accumulate(array, entry["filter"])


def _padding(size: int, fill: bytes = b"\0") -> bytes:
    return fill * (-size % 8)
