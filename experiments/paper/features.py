"""What baselines without a policy see of contacts: the fields at the strongest press, or the picture of the object."""

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.core.errors import DataError
from sensors_io.records import RecordStore
from sensors_io.schema import Sequence as Recording

SIDE = 8
"""Cells along a side that fields and pictures are averaged to: about 2 mm each on the widest sensor."""

FINE_PX, COARSE_PX = 1, 4
"""Steps between the pixels whose difference is texture."""

TINY = 1e-3
"""Keeps the logarithm of a flat picture finite; pictures are in 0..1."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Seen:
    """What is known of n contacts: float32 [n, S, D], zero where a stream was not recorded, and which were, [n, S]."""

    x: Float[np.ndarray, "n S D"]
    present: Bool[np.ndarray, "n S"]

    def rows(self, rows: np.ndarray) -> "Seen":
        """Some of the contacts, in the order of `rows`."""
        return Seen(x=self.x[rows], present=self.present[rows])

    def only(self, stream: int) -> "Seen":
        """The same contacts felt by one stream."""
        return Seen(x=self.x[:, [stream]], present=self.present[:, [stream]])

    def strangers(self, objects: np.ndarray, seed: int) -> "Seen":
        """Every contact with what was felt of another object, drawn at random.

        Args:
          objects: [n], the object of each contact.
          seed: of the draw.

        Raises:
          DataError: there is only one object.
        """
        return self.rows(other_objects(objects, seed))


def other_objects(objects: np.ndarray, seed: int) -> Int[np.ndarray, "n"]:
    """For every contact the position of a random contact of another object.

    Args:
      objects: [n], the object of each contact.
      seed: of the draw.

    Raises:
      DataError: there is only one object.
    """
    names, index = np.unique(objects, return_inverse=True)
    if len(names) < 2:
        raise DataError(f"objects holds only {names.tolist()}: another object's touch needs two; use more contacts")
    rng, order = np.random.default_rng(seed), np.argsort(index, kind="stable")
    sizes = np.bincount(index)
    first = np.cumsum(sizes) - sizes
    step = rng.integers(0, len(objects) - sizes[index])  # among the contacts that follow the object's own, around
    return order[(first[index] + sizes[index] + step) % len(objects)]


def field_features(
    store: RecordStore, rows: np.ndarray, sensors: Sequence[str], tell: Callable[[], None] = lambda: None
) -> Seen:
    """Depth and size of the displacement, averaged over 8 × 8 cells, at the strongest press of every stream, in mm.

    A stream without fields counts as not recorded.

    Args:
      store: the records.
      rows: contacts to read.
      sensors: names of the S streams.
      tell: called after every contact.
    """
    x = np.zeros((len(rows), len(sensors), 2 * SIDE**2), np.float32)
    present = np.zeros((len(rows), len(sensors)), bool)
    for n, row in enumerate(rows):
        recorded = store.contact(int(row), fields=True)
        for s, sensor in enumerate(sensors):
            if sensor in recorded and _fields(recorded[sensor]):
                x[n, s], present[n, s] = _pressed(recorded[sensor]), True
        tell()
    return Seen(x=x, present=present)


def picture_features(store: RecordStore, rows: np.ndarray) -> Seen:
    """Colours over 8 × 8 cells and the texture of each object's picture, as one stream; absent where there is none.

    Args:
      store: the records.
      rows: contacts whose objects are looked at.
    """
    views = [store.objects[store.contacts[int(row)].object_id].view for row in rows]
    width = 3 * SIDE**2 + 2 * 3
    x = np.stack([np.zeros(width, np.float32) if view is None else _looks(view) for view in views])
    return Seen(x=x[:, None], present=np.array([[view is not None] for view in views]))


def _fields(recording: Recording) -> bool:
    return recording.depth_mm is not None or recording.deformation_mm is not None


def _pressed(recording: Recording) -> Float[np.ndarray, "D"]:
    """The fields of the frame of the greatest force, of the last one where no force was measured."""
    t = -1 if recording.force_n is None else int(np.argmin(recording.force_n[:, 2]))
    depth, moved = recording.depth_mm, recording.deformation_mm
    parts = [
        np.zeros(SIDE**2, np.float32) if depth is None else _cells(depth[t]),
        np.zeros(SIDE**2, np.float32) if moved is None else _cells(np.linalg.norm(moved[t], axis=-1)),
    ]
    return np.concatenate(parts)


def _looks(view: np.ndarray) -> Float[np.ndarray, "D"]:
    picture = view.astype(np.float32) / 255
    texture = [np.log(np.abs(picture[step:] - picture[:-step]).mean((0, 1)) + TINY) for step in (FINE_PX, COARSE_PX)]
    return np.concatenate([_cells(picture), *texture]).astype(np.float32)


def _cells(image: np.ndarray) -> Float[np.ndarray, "D"]:
    """Means over the cells of an image [H, W] or [H, W, C], flat."""
    return cv2.resize(image.astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_AREA).ravel()
