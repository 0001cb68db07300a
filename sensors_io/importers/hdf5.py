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
import posixpath
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from sensors_io.importers.catalogue import Catalogue, Listed, fingerprint, plain_names, require_files
from sensors_io.importers.hdf5_map import ArrayMap, LayoutMap, ValueMap, read_map
from sensors_io.importers.hdf5_read import (
    HDF5Error,
    Place,
    bounds,
    dataset,
    h5py,
    named,
    opened,
    read_contact,
    spelled,
    stated,
)
from sensors_io.importers.holdout import split_by_name
from sensors_io.importers.keep import ImportConfig, ImportSourceError, Skip
from sensors_io.importers.pictures import inside
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
    found, skipped = _contacts(source, files, layout, config.annotator)
    contacts: dict[ContactKey, Listed] = {}
    cards: dict[str, ObjectCard] = {}
    trials: dict[ContactKey, int] = {}  # the next one of those that a layout does not number
    names = plain_names((name for _, name, _, _ in found), "object")
    for place, name, key, card in found:
        key = dataclasses.replace(key, object_id=names[name])
        card = dataclasses.replace(card, object_id=key.object_id)
        if cards.setdefault(key.object_id, card) != card:
            skipped.append(Skip(name=place.name, reason=f"labels object {key.object_id!r} unlike an earlier one"))
            continue
        unnumbered = key
        while key in contacts:
            key = dataclasses.replace(unnumbered, trial=max(trials.get(unnumbered, 0), key.trial + 1))
        trials[unnumbered] = key.trial + 1
        read = functools.partial(read_contact, place, key, layout, config)
        contacts[key] = Listed(key=key, name=place.name, read=read)
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


_Contact = tuple[Place, str, ContactKey, ObjectCard]
"""Where a contact lies, the name of its object in the file, its key and card without the object's identity."""


def _contacts(
    source: pathlib.Path, files: list[pathlib.Path], layout: LayoutMap, annotator: str
) -> tuple[list[_Contact], list[Skip]]:
    """Contacts of all files, and what is wrong with others; arrays that the mapping leaves out are named too."""
    found: list[_Contact] = []
    skipped: list[Skip] = []
    unmapped: set[str] = set()
    for path in files:
        of_file: list[_Contact] = []
        shown = path.name if path == source else path.relative_to(source).as_posix()
        try:
            with opened(path) as file:
                places = list(contact_places(path, shown, file, layout))
                for place in places:
                    try:
                        of_file.append((place, *_facts(file, place, layout, annotator)))
                    except HDF5Error as error:
                        skipped.append(Skip(name=place.name, reason=str(error)))
                unmapped.update(*(_unmapped(file, place, layout) for place, *_ in of_file[:1]))
        except HDF5Error as error:
            skipped.append(Skip(name=shown, reason=str(error)))
            continue
        if not places:
            skipped.append(Skip(name=shown, reason=f"no group fits contact {layout.contact!r}; see `--inspect`"))
        found += of_file
    return found, [*skipped, *(Skip(name=name, reason="not in the mapping") for name in sorted(unmapped))]


def hdf5_files(source: pathlib.Path) -> list[pathlib.Path]:
    """HDF5 files of a directory, or the one file.

    Raises:
      ImportSourceError: there are none.
    """
    found = [source] if source.is_file() else sorted(inside(source))
    files = [path for path in found if path.suffix.lower() in SUFFIXES and path.is_file()]
    require_files(source, files, f"HDF5 files ({', '.join(SUFFIXES)})")
    return files


def contact_places(path: pathlib.Path, shown: str, file: Any, layout: LayoutMap) -> Iterator[Place]:
    """Contacts of a file, in the order of the numbers in the names of their groups; one with two names counts once."""
    groups: dict[Any, str] = {}
    for at, group in sorted(_fitting(file, "", layout.contact.strip("/")), key=lambda found: _by_number(found[0])):
        groups.setdefault(at if group is None else group, at)
    for group in groups.values():
        rows = [array.rows for array in _arrays(layout) if array.rows is not None] if file.get(group) else []
        counts = {len(bounds(file, group, of)) - 1 for of in rows}
        if len(counts) > 1:
            raise HDF5Error(f"{group} states the rows of {' and of '.join(map(str, sorted(counts)))} contacts")
        count = counts.pop() if counts else 1
        yield from (Place(file=path, shown=shown, group=group, row=row, rows=count) for row in range(count))


