"""Measurements of one sensor's recording of a contact: numbers with units, their place, their part of the window.

    force                N      press force −Fz of the frame that is read, about 1.5 N
    indentation          mm     depth that 1 % of the readable nodes exceed
    stiffness            N/mm   slope of force over indentation up to 3 N, by least squares
    contact area         %      share of the window in contact
    spread               %/N    growth of the contact area with force up to 3 N: what yields spreads
    marker displacement  mm     length that 1 % of the displacements exceed
    relief               mm     rms of the depth between 1 and 4 nodes, in contact
    fine texture         grey   rms of the change of the picture between 1 and 3 pixels, in contact
    coarse texture       grey   the same between 3 and 12 pixels

They are read from the trusted frame, one without flags, whose force is nearest to 1.5 N: the greatest trusted force
would itself tell what is soft, since soft and pointed objects strain a gel past its limit first.  Where no force was
measured it is the frame of the greatest change.  A quantity that the recording cannot carry is left out.

All of it is the gel's: under a soft object the contact spreads, so that the gel is indented less and its stiffness
comes out greater.  Lengths in nodes and pixels are the sensor's own: these numbers compare touches by one sensor, never
sensors.
"""

import dataclasses
from collections.abc import Mapping

import cv2
import numpy as np

from sensors_io.schema import Sequence

UNITS: Mapping[str, str] = {
    "force": "N",
    "indentation": "mm",
    "stiffness": "N/mm",
    "contact area": "%",
    "spread": "%/N",
    "marker displacement": "mm",
    "relief": "mm",
    "fine texture": "grey levels",
    "coarse texture": "grey levels",
}
"""Every quantity and its unit."""

REFERENCE_N, SLOPE_N = 1.5, 3.0
"""Press force that is read at, and up to which slopes are taken: nearly every gel and object bear it."""

CONTACT_SHARE = 0.25
"""Of the greatest depth or change; what exceeds it is in contact."""

LEAST_DEPTH_MM, LEAST_CHANGE = 0.06, 2.0
"""Below these no contact is seen: twice the depth noise of the noisiest field, and camera noise in grey levels after
the blur by `_SMOOTH_PX`."""

_TOP = 99.0  # percentile that stands for a maximum: one noisy node does not make it
_SMOOTH_PX = 2.0  # blur of the change before the contact is looked for in it
_RELIEF_NODES, _FINE_PX, _COARSE_PX = (1.0, 4.0), (1.0, 3.0), (3.0, 12.0)

Box = tuple[float, float, float, float]
"""(left, top, right, bottom) as shares of the window, x right, y down."""


