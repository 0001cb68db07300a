"""HDF5 recordings of any layout, by a mapping of their paths, units, axes and rows (see `hdf5_map`).

    DIR/**/*.h5, *.hdf5     in each the groups that the mapping calls contacts

A contact of which an array is missing, damaged or beyond what a tactile sensor gives is left out and reported by name.
Arrays that another clock sampled, such as force, are interpolated at the times of the frames; a frame outside of that
clock's time is flagged `INCOMPLETE` and takes its nearest value.
"""

import dataclasses
import fnmatch
import functools
import pathlib
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from sensors_io.importers.catalogue import Catalogue, Listed, fingerprint, require_files
from sensors_io.importers.hdf5_map import ArrayMap, LayoutMap, ValueMap, read_map
from sensors_io.importers.hdf5_read import HDF5Error, Place, bounds, dataset, h5py, named, opened, read_contact, spelled
from sensors_io.importers.holdout import split_by_name
from sensors_io.importers.keep import ImportConfig, ImportSourceError, Skip
from sensors_io.schema import ATTRIBUTES, MATERIALS, ContactKey, ObjectCard, SchemaError

SUFFIXES = (".h5", ".hdf5", ".hdf")


@dataclasses.dataclass(frozen=True, kw_only=True)
class HDF5Config(ImportConfig):
    """Selection of frames and objects, and what the files do not say.

    Args:
      map: JSON file of the mapping, see `hdf5_map`.
      annotator: name of who labelled.
    """

    map: pathlib.Path | None = None
    annotator: str = "not named"


def list_hdf5(source: pathlib.Path, config: HDF5Config) -> Catalogue:
    """Catalogue of all contacts that the mapping finds; files that cannot be opened are reported.

    Raises:
      ImportSourceError: no such file, no contact, or no h5py.
    """
    files = hdf5_files(source)
    if config.map is None:
        raise ImportSourceError("map is None: must be the JSON file of a mapping; `--inspect` proposes one")
    layout = read_map(config.map)
    skipped: list[Skip] = []
    contacts: dict[ContactKey, Listed] = {}
    cards: dict[str, ObjectCard] = {}
    trials: dict[ContactKey, int] = {}  # the next one of those that a layout does not number
    unmapped: set[str] = set()
    for path in files:
        try:
            with opened(path) as file:
                places = list(contact_places(path, file, layout))
                facts = [(place, _facts(file, place, layout, config.annotator)) for place in places]
                unmapped.update(*(_unmapped(file, place, layout) for place in places[:1]))
        except HDF5Error as error:
            skipped.append(Skip(name=path.name, reason=str(error)))
            continue
        if not facts:
            skipped.append(Skip(name=path.name, reason=f"no group fits contact {layout.contact!r}; see `--inspect`"))
        for place, found in facts:
            if isinstance(found, HDF5Error):
                skipped.append(Skip(name=place.name, reason=str(found)))
                continue
            key, card = found
            if cards.setdefault(key.object_id, card) != card:
                skipped.append(Skip(name=place.name, reason=f"labels object {key.object_id!r} unlike an earlier one"))
                continue
            stated = key
            while key in contacts:
                key = dataclasses.replace(stated, trial=max(trials.get(stated, 0), key.trial + 1))
            trials[stated] = key.trial + 1
            read = functools.partial(read_contact, place, key, layout, config)
            contacts[key] = Listed(key=key, name=place.name, read=read)
    skipped += [Skip(name=name, reason="not in the mapping") for name in sorted(unmapped)]
    splits = split_by_name(cards, val_share=config.val_share, test_share=config.test_share)
    labelled = tuple(a for a in ATTRIBUTES if a in layout.labels)
    return Catalogue(
        source=layout.source,
        licence=layout.licence,
        sensors=tuple(layout.sensors),
        annotated=labelled,
        cards={name: dataclasses.replace(card, split=splits[name]) for name, card in cards.items()},
        contacts=tuple(contacts.values()),
        skipped=tuple(skipped),
        config=dataclasses.asdict(config) | {"map": config.map.name},
        identity=fingerprint(source, files, dataclasses.replace(config, map=None), (config.map,)),
    )


def hdf5_files(source: pathlib.Path) -> list[pathlib.Path]:
    """HDF5 files of a directory, or the one file.

    Raises:
      ImportSourceError: there are none.
    """
    inside = [source] if source.is_file() else sorted(source.rglob("*"))
    files = [path for path in inside if path.suffix.lower() in SUFFIXES and path.is_file()]
    require_files(source, files, f"HDF5 files ({', '.join(SUFFIXES)})")
    return files


