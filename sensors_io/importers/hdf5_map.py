"""Mapping of an HDF5 layout to the schema: where the arrays of each sensor lie, in which units, axes and rows.

    {
      "source": "TouchReason", "licence": "CC BY 4.0",
      "contact": "/trials/*",
      "object_id": {"attribute": "object"}, "motion": {"value": "press"},
      "labels": {
        "hardness": {"path": "labels/hardness"},
        "material": {"attribute": "made of", "names": {"steel": "metal", "oak": "wood", "unknown": -1}}
      },
      "sensors": {
        "gelsight_mini": {
          "frames": {"path": "gelsight/rgb"},
          "host_time_ns": {"path": "gelsight/time", "unit": "s"},
          "depth_mm": {"path": "gelsight/depth", "unit": "m", "axes": "HWN"},
          "force_n": {"path": "ft/force", "unit": "N", "components": ["x", "-y", "z"],
                      "time": {"path": "ft/time", "unit": "s"}}
        }
      }
    }

`contact` is a pattern of groups, each one contact, in which "*" may stand at every level; "/" takes a file for one.  A
path is relative to that group, or to the file with a leading "/".  Sensors that the studies know are gelsight_mini,
xense, tac3d and dmtac_x.  Vectors are on the gel: x points right, y down, z out of the gel, so a press has Fz < 0.  A
label is a level from 0 (soft, smooth, flat) to 2, or a name of a material; `names` turns what a file says into these.
Without an entry, a contact is an object of its own, its motion is "free", and its site and trial are 0, or the next
trial that is free.
"""

import dataclasses
import json
import pathlib
from collections.abc import Mapping
from typing import Any

from sensors_io.importers.keep import LEAST_HZ, MOST_HZ, ImportSourceError
from sensors_io.json_files import distinct
from sensors_io.schema import ATTRIBUTES, LEVELS, MATERIALS, MOTIONS, SENSORS, UNKNOWN

PLACEHOLDER = "?"
"""What `--inspect` writes where a person must decide; refused by name."""

UNITS: Mapping[str, Mapping[str, float]] = {
    "picture": {"": 1.0, "1": 255.0},
    "length": {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "in": 25.4},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3, "kgf": 9.80665, "lbf": 4.4482216152605},
    "moment": {"N mm": 1.0, "N cm": 10.0, "N m": 1e3},
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
}
"""Quantity → unit → factor to the unit of the schema; a picture in "1" runs from 0 to 1."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quantity:
    """An array of the schema that a map may name.

    Args:
      kind: key of `UNITS`.
      axes: of the schema, without the components.
      components: of the last axis, none for a scalar.
      most: greatest magnitude that a tactile sensor gives, in the schema's unit.
      least: magnitude that the greatest value of a contact must reach, or all of them are 0.
    """

    kind: str
    axes: str
    components: tuple[str, ...] = ()
    most: float = float("inf")
    least: float = 0.0


QUANTITIES: Mapping[str, Quantity] = {
    "frames": Quantity(kind="picture", axes="NHWC", components=("r", "g", "b")),
    "depth_mm": Quantity(kind="length", axes="NHW", most=20.0, least=1e-3),
    "deformation_mm": Quantity(kind="length", axes="NHWC", components=("x", "y"), most=20.0, least=1e-3),
    "shear_mm": Quantity(kind="length", axes="NHWC", components=("x", "y"), most=20.0, least=1e-3),
    "force_n": Quantity(kind="force", axes="NC", components=("x", "y", "z"), most=500.0),
    "moment_nmm": Quantity(kind="moment", axes="NC", components=("x", "y", "z"), most=5e4),
    "host_time_ns": Quantity(kind="time", axes="N"),
    "device_time_ns": Quantity(kind="time", axes="N"),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RowsMap:
    """Rows of a contact in arrays that hold the rows of many, by the `lengths` or the `offsets` of all contacts."""

    path: str
    kind: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArrayMap:
    """Where one array lies and what it means.

    Args:
      path: of the data set.
      factor: to the unit of the schema; `unit` as the map gives it.
      axes: of the data set in its order, such as "NCHW"; pictures without C are grey.
      components: along its axis C in its order, with "-" before one of the opposite sign; `null` in the mapping, ""
        here, leaves one out.
      rows: of a contact, where the data set holds those of many.
      time: of its own rows, where it was sampled by another clock than the frames.
      encoded: its rows are JPEG or PNG files.
      optional: a contact may lack it.
    """

    path: str
    unit: str
    factor: float
    axes: str
    components: tuple[str, ...]
    rows: RowsMap | None = None
    time: "ArrayMap | None" = None
    encoded: bool = False
    optional: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class ValueMap:
    """A value of a contact: an `attribute` of its group or one above, the `path` of a number or text, or a `value`.

    `names` gives the level of each text or number that a file may say.
    """

    kind: str
    value: Any
    names: Mapping[str, int] | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class StreamMap:
    """Arrays of one sensor by their names in the schema, and the rate of frames where no time is stored."""

    arrays: Mapping[str, ArrayMap]
    rate_hz: float | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class LayoutMap:
    """A whole mapping; `values` are those of object_id, site, motion and trial that it states."""

    source: str
    licence: str
    contact: str
    values: Mapping[str, ValueMap]
    labels: Mapping[str, ValueMap]
    sensors: Mapping[str, StreamMap]


def read_map(path: pathlib.Path) -> LayoutMap:
    """Read and check a mapping.

    Raises:
      ImportSourceError: no such file, no JSON, or an entry that does not fit; the message names it.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=distinct)
    except (OSError, ValueError, RecursionError) as error:
        raise ImportSourceError(f"{path} is no mapping: {error}; write one, as `--inspect` proposes") from error
    root = _Entry(found, path.name)
    root.know("source", "licence", "contact", "labels", "sensors", *_VALUES)
    sensors = root.part("sensors")
    if not sensors.found:
        raise ImportSourceError(f"{sensors.name} is empty: must name at least one sensor; add its arrays")
    labels = root.part("labels", {})
    labels.know(*ATTRIBUTES)
    open_names = [name for name in sensors.found if name.startswith(PLACEHOLDER)]
    if open_names or root.found.get("licence") == PLACEHOLDER:
        known = f"must be one of {', '.join(SENSORS)}, or another name, which studies do not know"
        raise ImportSourceError(
            f"{sensors.name}: {open_names[0]!r}: {known}; rename it"
            if open_names
            else f"{root.name}: licence is {PLACEHOLDER!r}: must be the licence of the recordings; give it"
        )
    values = {name: _value(root.part(name)) for name in _VALUES if name in root.found}
    motion = values.get("motion")
    if motion is not None and motion.kind == "value" and motion.value not in MOTIONS:
        raise ImportSourceError(f"{root.name}: motion is {motion.value!r:.60}: must be one of {', '.join(MOTIONS)}")
    return LayoutMap(
        source=root.text("source", "HDF5 recordings"),
        licence=root.text("licence", "all rights reserved"),
        contact=root.text("contact", "/"),
        values=values,
        labels={name: _label(labels.part(name), name) for name in labels.found},
        sensors={name: _stream(sensors.part(name)) for name in sensors.found},
    )


