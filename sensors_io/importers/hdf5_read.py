"""Arrays of one contact in an HDF5 file, brought to the schema."""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np

from sensors_io.errors import MALFORMED, UserError, of_system
from sensors_io.importers.catalogue import Taken
from sensors_io.importers.hdf5_map import QUANTITIES, UNITS, ArrayMap, LayoutMap, RowsMap, StreamMap
from sensors_io.importers.keep import ImportSourceError, Keep, Skip, UnreadableError
from sensors_io.importers.pictures import decode_picture, film, nominal_ns
from sensors_io.schema import ContactKey, Flag, SchemaError, Sequence

STATED = ("unit", "units")
"""Attributes of a data set that state its unit."""

SPELLED = {
    "meter": "m", "meters": "m", "metre": "m", "metres": "m", "millimeter": "mm", "millimeters": "mm",
    "millimetre": "mm", "millimetres": "mm", "µm": "um", "μm": "um", "micrometer": "um", "micrometers": "um",
    "centimeter": "cm", "centimeters": "cm", "centimetre": "cm", "centimetres": "cm", "inch": "in", "inches": "in",
    "newton": "N", "newtons": "N", "n": "N", "nm": "N m", "n*m": "N m", "nmm": "N mm", "ncm": "N cm",
    "kilonewton": "kN", "kilonewtons": "kN", "kn": "kN", "lb": "lbf", "lbs": "lbf",
    "second": "s", "seconds": "s", "sec": "s",
    "milliseconds": "ms", "microseconds": "us", "µs": "us", "μs": "us", "nanoseconds": "ns",
}  # fmt: skip
"""Other spellings of units, in lower case."""

LEAST_PULL_N = 0.5
"""Force away from the gel that neither drift nor adhesion explains."""

MOST_ROWS = 10**7
"""Rows of one contact: 24 minutes of a force at 7 kHz.  A file of some kilobytes may state more than memory holds."""

LATE = 1.5
"""Median periods between two frames from which on one is taken to be missing."""


