"""Picture to depth: slopes, integration, zero level, contact mask."""

import dataclasses
import functools

import cv2
import numpy as np

from sensors_io.fields.contact import STEEP, ContactConfig, ContactRegions, find_contacts
from sensors_io.fields.poisson import neumann
from sensors_io.fields.slopes import SlopeReader
from sensors_io.fields.types import Calibration

CELL_PX = 8
"""Side of the cells on which the zero level is fitted: it bends over the whole picture."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ZeroConfig:
    """Settings for the zero of depth, from untouched gel.

    Args:
      steep: slope beyond which a cell belongs to a contact or its rim.
      margin_mm: around such cells, nothing is taken for untouched: the gel sinks there too.
      near_mm, sinks_mm: distance from such cells from which on the zero level is fitted, with a sinking that decays
        by 1/e over `sinks_mm`; around presses at known depth it is some 60 µm at 2 mm.
      bent, tilted: least share of untouched cells, for which a quadratic and a plane are fitted; below it a constant,
        and no zero level is known.
    """

    steep: float = STEEP
    margin_mm: float = 3.0
    near_mm: float = 2.0
    sinks_mm: float = 2.5
    bent: float = 0.4
    tilted: float = 0.15

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not value >= 0 or (name == "sinks_mm" and value == 0):
                raise ValueError(f"{name} is {value}: must be ≥ 0, and sinks_mm above it; raise it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Surface:
    """The gel's surface in one picture.

    Args:
      depth_mm: indentation, float32 [H, W].
      contacts: where it is touched.
      untouched: share of the cells that the zero level was fitted to.
      zero_known: whether they are enough for a plane; else depth is good up to a constant, a tilt and a bend.
    """

    depth_mm: np.ndarray
    contacts: ContactRegions
    untouched: float
    zero_known: bool


class DepthReader:
    """Reads the depth of one sensor's pictures.

    Args:
      calibration: of that sensor.
      zero, contact: settings.
    """

    def __init__(
        self, calibration: Calibration, *, zero: ZeroConfig | None = None, contact: ContactConfig | None = None
    ):
        self.calibration = calibration
        self._slopes = SlopeReader(calibration.colours, calibration.background)
        self._zero = zero or ZeroConfig()
        self._contact = contact or ContactConfig()

    def __call__(self, picture: np.ndarray) -> tuple[np.ndarray, ContactRegions]:
        """Indentation, float32 [H, W] mm, and its contacts, of one picture, uint8 [H, W, 3] RGB."""
        surface = self.read(picture)
        return surface.depth_mm, surface.contacts

    def read(self, picture: np.ndarray) -> Surface:
        """The surface of one picture, uint8 [H, W, 3] RGB."""
        down_x, down_y = self._slopes(picture)
        pitch, slope = self.calibration.mm_per_px, np.hypot(down_x, down_y)
        depth = neumann(down_x, down_y, pitch)
        depth -= zero_level(depth, slope, pitch, self._zero)
        share = float(untouched_cells(slope, pitch, self._zero).mean())
        return Surface(
            depth_mm=depth,
            contacts=find_contacts(depth, pitch, self._contact),
            untouched=share,
            zero_known=share >= self._zero.tilted,
        )


def untouched_cells(slope: np.ndarray, mm_per_px: float, config: ZeroConfig) -> np.ndarray:
    """Cells of `CELL_PX` that no steep cell is near, bool [H // CELL_PX, W // CELL_PX].

    Args:
      slope: float32 [H, W], the length of the slopes.
      mm_per_px: pitch.
      config: what is steep, and how far its surroundings reach.
    """
    steep = cv2.resize(slope, _cells(slope), interpolation=cv2.INTER_AREA) > config.steep
    side = 2 * round(config.margin_mm / (mm_per_px * CELL_PX)) + 1
    reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    still: np.ndarray = cv2.dilate(steep.astype(np.uint8), reach) == 0
    return still


def _cells(field: np.ndarray) -> tuple[int, int]:
    """Columns and rows of cells."""
    return max(1, field.shape[1] // CELL_PX), max(1, field.shape[0] // CELL_PX)


def zero_level(depth_mm: np.ndarray, slope: np.ndarray, mm_per_px: float, config: ZeroConfig) -> np.ndarray:
    """Depth that untouched gel shows, continued under the contact: a quadratic, a plane or a constant by least squares.

    A lamp that warms up, or a gel that settles, tilts and bends the zero level by tens of micrometres.  Around contacts
    gel sinks too, by A exp(−d / `sinks_mm`) at the distance d, A ≥ 0: it is fitted with the level and is no part of it.

    Args:
      depth_mm, slope: float32 [H, W] each; the length of the slopes.
      mm_per_px: pitch.
      config: what counts as untouched, and how much of it is needed.

    Returns:
      float32 [H, W].  Where nothing is untouched, the constant is that of the shallowest twentieth of the cells.
    """
    columns, rows = _cells(depth_mm)
    coarse = cv2.resize(depth_mm, (columns, rows), interpolation=cv2.INTER_AREA)
    still = untouched_cells(slope, mm_per_px, config)
    share = float(still.mean())
    degree = 2 if share >= config.bent else 1 if share >= config.tilted else 0
    if not still.any():
        still = coarse <= np.quantile(coarse, 0.05)
    terms = _powers(rows, columns, degree)
    low = None
    if degree:
        away_mm = _distance_mm(slope, mm_per_px, config)
        near = away_mm > config.near_mm
        sinking = np.exp(-away_mm / np.float32(config.sinks_mm))
        both = np.column_stack([terms, sinking.ravel()])
        fitted = np.linalg.lstsq(both[near.ravel()], coarse[near], rcond=None)[0]
        low = fitted[:-1] if fitted[-1] > 0 else None  # gel that rises next to a contact is a fault of the slopes
    if low is None:
        low = np.linalg.lstsq(terms[still.ravel()], coarse[still], rcond=None)[0]
    return (_powers(*depth_mm.shape, degree) @ low.astype(np.float32)).reshape(depth_mm.shape)


def _distance_mm(slope: np.ndarray, mm_per_px: float, config: ZeroConfig) -> np.ndarray:
    """Distance of every cell from the nearest steep one, float32 [H // CELL_PX, W // CELL_PX]."""
    steep = cv2.resize(slope, _cells(slope), interpolation=cv2.INTER_AREA) > config.steep
    if not steep.any():
        return np.full(steep.shape, np.inf, np.float32)
    away: np.ndarray = cv2.distanceTransform((~steep).astype(np.uint8), cv2.DIST_L2, 5)
    return away * np.float32(mm_per_px * CELL_PX)


@functools.lru_cache(maxsize=16)
def _powers(height: int, width: int, degree: int) -> np.ndarray:
    """Monomials of x and y in −1 … 1 up to a degree, float32 [H·W, terms]."""
    x, y = np.meshgrid(*((np.arange(n, dtype=np.float32) + 0.5) / n * 2 - 1 for n in (width, height)))
    terms = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack([t.ravel() for t in terms], -1)