def contact_places(path: pathlib.Path, file: Any, layout: LayoutMap) -> Iterator[Place]:
    """Contacts of a file, in the order of the numbers in the names of their groups."""
    groups = ["/"]
    file.visititems(lambda name, item: groups.append(f"/{named(name)}") if isinstance(item, h5py().Group) else None)
    wanted = layout.contact if layout.contact.startswith("/") else f"/{layout.contact}"
    depth = wanted.count("/")
    fits = lambda name: (
        name.count("/") == depth and fnmatch.fnmatchcase(name, wanted) and (name == "/") is (wanted == "/")
    )
    for group in sorted(filter(fits, groups), key=_by_number):
        counts = {len(bounds(file, group, array.rows)) - 1 for array in _arrays(layout) if array.rows is not None}
        if len(counts) > 1:
            raise HDF5Error(f"{group} states the rows of {' and of '.join(map(str, sorted(counts)))} contacts")
        yield from (Place(file=path, group=group, row=row) for row in range(counts.pop() if counts else 1))


def _arrays(layout: LayoutMap) -> Iterator[ArrayMap]:
    for stream in layout.sensors.values():
        for array in stream.arrays.values():
            yield array
            if array.time is not None:
                yield array.time


def _unmapped(file: Any, place: Place, layout: LayoutMap) -> list[str]:
    """Data sets of a contact's group that the mapping names for nothing."""
    named_paths = [path for a in _arrays(layout) for path in (a.path, *([] if a.rows is None else [a.rows.path]))]
    values = (*layout.values.values(), *layout.labels.values())
    named_paths += [str(of.value) for of in values if of.kind == "path"]
    group = place.group.rstrip("/")
    used = {path if path.startswith("/") else f"{group}/{path}" for path in named_paths}
    found: list[str] = []
    file[place.group].visititems(lambda name, item: found.append(name) if isinstance(item, h5py().Dataset) else None)
    return [name for name in found if f"{group}/{name}" not in used]


def _facts(file: Any, place: Place, layout: LayoutMap, annotator: str) -> tuple[ContactKey, ObjectCard] | HDF5Error:
    """Key and card of a contact, or what is wrong with them; the split is set later."""
    value = lambda name, otherwise: (
        _stated(file, place, layout.values[name], name) if name in layout.values else otherwise
    )
    try:
        object_id = _plain_name(str(value("object_id", place.name)))
        whole = {name: _whole(value(name, 0), name) for name in ("site", "trial")}
        key = ContactKey(object_id=object_id, motion=str(value("motion", "free")), **whole)
        labels = {a: _level(a, _stated(file, place, of, a), of.names) for a, of in layout.labels.items()}
        name = object_id.replace("_", " ")
        return key, ObjectCard(object_id=object_id, split="train", labels=labels, annotator=annotator, name=name)
    except (HDF5Error, SchemaError) as error:
        return HDF5Error(str(error))


def _stated(file: Any, place: Place, of: ValueMap, name: str) -> Any:
    """The value of a contact that the mapping names."""
    if of.kind == "value":
        return of.value
    if of.kind == "attribute":
        group = file[place.group]
        while of.value not in group.attrs and group.name != "/":
            group = group.parent
        if of.value not in group.attrs:
            raise HDF5Error(f"{place.group} and the groups above it lack the attribute {of.value!r} of {name}")
        found = group.attrs[of.value]
    else:
        found = dataset(file, place.group, of.value, name)[()]
    found = np.asarray(found)
    row = place.row if found.size > 1 else 0  # one value is that of all rows
    if found.size <= row:
        raise HDF5Error(f"{of.value} of {name} has no value for row {place.row}")
    chosen = found.ravel()[row]
    return chosen.decode(errors="replace") if isinstance(chosen, bytes) else chosen


def _whole(value: Any, name: str) -> int:
    try:
        whole = int(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise HDF5Error(f"{name} is {value!r:.60}: must be a whole number") from error
    if not isinstance(value, str) and whole != value:
        raise HDF5Error(f"{name} is {value!r:.60}: must be a whole number")
    return whole


def _level(attribute: str, value: Any, names: Mapping[str, int] | None) -> int:
    if names is not None:
        said = spelled(value)
        if said not in names:
            raise HDF5Error(f"{attribute} is {said!r:.60}: the names of the mapping lack it")
        return names[said]
    if attribute == "material" and str(value) in MATERIALS:
        return MATERIALS.index(str(value))
    return _whole(value, attribute)


def _plain_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9.\-]+", "_", text).strip("_.-") or "object"


def _by_number(name: str) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.findall(r"\d+|\D+", name)]