_VALUES = ("object_id", "site", "motion", "trial")


class _Entry:
    """An object of the mapping, whose wrong entries are named in full."""

    def __init__(self, found: Any, name: str) -> None:
        if not isinstance(found, dict):
            raise ImportSourceError(f"{name} is {found!r:.60}: must be an object; correct it")
        self.found, self.name = found, name

    def part(self, key: str, otherwise: Any = None) -> "_Entry":
        return _Entry(self.found.get(key, otherwise), f"{self.name}: {key}")

    def know(self, *keys: str) -> None:
        unknown = [key for key in self.found if key not in keys]
        if unknown:
            raise ImportSourceError(f"{self.name}: {unknown[0]!r} must be one of {', '.join(keys)}; correct it")

    def text(self, key: str, otherwise: str | None = None) -> str:
        value = self.found.get(key, otherwise)
        if not isinstance(value, str):
            raise ImportSourceError(f"{self.name}: {key} is {value!r:.60}: must be a text; give it")
        return value

    def choice(self, key: str, otherwise: str | None, choices: Mapping[str, Any]) -> str:
        value = self.text(key, otherwise)
        if value not in choices:
            listed = ", ".join(map(repr, choices))
            raise ImportSourceError(f"{self.name}: {key} is {value!r}: must be one of {listed}; correct it")
        return value

    def switch(self, key: str) -> bool:
        value = self.found.get(key, False)
        if not isinstance(value, bool):
            raise ImportSourceError(f"{self.name}: {key} is {value!r:.60}: must be true or false; correct it")
        return value

    def one_of(self, *keys: str, besides: str = "") -> tuple[str, Any]:
        """The only entry but for `besides`, with its key."""
        found = [(key, value) for key, value in self.found.items() if key != besides]
        if len(found) != 1 or found[0][0] not in keys:
            raise ImportSourceError(
                f"{self.name} holds {[*self.found]}: must hold one of {', '.join(keys)}; correct it"
            )
        return found[0]