class HDF5Error(UnreadableError):
    """A file, group or data set that does not hold what the mapping says; the message names it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Place:
    """One contact: its file, as reports show it, its group, and its number among the `rows` contacts of the group."""

    file: pathlib.Path
    shown: str
    group: str
    row: int
    rows: int

    @property
    def name(self) -> str:
        """For reports."""
        return f"{self.shown}{'' if self.group == '/' else self.group}" + (f", row {self.row}" if self.row else "")


def spelled(value: Any) -> str:
    """A value of a label as text; 1.0 is "1"."""
    if isinstance(value, bytes):
        return value.decode(errors="backslashreplace")
    whole = isinstance(value, (float, np.floating)) and float(value).is_integer()
    return str(int(value) if whole else value)


def stated(of: Any, attribute: str | None = None) -> np.ndarray:
    """The values of a data set, or of an attribute of a group; those of an enumeration are its words."""
    kind = of.dtype if attribute is None else of.attrs.get_id(attribute).dtype
    found = np.asarray(of[()] if attribute is None else of.attrs[attribute])
    if (numbers := h5py().check_enum_dtype(kind)) is None:
        return found
    words = {number: word for word, number in numbers.items()}
    return np.array([words.get(n, n) for n in found.ravel().tolist()], np.object_).reshape(found.shape)


def h5py() -> ModuleType:
    """The library that reads HDF5.

    Raises:
      ImportSourceError: it is not installed.
    """
    try:
        import h5py as library
    except ImportError as error:
        raise ImportSourceError("h5py is not installed: HDF5 needs it; pip install 'touchr1-jax[hdf5]'") from error
    return library


@contextlib.contextmanager
def opened(path: pathlib.Path) -> Iterator[Any]:
    """An HDF5 file, closed at the end.

    Raises:
      HDF5Error: it, or what is read of it, is damaged.
    """
    library = h5py()
    try:
        with library.File(path, "r") as file:
            yield file
    except (UserError, UnreadableError):
        raise
    except (*MALFORMED, OSError, RuntimeError) as error:  # what h5py and NumPy raise for damaged or absurd files
        if of_system(error):
            raise
        raise HDF5Error(f"cannot be read: {str(error).strip(chr(39))}") from error


def named(name: str | bytes) -> str:
    """The name of a group or data set, which h5py leaves as bytes where it is not UTF-8.

    Raises:
      HDF5Error: it is not.
    """
    if isinstance(name, bytes):
        raise HDF5Error(f"the name {name!r} is not UTF-8: the file is damaged, or rename it")
    return name


def bounds(file: Any, group: str, rows: RowsMap) -> np.ndarray:
    """First row of each contact in arrays that hold the rows of all, and their end, int64 [contacts + 1].

    Raises:
      HDF5Error: they are no ascending whole numbers.
    """
    stated_rows = dataset(file, group, rows.path, rows.kind)
    _require_few(stated_rows.size or 0, rows.path, rows.kind)
    found = np.asarray(stated_rows[()])
    whole = np.issubdtype(found.dtype, np.integer) and found.ndim == 1
    ends = found.astype(np.int64) if whole else np.zeros(1, np.int64)
    ends = np.append(0, np.cumsum(ends)) if whole and rows.kind == "lengths" else ends
    if len(ends) < 2 or (ends < 0).any() or (np.diff(ends) < 0).any():  # also beyond 2⁶³
        must = (
            "lengths of all contacts" if rows.kind == "lengths" else "first rows of all contacts and the last one's end"
        )
        raise HDF5Error(f"{rows.path} must hold the {must}, whole numbers ≥ 0, the rows ascending")
    return ends


def _require_few(rows: int, path: str, what: str) -> None:
    if rows > MOST_ROWS:
        raise HDF5Error(f"{path} for {what} has {rows} rows: must have ≤ {MOST_ROWS}; cut the recording into contacts")


def dataset(file: Any, group: str, path: str, what: str) -> Any:
    """A data set by its path, which is relative to a group unless it begins with "/".

    Raises:
      HDF5Error: there is none; the message says for `what` it is wanted.
    """
    found = file.get(path if path.startswith("/") else f"{group.rstrip('/')}/{path}")
    if not isinstance(found, h5py().Dataset):
        raise HDF5Error(f"lacks {path}, which the mapping names for {what}")
    return found


def read_contact(place: Place, key: ContactKey, layout: LayoutMap, keep: Keep) -> Taken:
    """Read a contact: a sequence of every sensor that has data there.

    Raises:
      HDF5Error: what is read is missing, damaged or beyond what a sensor gives.
    """
    sequences, left_out = [], []
    with opened(place.file) as file:
        for sensor, stream in layout.sensors.items():
            present = {n for n, array in stream.arrays.items() if _has(file, place.group, array.path)}
            if not present:
                left_out.append(Skip(name=f"{place.name}, {sensor}", reason="has no data here"))
                continue
            lacking = [name for name in stream.arrays if name not in present]
            for name in lacking:
                if not stream.arrays[name].optional:
                    dataset(file, place.group, stream.arrays[name].path, f"{name} of {sensor}")
                left_out.append(Skip(name=f"{place.name}, {sensor}", reason=f"lacks {name}"))
            arrays = {name: stream.arrays[name] for name in stream.arrays if name in present}
            try:
                sequence, lost = _sequence(file, place, key, sensor, dataclasses.replace(stream, arrays=arrays), keep)
            except SchemaError as error:
                raise HDF5Error(str(error)) from error
            sequences.append(sequence)
            left_out += lost
    if not sequences:
        raise HDF5Error("holds no data of any sensor")
    return Taken(sequences=tuple(sequences), left_out=tuple(left_out))


def _has(file: Any, group: str, path: str) -> bool:
    return (path if path.startswith("/") else f"{group.rstrip('/')}/{path}") in file


def _sequence(
    file: Any, place: Place, key: ContactKey, sensor: str, stream: StreamMap, keep: Keep
) -> tuple[Sequence, list[Skip]]:
    """One sensor's sequence and the frames that were left out."""
    own = {name: array for name, array in stream.arrays.items() if array.time is None}
    sources = {name: _Rows(file, place, array, f"{name} of {sensor}") for name, array in own.items()}
    counts = {name: len(rows) for name, rows in sources.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{name} has {count}" for name, count in counts.items())
        raise HDF5Error(f"{sensor}: {listed} frames: must be as many, or state the `time` of the other clock")
    count = next(iter(counts.values()), 0)
    if not count:
        raise HDF5Error(f"{sensor} holds no frame")
    if "host_time_ns" in sources:
        times_ns = sources["host_time_ns"].times_ns(np.arange(count))
    else:
        assert stream.rate_hz is not None
        times_ns = nominal_ns(np.arange(count), stream.rate_hz)
    periods = np.diff(times_ns, prepend=times_ns[:1])
    late = np.cumsum(periods > LATE * np.median(periods[1:])) if count > 1 else np.zeros(1, np.int64)
    positions = keep.positions(count)
    values: dict[str, np.ndarray] = {}
    for name, rows in sources.items():
        if name == "device_time_ns":
            values[name] = rows.times_ns(positions)
        elif name != "host_time_ns":
            values[name] = rows.pictures(positions, keep) if name == "frames" else rows.values(name, positions)
    outside, notes = np.zeros(len(positions), np.bool_), [note for rows in sources.values() for note in rows.notes]
    for name in stream.arrays.keys() - own.keys():
        values[name], beyond, more = _resampled(file, place, stream.arrays[name], name, sensor, times_ns[positions])
        notes += more
        outside |= beyond
    finite = np.all([np.isfinite(v).reshape(len(positions), -1).all(1) for v in values.values()], axis=0)
    if not finite.any():
        raise HDF5Error(f"{sensor} holds no frame of finite values")
    name = f"{place.name}, {sensor}"
    lost = [Skip(name=f"{name}, frame {n}", reason="holds values that are not finite") for n in positions[~finite]]
    lost += [Skip(name=name, reason=note) for note in dict.fromkeys(notes)]
    kept = positions[finite]
    sequence = film(
        key,
        sensor,
        gap=np.diff(late[kept], prepend=late[kept][:1]) > 0,
        host_time_ns=times_ns[kept],
        camera={"file": place.shown, "group": place.group},
        **{name: value[finite] for name, value in values.items()},
    )
    flags = sequence.flags | np.where(outside[finite], np.uint32(Flag.INCOMPLETE), np.uint32(0))
    return dataclasses.replace(sequence, flags=flags), lost


def _resampled(
    file: Any, place: Place, array: ArrayMap, name: str, sensor: str, times_ns: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """An array of another clock at the times of the frames, which of them lie outside of its time, and notes on it."""
    assert array.time is not None
    rows = _Rows(file, place, array, f"{name} of {sensor}")
    clock = _Rows(file, place, array.time, f"time of {name} of {sensor}")
    if len(rows) != len(clock) or not len(rows):
        raise HDF5Error(f"{name} of {sensor} has {len(rows)} rows and {len(clock)} times: must be as many, and some")
    every = np.arange(len(rows))
    own_ns, values = clock.times_ns(every), rows.values(name, every)
    seconds = lambda ns: (ns - own_ns[0]).astype(np.float64)
    flat = values.reshape(len(values), -1)
    columns = [np.interp(seconds(times_ns), seconds(own_ns), column) for column in flat.T]
    found = np.stack(columns, -1).reshape(len(times_ns), *values.shape[1:]).astype(np.float32)
    return found, (times_ns < own_ns[0]) | (times_ns > own_ns[-1]), [*rows.notes, *clock.notes]


class _Rows:
    """The rows of one contact in one data set."""

    def __init__(self, file: Any, place: Place, array: ArrayMap, what: str) -> None:
        self.array, self.what = array, what
        self.data = dataset(file, place.group, array.path, what)
        axes = 1 + (self.data.ndim == 2) if array.encoded else len(array.axes)  # files of one length, padded
        if self.data.ndim != axes:
            raise HDF5Error(f"{array.path} for {what} has shape {self.data.shape}: must have axes {array.axes}")
        self.axis = array.axes.index("N")
        if array.rows is None:
            self.first, self.end = 0, self.data.shape[self.axis]
        else:
            self.first, self.end = bounds(file, place.group, array.rows)[place.row : place.row + 2].tolist()
        if self.end > self.data.shape[self.axis]:
            raise HDF5Error(f"{array.path} for {what} has {self.data.shape[self.axis]} rows: {self.end} are stated")
        _require_few(len(self), array.path, what)
        self.notes: list[str] = []
        self._require_unit()

    def __len__(self) -> int:
        return self.end - self.first

    def _require_unit(self) -> None:
        """Compare the unit that the data set states with the mapping's, and note one that is not known."""
        array = self.array
        units = next(known for known in UNITS.values() if array.unit in known and known[array.unit] == array.factor)
        for name in STATED:
            if name not in self.data.attrs:
                continue
            for spelling in map(spelled, stated(self.data, name).ravel()):  # some programs state one for each component
                unit = SPELLED.get(spelling.strip().lower(), spelling.strip())
                if unit in UNITS["picture"]:
                    continue
                known = any(unit in of_kind for of_kind in UNITS.values())
                if not known and units is not UNITS["picture"]:
                    self.notes.append(
                        f"{array.path} states the unit {spelling!r}, which is not known: taken for {array.unit!r}"
                    )
                elif known and units.get(unit) != array.factor:
                    raise HDF5Error(
                        f"{array.path} states the unit {spelling!r}, the mapping {array.unit!r} for {self.what}"
                    )

    def _raw(self, positions: np.ndarray) -> np.ndarray:
        """Some rows, the axes in the order of the schema."""
        index: list[Any] = [slice(None)] * self.data.ndim
        index[self.axis] = (self.first + positions).tolist()
        found = np.asarray(self.data[tuple(index)])
        if self.array.encoded:
            return found
        order = [self.array.axes.index(axis) for axis in "NHWC" if axis in self.array.axes]
        found = found.transpose(order)
        if found.dtype.kind not in "fiu":
            raise HDF5Error(f"{self.array.path} for {self.what} holds {found.dtype}: must hold numbers")
        if "C" not in self.array.axes:
            return found
        if found.shape[-1] != len(self.array.components):
            raise HDF5Error(
                f"{self.array.path} for {self.what} has {found.shape[-1]} components: must have "
                f"{', '.join(self.array.components)}"
            )
        return found

    def values(self, name: str, positions: np.ndarray) -> np.ndarray:
        """Numbers in the unit, the signs and the order of components of the schema, float32.

        Raises:
          HDF5Error: no tactile sensor gives such values, or the force pulls at the gel.
        """
        quantity, found = QUANTITIES[name], self._raw(positions).astype(np.float64) * self.array.factor
        if quantity.components:
            signs = [-1.0 if c.startswith("-") else 1.0 for c in self.array.components]
            plain = [c.removeprefix("-") for c in self.array.components]
            found = (found * signs)[..., [plain.index(c) for c in quantity.components]]
        greatest = float(np.max(np.abs(found), where=np.isfinite(found), initial=0.0))
        if greatest > quantity.most or 0 < greatest < quantity.least:
            bound = f"at most {quantity.most:g}" if greatest > quantity.most else f"at least {quantity.least:g}"
            raise HDF5Error(
                f"{self.array.path} reaches {greatest:.3g} as {name}: a sensor gives {bound}; is the unit "
                f"{self.array.unit!r}?"
            )
        z = found[:, 2][np.isfinite(found[:, 2])] if name == "force_n" else np.zeros(0)
        pull = float(z.max(initial=0.0))
        if pull > max(LEAST_PULL_N, float(-z.min(initial=0.0))):
            raise HDF5Error(
                f"{self.array.path} reaches Fz = +{pull:.3g} N, which pulls at the gel: a press has Fz < 0; turn the "
                "sign of z in `components`"
            )
        return found.astype(np.float32)

    def times_ns(self, positions: np.ndarray) -> np.ndarray:
        """Times, int64, ascending.

        Raises:
          HDF5Error: they are not finite, or run backwards.
        """
        found, factor = self._raw(positions), self.array.factor
        if np.issubdtype(found.dtype, np.integer):
            greatest = max(int(found.max(initial=0)), -int(found.min(initial=0)))
            if greatest * int(factor) >= 2**63:
                raise HDF5Error(self._beyond())
            found = found.astype(np.int64) * int(factor)
        else:
            if not np.isfinite(found).all():
                raise HDF5Error(f"{self.array.path} for {self.what} holds times that are not finite")
            if np.abs(found.astype(np.float64)).max(initial=0) >= 2**63 / factor:
                raise HDF5Error(self._beyond())
            found = np.rint(found.astype(np.float64) * factor).astype(np.int64)
        if (np.diff(found) < 0).any():
            raise HDF5Error(f"{self.array.path} for {self.what} runs backwards")
        return found

    def _beyond(self) -> str:
        unit = self.array.unit
        return f"{self.array.path} for {self.what} holds times beyond 64 bits of nanoseconds; is the unit {unit!r}?"

    def pictures(self, positions: np.ndarray, keep: Keep) -> np.ndarray:
        """Pictures, uint8 [N, H, W, 3], RGB, at `keep.height` rows."""
        raw = self._raw(positions)
        if self.array.encoded:
            rows = [np.asarray(row, np.uint8).tobytes().rstrip(b"\0") for row in raw]
            pictures = [keep.shrink(decode_picture(row)) for row in rows]
            if len({picture.shape for picture in pictures}) > 1:
                raise HDF5Error(f"{self.array.path} for {self.what} holds pictures of different sizes")
            return np.stack(pictures)
        if self.array.factor != 1:
            if not (np.isfinite(raw).all() and raw.min() >= 0 and raw.max() <= 1):
                raise HDF5Error(f"{self.array.path} for {self.what} must lie in 0..1 by its unit '1'")
            raw = np.rint(raw * self.array.factor).astype(np.uint8)
        if raw.dtype != np.uint8:
            raise HDF5Error(f"{self.array.path} for {self.what} holds {raw.dtype}: must hold uint8, or unit '1'")
        if "C" not in self.array.axes:
            raw = np.repeat(raw[..., None], 3, -1)
        else:
            raw = raw[..., [self.array.components.index(c) for c in QUANTITIES["frames"].components]]
        return np.stack([keep.shrink(np.ascontiguousarray(frame)) for frame in raw])