def _fitting(group: Any, at: str, pattern: str) -> Iterator[tuple[str, Any]]:
    """Groups that fit a pattern, with their paths; links count as what they lead to, `None` where it is not there."""
    wanted, _, below = pattern.partition("/")
    if not wanted:
        yield at or "/", group
        return
    for name in group:
        if not fnmatch.fnmatchcase(named(name), wanted):
            continue
        item = group.get(name)
        if item is None:
            yield f"{at}/{name}", None
        elif isinstance(item, h5py().Group):
            yield from _fitting(item, f"{at}/{name}", below)


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


def _facts(file: Any, place: Place, layout: LayoutMap, annotator: str) -> tuple[str, ContactKey, ObjectCard]:
    """Name of the object in the file, key and card of a contact; identity and split of the object are set later."""
    if file.get(place.group) is None:
        raise HDF5Error("is a broken link: put back what it leads to")
    value = lambda name, otherwise: (
        _stated(file, place, layout.values[name], name) if name in layout.values else otherwise
    )
    try:
        object_name = str(value("object_id", place.name))
        whole = {name: _whole(value(name, 0), name) for name in ("site", "trial")}
        key = ContactKey(object_id="object", motion=str(value("motion", "free")), **whole)
        labels = {a: _level(a, _stated(file, place, of, a), of.names) for a, of in layout.labels.items()}
        shown = object_name.replace("_", " ")
        card = ObjectCard(object_id="object", split="train", labels=labels, annotator=annotator, name=shown)
        return object_name, key, card
    except SchemaError as error:
        raise HDF5Error(str(error)) from error


def _stated(file: Any, place: Place, of: ValueMap, name: str) -> Any:
    """The value of a contact that the mapping names."""
    if of.kind == "value":
        return of.value
    if of.kind == "attribute":
        at = place.group
        while of.value not in file[at].attrs and at != "/":
            at = posixpath.dirname(at)
        if of.value not in file[at].attrs:
            raise HDF5Error(f"{place.group} and the groups above it lack the attribute {of.value!r} of {name}")
        found = stated(file[at], of.value)
    else:
        found = stated(dataset(file, place.group, of.value, name))
    flat = found.ravel()
    if not flat.size:
        raise HDF5Error(f"{of.value} of {name} holds no value")
    if 1 < place.rows == flat.size == max(found.shape):
        flat = flat[place.row :]
    elif flat.size > 1 and (flat != flat[0]).any():
        rows = f" or {place.rows}, one a row" if place.rows > 1 else ""
        raise HDF5Error(f"{of.value} of {name} holds {flat.size} values that differ: must hold one{rows}")
    value = flat[0].decode(errors="backslashreplace") if isinstance(flat[0], bytes) else flat[0]
    if not isinstance(value, (str, int, float, np.number, np.bool_)):
        raise HDF5Error(f"{of.value} of {name} is {value!r:.60}: must be a text or a number")
    return value


def _whole(value: Any, name: str) -> int:
    try:
        whole = int("" if isinstance(value, (bool, np.bool_)) else value)
    except (TypeError, ValueError, OverflowError) as error:
        raise HDF5Error(f"{name} is {value!r:.60}: must be a whole number") from error
    if not isinstance(value, str) and whole != value:
        raise HDF5Error(f"{name} is {value!r:.60}: must be a whole number")
    return whole


def _level(attribute: str, value: Any, names: Mapping[str, int] | None) -> int:
    if names is not None:
        level = spelled(value)
        if level not in names:
            raise HDF5Error(f"{attribute} is {level!r:.60}: the names of the mapping lack it")
        return names[level]
    if attribute == "material" and str(value) in MATERIALS:
        return MATERIALS.index(str(value))
    try:
        return _whole(value, attribute)
    except HDF5Error as error:
        raise HDF5Error(f"{error}, or one of the mapping's `names`") from error


def _by_number(name: str) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.findall(r"\d+|\D+", name)]
