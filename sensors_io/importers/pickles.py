"""Pickled arrays and dictionaries of published data sets, read without running what else a pickle may hold.

A pickle is a program.  Here it may build numbers, text, lists and dictionaries; where it asks for NumPy it gets
stand-ins written in Python, which check shape, type and size before an array is made.  NumPy's own functions are never
called by a pickle, for `ndarray.__setstate__` and `dtype.__setstate__` trust what they are given with memory.
"""

import dataclasses
import io
import math
import pathlib
import pickle
import pickletools
import re
import reprlib
import tokenize
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sensors_io.errors import MALFORMED
from sensors_io.importers.keep import UnreadableError

_DEPTH = 64
"""Lists and dictionaries inside one another: far above what data sets nest."""

_HASHED = ("TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "FROZENSET")
"""Operations whose result is hashed part by part."""

_PARTS = 16
"""Parts of a tuple for each operation of its pickle: without repetition there is at most one."""

_SIMPLE = re.compile(r"[<>|=]?([biufc]\d{1,2}|[SU]\d{1,6})")
"""Names of the types whose values are plain bytes."""


class PickleError(UnreadableError):
    """A pickle that is damaged or holds more than data."""


class _DType:
    """Stand-in of a pickled `numpy.dtype`: numbers, booleans, fixed text, or `O` for a list of objects."""

    def __init__(self, name: str, align: object = False, copy: object = True):
        if name not in ("O", "O8") and not (isinstance(name, str) and _SIMPLE.fullmatch(name)):
            raise PickleError(
                f"asks for an array of type {reprlib.repr(name)}: only numbers, text and lists of them are read"
            )
        self.objects = name in ("O", "O8")
        self.dtype = np.dtype(object if self.objects else name)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) >= 5 else None
        if order not in ("<", ">", "|", "=") or any(part is not None for part in state[2:5]):
            raise PickleError(f"asks for an array of a structured type, {reprlib.repr(state)}: split its fields")
        self.dtype = self.dtype.newbyteorder(order)


@dataclasses.dataclass
class _Array:
    """Stand-in of a pickled `numpy.ndarray`; `value` is made once its state is known."""

    value: np.ndarray | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, fortran, data = state
        self.value = _array(data, kind, shape, "F" if fortran else "C")


def _array(data: Any, kind: Any, shape: Any, order: Any) -> np.ndarray:
    """An array of its own memory, after shape, type and size were seen to agree."""
    shape = (shape,) if isinstance(shape, int) else shape
    ok = isinstance(shape, tuple) and len(shape) <= 32 and all(type(n) is int and n >= 0 for n in shape)
    if not ok or not isinstance(kind, _DType) or order not in ("C", "F"):
        raise PickleError(f"asks for an array of shape {reprlib.repr(shape)}: must be a tuple of sizes, with a type")
    if kind.objects:
        if not isinstance(data, list) or len(data) != math.prod(shape):
            raise PickleError(f"an array of objects of shape {shape} must hold as many")
        flat = np.empty(len(data), object)
        for i, item in enumerate(data):
            flat[i] = item
        return flat.reshape(shape)  # NumPy lists objects row by row in either order
    size = math.prod(shape) * kind.dtype.itemsize
    if not isinstance(data, bytes | bytearray) or len(data) != size:
        raise PickleError(f"an array of {kind.dtype}{list(shape)} must have {size} bytes")
    return np.frombuffer(bytes(data), kind.dtype).reshape(shape, order=order).copy()


def _scalar(kind: Any, data: Any) -> Any:
    """One number; of a type that holds objects nothing is read."""
    if not isinstance(kind, _DType) or kind.objects:
        raise PickleError("asks for a single object as a number")
    return _array(data, kind, (), "C")[()]


def _latin1(text: str, encoding: str) -> bytes:
    """Bytes as protocols 0 to 2 spell them."""
    if encoding != "latin1":
        raise PickleError(f"spells bytes in {reprlib.repr(encoding)}: must be latin1")
    return text.encode("latin1")


def _bytes() -> bytes:
    """No bytes at all, as protocol 2 spells them."""
    return b""


def _reconstruct(kind: object, shape: object, code: object) -> _Array:
    """An array whose state follows."""
    return _Array()


def _frombuffer(data: Any, kind: Any, shape: Any, order: Any) -> _Array:
    return _Array(_array(data, kind, shape, order))


