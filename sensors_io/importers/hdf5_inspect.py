"""Contents of an HDF5 file as lines of text, and a mapping of them to begin with.

The proposal goes by names, shapes and stated units.  What it cannot know it writes as "?", which `read_map` refuses by
name, so that nobody imports a guess about a unit, a sign, the sensor or the order of levels.
"""

import dataclasses
import pathlib
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sensors_io.importers.hdf5_map import PLACEHOLDER, QUANTITIES, UNITS
from sensors_io.importers.hdf5_read import SPELLED, STATED, HDF5Error, h5py, named, opened, spelled, stated
from sensors_io.schema import ATTRIBUTES, LEVELS, MATERIALS, SENSORS

DEEPEST = 3
"""Groups above a contact that a proposal looks through."""

SHOWN = 5
"""Names of groups that a listing gives of those with equal contents."""

MOST_NAMES = 20
"""Values from which on what carries an attribute's name is no label."""

NAMES: Mapping[str, str] = {
    "depth_mm": "depth|height|indent",
    "shear_mm": "shear|marker|flow",
    "deformation_mm": "deform|displac",
    "moment_nmm": "moment|torque",
    "force_n": "force|wrench|ft",
    "host_time_ns": "time|stamp|clock|^ts?$",
}
"""Array of the schema → pattern of the last part of a path."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Draft:
    """A mapping for one file; `labels` are (where, what the file says there)."""

    contact: str
    values: Mapping[str, Any]
    labels: Mapping[str, tuple[Mapping[str, str], frozenset[str]]]
    sensors: Mapping[str, Any]


def inspect(paths: Sequence[pathlib.Path]) -> tuple[list[str], dict[str, Any]]:
    """Contents of files as lines, and a mapping of their layout as JSON, with "?" where a person must decide.

    A line stands for each group and data set; of groups, or files, with equal contents one is listed, and others are
    named.  The mapping is of the first file's layout.

    Raises:
      HDF5Error: no file can be read.
    """
    lines: list[str] = []
    drafts: dict[pathlib.Path, _Draft] = {}
    for path in paths:
        try:
            with opened(path) as file:
                draft = _draft(file)
                alike = [other for other, of in drafts.items() if of.sensors == draft.sensors]
                listed = () if alike else _lines(file, "  ", {file["/"]: "/"})
                lines += [f"{path.name}: the arrays of {alike[0].name}"] if alike else [path.name, *listed]
            drafts[path] = draft
        except HDF5Error as error:
            lines.append(f"{path} {error}; fetch it again, or leave it out")
    if not drafts:
        raise HDF5Error(lines[-1])
    first, *others = drafts.values()
    same = [first, *(draft for draft in others if draft.sensors == first.sensors)]
    labels = {
        attribute: _named(
            attribute, where, {value for draft in same for value in draft.labels.get(attribute, ((), ()))[1]}
        )
        for attribute, (where, _) in first.labels.items()
    }
    head = {"source": paths[0].parent.name, "licence": PLACEHOLDER, "contact": _common([d.contact for d in same])}
    return lines, {**head, **first.values, **({"labels": labels} if labels else {}), "sensors": first.sensors}


def _draft(file: Any) -> _Draft:
    pattern, group = _contacts(file)
    found = {name: data for name, data in _datasets(group) if data.dtype.kind in "fiuO"}
    rows = next(({kind: f"/{n}"} for n in found for kind in ("lengths", "offsets") if kind[:6] in n.lower()), None)
    sensors: dict[str, dict[str, Any]] = {}
    arrays = {name: kind for name, data in found.items() if (kind := _kind(name, data)) is not None}
    for name, kind in arrays.items():
        if kind in ("frames", "depth_mm", "deformation_mm"):
            sensors.setdefault(_sensor(name), {})
    for name, kind in arrays.items():
        entry = _entry(name, kind, found[name], rows)
        of = [s for s in sensors if s == _sensor(name)] or list(sensors)  # a force sensor serves all of them
        for sensor in of:
            if kind == "host_time_ns" and sensor != _sensor(name):
                continue
            times = [t for t, k in arrays.items() if k == "host_time_ns" and _folder(t) == _folder(name)]
            own = {"time": _entry(times[0], "host_time_ns", found[times[0]], rows)} if times else {}
            sensors[sensor].setdefault(kind, entry | (own if sensor != _sensor(name) else {}))
    for stream in sensors.values():
        if "host_time_ns" not in stream:
            stream["rate_hz"] = PLACEHOLDER
    named = next((a for a in group.attrs if re.search("object|sample|specimen|item", a.lower())), None)
    moved = next((a for a in group.attrs if "motion" in a.lower()), None)
    object_id = {"object_id": {"attribute": named}} if named else {}
    return _Draft(
        contact=pattern,
        values={**object_id, "motion": {"attribute": moved} if moved else {"value": PLACEHOLDER}},
        labels={a: label for a in ATTRIBUTES if (label := _label(a, file, group)) is not None},
        sensors=sensors,
    )


def _common(patterns: Sequence[str]) -> str:
    """One pattern for all of those that are as deep as the first."""
    parts = [pattern.split("/") for pattern in patterns if pattern.count("/") == patterns[0].count("/")]
    return "/".join(one[0] if len(set(one)) == 1 else "*" for one in zip(*parts, strict=True))


def _label(attribute: str, file: Any, group: Any) -> tuple[Mapping[str, str], frozenset[str]] | None:
    """The attribute or data set of a contact that seems to be this label, and all that the file says there."""
    above = group
    while above.name != "/" and not any(attribute in a.lower() for a in above.attrs):
        above = above.parent
    in_attributes = [a for a in above.attrs if attribute in a.lower()]
    in_arrays = [n for n, data in _datasets(group) if attribute in n.lower() and data.ndim < 2]
    if not in_attributes and not in_arrays:
        return None
    values: set[str] = set()

    def gather(name: str, item: Any) -> None:
        if in_attributes and in_attributes[0] in item.attrs:
            values.update(map(spelled, stated(item, in_attributes[0]).ravel()))
        elif not in_attributes and f"/{name}".endswith(f"/{in_arrays[0]}") and isinstance(item, h5py().Dataset):
            values.update(map(spelled, stated(item).ravel()))

    gather("", file)
    file.visititems(gather)
    where = {"attribute": in_attributes[0]} if in_attributes else {"path": in_arrays[0]}
    return (where, frozenset(values)) if len(values) <= MOST_NAMES else None


def _named(attribute: str, where: Mapping[str, str], values: set[str]) -> dict[str, Any]:
    """The entry of a label; values that are no levels need names."""
    plain = {str(level) for level in range(LEVELS[attribute])} | set(MATERIALS if attribute == "material" else ())
    return dict(where) if values <= plain else {**where, "names": dict.fromkeys(sorted(values), PLACEHOLDER)}


def _lines(group: Any, indent: str, listed: dict[Any, str]) -> Iterator[str]:
    """Lines of a group; one that links lead to once more is not listed again."""
    for name in group.attrs:
        text = str(stated(group, name)) if group.attrs.get_id(name).shape is not None else ""
        yield f"{indent}@{name} = {''.join(c if c.isprintable() else ' ' for c in text[:60])}"
    seen: dict[tuple[Any, ...], list[str]] = {}
    for name, item in group.items():
        named(name)
        if isinstance(item, h5py().Dataset):
            units = ", ".join(f"{a} {item.attrs[a]}" for a in STATED if a in item.attrs)
            shape = " without a value" if item.shape is None else list(item.shape)
            yield f"{indent}{name}  {item.dtype}{shape}{f'  ({units})' if units else ''}"
            continue
        if not isinstance(item, h5py().Group):
            yield f"{indent}{name}  (broken link)" if item is None else f"{indent}{name}  (named type)"
            continue
        if item in listed:
            yield f"{indent}{name}/  (a link to {listed[item]})"
            continue
        listed[item] = item.name
        about = tuple((n, str(data.dtype), data.shape and data.shape[1:]) for n, data in _datasets(item))
        alike = seen.setdefault(about, [])
        alike.append(name)
        if len(alike) == 1:
            yield f"{indent}{name}/"
            yield from _lines(item, indent + "  ", listed)
    for first, *others in seen.values():
        if others:
            names = ", ".join(others[:SHOWN]) + (f" … {others[-1]}" if len(others) > SHOWN else "")
            yield f"{indent}… with the arrays of {first}: {names}"


def _contents(group: Any) -> tuple[Any, ...]:
    return tuple((name, str(data.dtype), data.ndim) for name, data in _datasets(group))


def _datasets(group: Any) -> Iterator[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    group.visititems(lambda name, item: found.append((named(name), item)) if isinstance(item, h5py().Dataset) else None)
    yield from found


def _contacts(file: Any) -> tuple[str, Any]:
    """Pattern of the groups that most often have the same contents, with something to see, and the first of them."""
    levels: dict[int, dict[Any, str]] = {0: {file["/"]: ""}}  # groups with their paths
    for depth in range(1, DEEPEST + 1):
        levels[depth] = {}
        for parent, at in levels[depth - 1].items():
            for name, item in parent.items():
                if isinstance(item, h5py().Group):
                    levels[depth].setdefault(item, f"{at}/{name}")
    best: tuple[int, str, Any] = (0, "/", file)
    for depth, groups in levels.items():
        visible = [g for g in groups if any(_kind(n, d) in ("frames", "depth_mm") for n, d in _datasets(g))]
        counts = Counter(_contents(g) for g in visible)
        if counts:
            contents, number = counts.most_common(1)[0]
            same = [g for g in visible if _contents(g) == contents]
            if number > best[0]:
                parts = [groups[g].strip("/").split("/") for g in same]
                shared = [
                    next(iter(c)) if len(c) == 1 and depth > 1 else "*" for c in map(set, zip(*parts, strict=True))
                ]
                best = number, "/" + "/".join(shared[:depth]) if depth else "/", same[0]
    return best[1], best[2]


def _kind(name: str, data: Any) -> str | None:
    """The array of the schema that a data set seems to be."""
    last = name.rpartition("/")[2].lower()
    pictures = data.dtype == np.uint8 and (data.ndim == 4 or data.ndim == 2)
    if pictures or h5py().check_vlen_dtype(data.dtype) == np.uint8:
        return "frames"
    kinds = (kind for kind, pattern in NAMES.items() if re.search(pattern, last))
    return next((kind for kind in kinds if data.ndim == len(QUANTITIES[kind].axes)), None)


def _entry(name: str, kind: str, data: Any, rows: Mapping[str, str] | None) -> dict[str, Any]:
    quantity, entry = QUANTITIES[kind], {"path": name}
    unit = next((str(data.attrs[a]) for a in STATED if a in data.attrs), "")
    unit = SPELLED.get(unit.strip().lower(), unit.strip())
    if kind != "frames":
        entry["unit"] = unit if unit in UNITS[quantity.kind] else PLACEHOLDER
    whole: dict[str, Any] = dict(entry)
    if kind == "frames" and data.ndim < 4:
        whole["encoded"] = True
    elif kind == "frames" and data.shape[-1] != len(quantity.components):
        whole["axes"] = "NCHW"
    elif kind != "frames" and quantity.components:
        whole["components"] = [PLACEHOLDER] * len(quantity.components)
        whole["components"] += [None] * (data.shape[-1] - len(quantity.components))
    return whole if rows is None else whole | {"rows": dict(rows)}


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _sensor(name: str) -> str:
    """The sensor of a data set: one that the path names, else the group that it lies in."""
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    known = next((s for s in SENSORS if s.replace("_", "") in plain or s.partition("_")[0] in plain), None)
    plain = re.sub(r"[^A-Za-z0-9.\-]+", "_", _folder(name)).strip("_.-") or "sensor"
    return known or f"{PLACEHOLDER} {plain}"