def _value(entry: _Entry, besides: str = "") -> ValueMap:
    kind, value = entry.one_of("attribute", "path", "value", besides=besides)
    if kind != "value":
        entry.text(kind)
    elif not isinstance(value, (str, int, float)):
        raise ImportSourceError(f"{entry.name}: value is {value!r:.60}: must be a text or a number; correct it")
    return ValueMap(kind=kind, value=value)


def _label(entry: _Entry, attribute: str) -> ValueMap:
    of = _value(entry, besides="names")
    if "names" not in entry.found:
        return of
    names = entry.part("names")
    levels = {str(level): level for level in range(UNKNOWN, LEVELS[attribute])}
    if attribute == "material":
        levels |= {material: i for i, material in enumerate(MATERIALS)}
    wrong = next((name for name, level in names.found.items() if str(level) not in levels), None)
    if wrong is not None:
        raise ImportSourceError(
            f"{names.name}: {wrong!r} is {names.found[wrong]!r:.60}: must be one of {', '.join(levels)}; correct it"
        )
    return dataclasses.replace(of, names={name: levels[str(level)] for name, level in names.found.items()})


def _stream(entry: _Entry) -> StreamMap:
    entry.know(*QUANTITIES, "rate_hz")
    arrays = {
        name: _array(entry.part(name), quantity, timed=quantity.kind != "time")
        for name, quantity in QUANTITIES.items()
        if name in entry.found
    }
    rate = entry.found.get("rate_hz")
    if not {"frames", "depth_mm", "deformation_mm"} & arrays.keys():
        raise ImportSourceError(f"{entry.name} has no frames, depth_mm or deformation_mm: needs one of them; add it")
    clock = arrays.get("host_time_ns")
    if clock is not None and (clock.optional or clock.time is not None):
        raise ImportSourceError(
            f"{entry.name}: host_time_ns is the clock of the frames: must be there, without a time of its own; leave "
            "`optional` and `time` out"
        )
    if "host_time_ns" in arrays and rate is None:
        return StreamMap(arrays=arrays, rate_hz=None)
    stated = isinstance(rate, (int, float)) and not isinstance(rate, bool) and LEAST_HZ <= rate <= MOST_HZ
    if "host_time_ns" in arrays or rate is None or not stated:
        raise ImportSourceError(
            f"{entry.name}: rate_hz is {rate!r}: must lie in {LEAST_HZ:g} … {MOST_HZ:g} where no host_time_ns is "
            "named, and absent otherwise; give one of them"
        )
    return StreamMap(arrays=arrays, rate_hz=float(rate))


def _array(entry: _Entry, quantity: Quantity, *, timed: bool = True) -> ArrayMap:
    entry.know("path", "unit", "axes", "components", "rows", "encoded", "optional", *(("time",) if timed else ()))
    units, encoded = UNITS[quantity.kind], entry.switch("encoded")
    unit = entry.choice("unit", "" if quantity.kind == "picture" else None, units)
    usual = "N" if encoded else quantity.axes
    axes = entry.text("axes", usual)
    grey = quantity.kind == "picture" and sorted(axes) == sorted("NHW")
    if sorted(axes) != sorted(usual) and not grey:
        raise ImportSourceError(f"{entry.name}: axes is {axes!r}: must be {usual} in some order; correct it")
    rows = None
    if "rows" in entry.found:
        kind, path = entry.part("rows").one_of("lengths", "offsets")
        rows = RowsMap(path=entry.part("rows").text(kind, path), kind=kind)
    time = _array(entry.part("time"), QUANTITIES["host_time_ns"], timed=False) if "time" in entry.found else None
    return ArrayMap(
        path=entry.text("path"),
        unit=unit,
        factor=units[unit],
        axes=axes,
        components=_components(entry, quantity),
        rows=rows,
        time=time,
        encoded=encoded,
        optional=entry.switch("optional"),
    )


def _components(entry: _Entry, quantity: Quantity) -> tuple[str, ...]:
    given = entry.found.get("components", list(quantity.components))
    if not isinstance(given, list) or not all(isinstance(one, str) or one is None for one in given):
        raise ImportSourceError(f"{entry.name}: components is {given!r:.60}: must be a list of names; correct it")
    named = [one for one in given if one is not None]
    if sorted(one.removeprefix("-") for one in named) != sorted(quantity.components):
        listed = ", ".join(quantity.components) or "nothing"
        raise ImportSourceError(
            f"{entry.name}: components is {given!r:.60}: must name {listed} once each, and null for others; correct it"
        )
    if quantity.kind == "picture" and any(one.startswith("-") for one in named):
        raise ImportSourceError(f"{entry.name}: components is {given!r:.60}: colours have no sign; drop the '-'")
    return tuple(one or "" for one in given)