_ALLOWED: Mapping[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _DType,
    ("_codecs", "encode"): _latin1,
    ("__builtin__", "bytes"): _bytes,
    **{
        (f"numpy.{core}.{module}", name): function
        for core in ("core", "_core")  # the first until NumPy 2
        for module, name, function in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _frombuffer),
        )
    },
}
"""All that a pickle may ask for."""

_BROKEN = (*MALFORMED, pickle.UnpicklingError, EOFError, tokenize.TokenError)
"""Errors that truncated or foreign bytes raise during unpickling."""


class _DataUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            wanted = ascii(f"{module}.{name}")[1:-1]  # on one line, whatever the file has it be
            raise PickleError(f"asks for {wanted:.100}: only numbers, text and arrays are read")
        return _ALLOWED[module, name]


def read_pickle(path: pathlib.Path) -> Any:
    """The data of a .pkl file, or of a .npy file of one pickled object.

    Raises:
      PickleError: it is absent, damaged, or holds more than data.
    """
    if not path.is_file():
        raise PickleError(f"{path.name} is absent")
    try:
        stream = io.BytesIO(path.read_bytes())
        if path.suffix != ".npy":
            return _load(stream)
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
        if not dtype.hasobject:
            raise PickleError(f"{path.name} holds an array of {dtype}{list(shape)}, not a pickled object")
        return np.asarray(_load(stream), object).item()
    except PickleError:
        raise
    except _BROKEN as error:
        raise PickleError(f"{path.name} is damaged ({error!r:.200})") from error


def _load(stream: io.BytesIO) -> Any:
    """The object that follows, its stand-ins replaced by the arrays that they checked."""
    start = stream.tell()
    _check_sizes(stream)
    stream.seek(start)
    return _plain(_DataUnpickler(stream).load(), _DEPTH, {})


def _check_sizes(stream: io.BytesIO) -> None:
    """Refuse a program whose memory or time grows faster than its length.

    The unpickler allocates a table as long as the greatest number that an object is remembered by.  The key of a
    dictionary is hashed part by part, and a tuple that names another twice, which names a third twice, has 2ⁿ parts.
    """
    stack: list[int | None] = []  # parts of each object if it were hashed; `None` is a mark
    memory: dict[int, int] = {}
    for operations, (opcode, argument, _) in enumerate(pickletools.genops(stream), 1):
        name, before = opcode.name, list(opcode.stack_before)
        if name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            number = len(memory) if name == "MEMOIZE" else int(argument or 0)
            if number > operations:
                raise pickle.UnpicklingError(f"object {number} is remembered after {operations} operations")
            memory[number] = stack[-1] or 0
            continue
        taken = []
        if pickletools.markobject in before:
            while (part := stack.pop()) is not None:
                taken.append(part)
            before = before[: before.index(pickletools.markobject)]
        taken += [stack.pop() or 0 for _ in before]
        parts = 1 + sum(taken) if name in _HASHED else 1
        if parts > _PARTS * operations:
            raise PickleError(f"repeats a tuple {parts} times within tuples: must be written out")
        made = {"MARK": None, "DUP": max(taken, default=1)}.get(name, parts)
        found = memory[int(argument or 0)] if name in ("GET", "BINGET", "LONG_BINGET") else made
        stack += [found] * len(opcode.stack_after)


def _plain(data: Any, depth: int, done: dict[int, tuple[Any, Any]]) -> Any:
    """Data with arrays for their stand-ins.

    Args:
      data: as it was unpickled.
      depth: of lists and dictionaries that is left.
      done: identity → lists and dictionaries that were seen, and what became of each: a pickle of a few hundred bytes
        names one of them twice in another, and that one twice in the next, 2⁶⁰ times in all.
    """
    if not depth:
        raise PickleError(f"nests its data more than {_DEPTH} deep: must be flatter")
    if id(data) in done:
        return done[id(data)][1]
    plain = lambda part: _plain(part, depth - 1, done)
    found: Any
    if isinstance(data, _Array):
        if data.value is None:
            raise pickle.UnpicklingError("an array without its data")
        if data.value.dtype == object:
            for i, item in enumerate(data.value.flat):
                data.value.flat[i] = plain(item)
        found = data.value
    elif isinstance(data, _DType):
        return data.dtype
    elif isinstance(data, dict):
        found = {plain(k): plain(v) for k, v in data.items()}
    elif isinstance(data, list | tuple | set | frozenset):
        found = type(data)(plain(v) for v in data)
    elif isinstance(data, type) or callable(data):
        raise PickleError(f"holds the name {data!r} as data: only numbers, text and arrays are read")
    else:
        return data
    done[id(data)] = data, found
    return found