class MeasureError(ValueError):
    """A recording that measures nothing; the message says why."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measured:
    """The numbers of one recording.

    Args:
      frame: the frame that was read.
      quantities: name, one of `UNITS`, to value.
      at: (x, y) of the deepest point, or of the greatest change, as shares of the window.
      box: of the contact around it.
    """

    frame: int
    quantities: Mapping[str, float]
    at: tuple[float, float]
    box: Box

    @property
    def units(self) -> Mapping[str, str]:
        """Every quantity and its unit."""
        return UNITS


def measure(sequence: Sequence) -> Measured:
    """Measure a recording.

    Raises:
      MeasureError: no trusted frame, or no contact in the one that is read.
    """
    trusted = np.flatnonzero(sequence.flags == 0)
    if not len(trusted):
        raise MeasureError("no frame without flags")
    force = None if sequence.force_n is None else -sequence.force_n[:, 2].astype(float)
    change = _changes(sequence, trusted)
    fit = change.reshape(len(trusted), -1).max(1) if force is None else -np.abs(force[trusted] - REFERENCE_N)
    best = int(np.argmax(fit))
    contact = _in_contact(change[best], sequence)
    if not contact.any():
        raise MeasureError("no contact is seen")
    peak = np.unravel_index(np.argmax(np.where(contact, change[best], -np.inf)), contact.shape)
    return Measured(
        frame=int(trusted[best]),
        quantities=_quantities(sequence, trusted, best, force, change),
        at=((float(peak[1]) + 0.5) / contact.shape[1], (float(peak[0]) + 0.5) / contact.shape[0]),
        box=_box(contact),
    )


def band_rms(picture: np.ndarray, fine: float, coarse: float, where: np.ndarray) -> float:
    """Root mean square of G_fine ∗ I − G_coarse ∗ I over a region.

    Args:
      picture: float32 [H, W].
      fine, coarse: standard deviations of the two Gaussians, pixels.
      where: bool [H, W], not empty.
    """
    band = cv2.GaussianBlur(picture, (0, 0), fine) - cv2.GaussianBlur(picture, (0, 0), coarse)
    return float(np.sqrt(np.mean(band[where] ** 2)))


def slope(x: np.ndarray, y: np.ndarray) -> float | None:
    """Slope of y over x by least squares; `None` where fewer than two x differ, by a hundredth of the largest.

    Args:
      x, y: float [n].
    """
    if len(x) < 2 or np.ptp(x) <= 0.01 * np.max(np.abs(x)):
        return None
    centred = x - x.mean()
    return float(centred @ (y - y.mean()) / (centred @ centred))


def _changes(sequence: Sequence, trusted: np.ndarray) -> np.ndarray:
    """Contact of the gel in the valid frames [n, h, w]: depth in mm, else the blurred change of
    the picture since the first frame in grey levels.
    """
    if sequence.depth_mm is not None:
        return np.where(_readable(sequence)[trusted], sequence.depth_mm[trusted], 0.0)
    if sequence.frames is None:
        raise MeasureError("neither depth nor pictures")
    first = _grey(sequence.frames[0])
    grey = [np.abs(_grey(sequence.frames[n]) - first) for n in trusted]
    return np.stack([cv2.GaussianBlur(g, (0, 0), _SMOOTH_PX) for g in grey])


def _in_contact(change: np.ndarray, sequence: Sequence) -> np.ndarray:
    """Nodes or pixels in contact, bool [h, w]."""
    least = LEAST_CHANGE if sequence.depth_mm is None else LEAST_DEPTH_MM
    found: np.ndarray = change >= max(least, CONTACT_SHARE * float(np.percentile(change, _TOP)))
    return found


def _quantities(
    sequence: Sequence, trusted: np.ndarray, best: int, force: np.ndarray | None, change: np.ndarray
) -> dict[str, float]:
    """Quantities that the recording can provide, in the order of `UNITS`."""
    frame, found = int(trusted[best]), dict[str, float | None]()
    masks = [_in_contact(c, sequence) for c in change]
    area = np.array([100.0 * mask.mean() for mask in masks])
    found["contact area"] = float(area[best])
    if force is not None:
        pressed = force[trusted]
        light = pressed <= SLOPE_N
        found["force"] = float(force[frame])
        found["spread"] = slope(pressed[light], area[light])
    if sequence.depth_mm is not None:
        top = np.array([np.percentile(c, _TOP) for c in change])
        found["indentation"] = float(top[best])
        found["relief"] = band_rms(change[best].astype(np.float32), *_RELIEF_NODES, masks[best])
        found["stiffness"] = None if force is None else slope(top[light], pressed[light])
    if sequence.deformation_mm is not None:
        length = np.hypot(*np.moveaxis(sequence.deformation_mm[frame], -1, 0))
        found["marker displacement"] = float(np.percentile(length[_readable(sequence)[frame]], _TOP))
    if sequence.frames is not None:
        found |= _textures(sequence, frame, masks[best])
    return {name: value for name in UNITS if (value := found.get(name)) is not None}


def _textures(sequence: Sequence, frame: int, contact: np.ndarray) -> dict[str, float]:
    """Energies of the picture's change where the contact is."""
    assert sequence.frames is not None
    change = _grey(sequence.frames[frame]) - _grey(sequence.frames[0])
    size = change.shape[1], change.shape[0]
    where = cv2.resize(contact.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return {
        "fine texture": band_rms(change, *_FINE_PX, where),
        "coarse texture": band_rms(change, *_COARSE_PX, where),
    }


def _readable(sequence: Sequence) -> np.ndarray:
    """Mask of the nodes of the fields that are valid, bool [N, h, w]."""
    if sequence.valid is not None:
        return sequence.valid
    field = sequence.depth_mm if sequence.depth_mm is not None else sequence.deformation_mm
    assert field is not None
    return np.ones(field.shape[:3], bool)


def _grey(picture: np.ndarray) -> np.ndarray:
    return picture.mean(-1, dtype=np.float32)


def _box(contact: np.ndarray) -> Box:
    """Bounding box of a mask that is not empty."""
    rows, columns = np.flatnonzero(contact.any(1)), np.flatnonzero(contact.any(0))
    height, width = contact.shape
    return (
        float(columns[0] / width),
        float(rows[0] / height),
        float((columns[-1] + 1) / width),
        float((rows[-1] + 1) / height),
    )
