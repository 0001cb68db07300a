"""Recordings of a Tac3D as its SDK (PyTac3D 3) keeps them: fields of a 20 × 20 grid and the resultant force.

    DIR/<name>_<serial>.npz     per frame: 3D_Positions, 3D_Displacements [N, 400, 3] mm, 3D_ResultantForce [N, 1, 3] N,
                                3D_ResultantMoment [N, 1, 3] N mm, index, sendTimestamp, recvTimestamp (some), seconds

The vendor's frame has z out of the gel, and the points run from +x, +y to −x, −y: reversing both axes of the grid
gives image order, x right and y down, without touching a vector.  Pressing is u_z < 0 and Fz < 0 there as here, so that

    deformation_mm = (u_x, u_y),   depth_mm = −u_z,   force_n = F.

All of them are the vendor's estimates.  Moments are about the vendor's origin, on the axis of the sensor; its height
against the window's centre is not published, and they are kept as they are.  The force per point has no place in a
record and is left out.  A frame before which the counter `index` skips some or begins anew, or whose time runs back, is
flagged `TIME_GAP`; in the latter case it has the latest time before it.
`host_time_ns` is the client's receive time where it was stored, the sensor's send time elsewhere.
"""

import functools
import pathlib

import numpy as np

from sensors_io.arrays import ArraysError, load_arrays
from sensors_io.codec import LARGEST
from sensors_io.importers.catalogue import Catalogue, Listed, Taken, bare_catalogue, plain_names, require_files
from sensors_io.importers.keep import Shares, Skip, UnreadableError
from sensors_io.importers.pictures import film, whole
from sensors_io.schema import ContactKey

SENSOR = "tac3d"
SIDE = 20
"""Points along each side of the grid."""

_SHAPES = {
    "3D_Positions": (SIDE * SIDE, 3),
    "3D_Displacements": (SIDE * SIDE, 3),
    "3D_ResultantForce": (1, 3),
    "3D_ResultantMoment": (1, 3),
    "index": (),
    "sendTimestamp": (),
}

_LARGEST = {
    "3D_Displacements": LARGEST["depth_mm"],
    "3D_ResultantForce": LARGEST["force_n"],
    "3D_ResultantMoment": LARGEST["moment_nmm"],
}
_NO_VALUES = "holds values that are not finite, or that no sensor measures"


class RecordingError(UnreadableError):
    """A recording that is damaged or of another layout."""


def list_tac3d(source: pathlib.Path, config: Shares) -> Catalogue:
    """Catalogue of a directory of whole recordings; the object is not stored, so each recording counts as one object.

    Raises:
      ImportSourceError: no .npz there.
    """
    files = sorted(path for path in source.glob("[!.]*") if path.suffix.lower() == ".npz")
    require_files(source, files, "<name>_<serial>.npz with the arrays of a PyTac3D recording")
    contacts, names = [], plain_names((path.stem for path in files), SENSOR)
    for path in files:
        key = ContactKey(object_id=names[path.stem], site=0, motion="free", trial=0)
        contacts.append(Listed(key=key, name=path.name, read=functools.partial(_read, path, key)))
    return bare_catalogue(
        source,
        contacts,
        files,
        config,
        source="Tac3D recordings",
        licence="not stated by the vendor; local use only",
        sensors=(SENSOR,),
    )


def _read(path: pathlib.Path, key: ContactKey) -> Taken:
    arrays = _load(path)
    good = [np.abs(array) <= _LARGEST.get(name, np.finfo(float).max) for name, array in arrays.items()]
    kept = np.all([array.reshape(len(array), -1).all(1) for array in good], axis=0)
    lost = [Skip(name=f"{path.name}, frame {n}", reason=_NO_VALUES) for n in np.flatnonzero(~kept)]
    if not kept.any():
        raise RecordingError(f"every frame {_NO_VALUES}")
    arrays = {name: array[kept] for name, array in arrays.items()}
    index = whole(arrays["index"], "index")
    steps = np.diff(index, prepend=index[0] - 1)
    sent_ns = _ns(arrays["sendTimestamp"])
    host_ns = _ns(arrays["recvTimestamp"]) if "recvTimestamp" in arrays else sent_ns
    back = host_ns < np.maximum.accumulate(host_ns)
    if 2 * back.sum() > len(back):
        raise RecordingError("has times that run backwards")
    moved = _grid(arrays["3D_Displacements"]).astype(np.float32)
    clock = "receive time" if "recvTimestamp" in arrays else "send time"
    sequence = film(
        key,
        SENSOR,
        gap=(steps > 1) | (steps < 0) | back,
        host_time_ns=np.maximum.accumulate(host_ns),
        device_time_ns=sent_ns,
        force_time_ns=sent_ns,
        serial=path.stem.rpartition("_")[2],
        camera={"file": path.name, "clock": clock, "missing_frames": int(np.maximum(steps - 1, 0).sum())},
        deformation_mm=np.ascontiguousarray(moved[..., :2]),
        depth_mm=-moved[..., 2],
        force_n=arrays["3D_ResultantForce"][:, 0].astype(np.float32),
        moment_nmm=arrays["3D_ResultantMoment"][:, 0].astype(np.float32),
    )
    return Taken(sequences=(sequence,), left_out=tuple(lost))


def _load(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Arrays of one recording, their shapes and the order of the grid checked."""
    try:
        data = load_arrays(path)
    except ArraysError as error:
        raise RecordingError(f"is damaged ({error})") from error
    arrays = {name: data[name] for name in (*_SHAPES, "recvTimestamp") if name in data}
    missing = [name for name in _SHAPES if name not in arrays]
    if missing:
        raise RecordingError(f"lacks {', '.join(missing)}")
    if arrays["index"].ndim != 1:
        raise RecordingError(f"index has shape {arrays['index'].shape}: must be (N,)")
    count = len(arrays["index"])
    for name, array in arrays.items():
        shape = _SHAPES.get(name, ())
        if array.dtype.kind not in "fiu":
            raise RecordingError(f"{name} holds {array.dtype}: must hold numbers")
        if array.shape != (count, *shape):
            raise RecordingError(f"{name} has shape {array.shape}: must be {(count, *shape)}")
    if not count:
        raise RecordingError("holds no frame")
    rest = _grid(arrays["3D_Positions"] - arrays["3D_Displacements"])[0]
    if np.diff(rest[..., 0].mean(0)).min() <= 0 or np.diff(rest[..., 1].mean(1)).min() <= 0:
        raise RecordingError("has points in another order than from +x, +y to −x, −y")
    return arrays


def _grid(points: np.ndarray) -> np.ndarray:
    """Points [N, 400, 3] as a grid in image order [N, 20, 20, 3]."""
    return points.reshape(-1, SIDE, SIDE, 3)[:, ::-1, ::-1]


def _ns(seconds: np.ndarray) -> np.ndarray:
    return whole(seconds.astype(np.float64) * 1e9, "times in ns")
