"""Pickled arrays and dictionaries of published data sets, read without running what else a pickle may hold.

A pickle is a program.  This reader lets it build numbers, text, lists, dictionaries and NumPy arrays, and refuses it
where it asks for anything else.
"""

import io
import pathlib
import pickle
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sensors_io.importers.keep import UnreadableError


class PickleError(UnreadableError):
    """A pickle that is damaged or holds more than data."""


def _latin1(text: str, encoding: str) -> bytes:
    """Bytes as protocols 0 to 2 spell them."""
    if encoding != "latin1":
        raise PickleError(f"spells bytes in {encoding!r}: must be latin1")
    return text.encode("latin1")


_BUILDERS: dict[str, Any] = {
    "_reconstruct": np.empty(0).__reduce_ex__(2)[0],
    "_frombuffer": np.empty(0).__reduce_ex__(5)[0],
    "scalar": np.float64(0).__reduce_ex__(2)[0],
}
"""The functions that NumPy's pickles call, by name, taken from such pickles."""

_ALLOWED: Mapping[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _latin1,
    **{
        (f"numpy.{core}.{module}", name): _BUILDERS[name]
        for core in ("core", "_core")  # the first until NumPy 2
        for module, name in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))
    },
}
"""All that a pickle may ask for."""

_BROKEN = (pickle.UnpicklingError, EOFError, ValueError, TypeError, IndexError, KeyError, AttributeError)
"""Errors that truncated or foreign bytes raise during unpickling."""


class _DataUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise PickleError(f"asks for {module}.{name}: only numbers, text and arrays are read")
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
            return _DataUnpickler(stream).load()
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
        if not dtype.hasobject:
            raise PickleError(f"{path.name} holds an array of {dtype}{list(shape)}, not a pickled object")
        return np.asarray(_DataUnpickler(stream).load(), object).item()
    except PickleError:
        raise
    except _BROKEN as error:
        raise PickleError(f"{path.name} is damaged ({error!r})") from error
