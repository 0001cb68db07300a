"""Records as a tree of arrays, in a Zarr folder or an HDF5 file, and back without loss.

    /                             attribute `touchr1`: JSON with source, licence, sensors and notes
    /objects/<number>             attribute `plain`: JSON with object_id, labels, …;   view, view_depth_mm
    /contacts/<number>/<sensor>   attribute `plain`: JSON with key, serial, camera, …;   the arrays of FRAME_ARRAYS
    /backgrounds/<file>           bytes of the PNG files with the gel at rest

Both libraries compress without loss; arrays have the types and units of `schema.FRAME_ARRAYS`.
"""

import contextlib
import pathlib
from collections.abc import Callable, Iterator
from typing import Any, Literal

import numpy as np

from sensors_io.contents import RESTS, rest_pictures
from sensors_io.exporters.kept_file import KeptFile
from sensors_io.exporters.selection import (
    VIEWS,
    FoundExport,
    Progress,
    Selected,
    card_of,
    card_text,
    head_of,
    head_text,
    library,
    published,
    sequence_of,
    sequence_text,
)
from sensors_io.schema import FRAME_ARRAYS, ObjectCard, Sequence

Kind = Literal["zarr", "hdf5"]

_HEAD, _PLAIN = "touchr1", "plain"


def export_arrays(selected: Selected, out: pathlib.Path, kind: Kind, progress: Progress) -> None:
    """Write contacts as a tree of arrays, whole or not at all.

    Raises:
      ExportError: `out` exists, or the library is not installed.
    """
    with published(out) as temporary:
        root, put, close = _created(temporary, kind)
        try:
            root.attrs[_HEAD] = head_text(selected)
            for number, card in enumerate(selected.cards()):
                group = root.create_group(f"objects/{number:06d}")
                group.attrs[_PLAIN] = card_text(card)
                _put_all(group, put, {name: getattr(card, name) for name in VIEWS})
            rests = root.create_group(RESTS)
            _put_all(rests, put, {n: np.frombuffer(x, np.uint8) for n, x in rest_pictures(selected.store.path).items()})
            for number, contact in selected.contacts(progress):
                for sensor, sequence in contact.items():
                    group = root.create_group(f"contacts/{number:06d}/{sensor}")
                    group.attrs[_PLAIN] = sequence_text(sequence)
                    _put_all(group, put, {name: getattr(sequence, name) for name in FRAME_ARRAYS})
        finally:
            close()


@contextlib.contextmanager
def read_arrays(path: pathlib.Path) -> Iterator[FoundExport]:
    """Open an export that `export_arrays` wrote to `path`; damaged parts raise errors of the libraries.

    Raises:
      ExportError: an export of another version, or the library is not installed.
    """
    with _opened(path) as root:
        head, numbers = head_of(str(root.attrs[_HEAD]), path), sorted(root["contacts"])
        yield FoundExport(
            head=head,
            cards=list(_cards(root)),
            rests={name: root[RESTS][name][...].tobytes() for name in root[RESTS]},
            count=len(numbers),
            contacts=(_contact(root["contacts"][number], head.meta.sensors) for number in numbers),
        )


def _cards(root: Any) -> Iterator[ObjectCard]:
    for name in sorted(root["objects"]):
        group = root["objects"][name]
        yield card_of(str(group.attrs[_PLAIN]), {view: group[view][...] for view in VIEWS if view in group})


def _contact(group: Any, sensors: tuple[str, ...]) -> list[Sequence]:
    found = []
    for sensor in sensors:
        if sensor in group:
            one = group[sensor]
            arrays = {name: np.asarray(one[name][...]) for name in FRAME_ARRAYS if name in one}
            found.append(sequence_of(str(one.attrs[_PLAIN]), arrays))
    return found


def _put_all(group: Any, put: Callable[[Any, str, np.ndarray], object], arrays: dict[str, np.ndarray | None]) -> None:
    for name, array in arrays.items():
        if array is not None:
            put(group, name, np.ascontiguousarray(array))


def _created(path: pathlib.Path, kind: Kind) -> tuple[Any, Callable[[Any, str, np.ndarray], object], Callable[[], Any]]:
    """A new tree, the function that adds an array to a group of it, and the one that closes it."""
    if kind == "zarr":
        zarr = library("zarr", "zarr")
        whole = lambda group, name, x: group.create_array(name, data=x, chunks=x.shape or "auto")
        return zarr.create_group(store=str(path), zarr_format=3), whole, lambda: None
    h5py, file = library("h5py", "hdf5"), KeptFile(path)
    tree = h5py.File(file, "w", libver="latest")  # attributes larger than 64 kB
    squeezed = {"compression": "gzip", "compression_opts": 1, "shuffle": True}

    def add(group: Any, name: str, x: np.ndarray) -> None:
        group.create_dataset(name, data=x, **squeezed if x.ndim else {})
        file.require_written()

    def close() -> None:
        with file:
            tree.close()
            file.require_written()

    return tree, add, close


@contextlib.contextmanager
def _opened(path: pathlib.Path) -> Iterator[Any]:
    """A tree to read."""
    if path.is_dir():
        yield library("zarr", "zarr").open_group(store=str(path), mode="r")
        return
    with library("h5py", "hdf5").File(path, "r") as file:
        yield file
