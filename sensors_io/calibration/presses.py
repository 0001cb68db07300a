"""Pictures of one rigid ball pressed into a gel, and what a press looks like: its touch and its indentation."""

import dataclasses
import hashlib

import cv2
import numpy as np

from sensors_io.fields.types import CalibrationError

MOST_SIDES = 3
"""Radius of a ball in longer sides of the pictures; the contact of a larger one hardly fits into them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BallPresses:
    """Pictures of presses and of the gel at rest.

    Args:
      pictures: uint8 [P, H, W, 3], RGB, one press each.
      background: uint8 [H, W, 3].
      radius_mm: of the ball.
      mm_per_px: pitch of the pixels.

    Raises:
      CalibrationError: arrays of another type or shape, a pitch that is not positive, a ball smaller than a pixel or
        far larger than the pictures.
    """

    pictures: np.ndarray
    background: np.ndarray
    radius_mm: float
    mm_per_px: float

    def __post_init__(self) -> None:
        for name, array, rank in (("pictures", self.pictures, 4), ("background", self.background, 3)):
            if array.dtype != np.uint8 or array.ndim != rank or array.shape[-1] != 3:
                got = f"{array.dtype}{list(array.shape)}"
                raise CalibrationError(f"{name} is {got}: must be uint8 RGB of rank {rank}; convert it")
        if self.pictures.shape[1:] != self.background.shape:
            sizes = f"{self.pictures.shape[1:3]} and {self.background.shape[:2]}"
            raise CalibrationError(f"presses and background have sizes {sizes}: must be equal; record both alike")
        for name in ("radius_mm", "mm_per_px"):
            if not getattr(self, name) > 0:
                raise CalibrationError(f"{name} is {getattr(self, name)}: must be > 0; measure it")
        most_mm = MOST_SIDES * max(self.shape) * self.mm_per_px
        if not self.mm_per_px <= self.radius_mm <= most_mm:
            raise CalibrationError(
                f"ball diameter is {2 * self.radius_mm:g} mm: must lie in [{2 * self.mm_per_px:g}, {2 * most_mm:g}] mm "
                f"for pictures of {self.shape[1]} × {self.shape[0]} px at {self.mm_per_px:g} mm/px; give it in mm"
            )

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.background.shape[0], self.background.shape[1]

    def hashes(self) -> list[bytes]:
        """Of the pixels of each press."""
        return [hashlib.sha256(np.ascontiguousarray(picture).tobytes()).digest() for picture in self.pictures]

    def canonical_order(self) -> np.ndarray:
        """Indices that sort the presses by the hash of their pixels: the same presses in any order come out alike."""
        return np.array(sorted(range(len(self)), key=self.hashes().__getitem__), np.int64)

    def chosen(self, index: np.ndarray) -> "BallPresses":
        """Some of the presses."""
        return dataclasses.replace(self, pictures=self.pictures[index])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Touches:
    """Centres and contact radii of P presses in pixels, float64 [P] each; x is the column."""

    x_px: np.ndarray
    y_px: np.ndarray
    radius_px: np.ndarray

    def __len__(self) -> int:
        return len(self.x_px)

    def stacked(self) -> np.ndarray:
        """(x, y, radius), float64 [P, 3]."""
        return np.stack([self.x_px, self.y_px, self.radius_px], -1)

    @classmethod
    def of(cls, rows: np.ndarray) -> "Touches":
        """From (x, y, radius), [P, 3]."""
        return cls(x_px=rows[:, 0], y_px=rows[:, 1], radius_px=rows[:, 2])


def indentation(dx_mm: np.ndarray, dy_mm: np.ndarray, contact_mm: float, radius_mm: float) -> np.ndarray:
    """Depth and slopes of an elastic half-space under a rigid ball, at distances dx, dy from its axis.

        r ≤ a:  ∂u/∂r = −r / √(R² − r²),   u = u_a + √(R² − r²) − √(R² − a²)
        r > a:  ∂u/∂r = (2s/πR) (a √(1 − a²/r²) − r asin(a/r)),   u = (s/πR) ((2a² − r²) asin(a/r) + a √(r² − a²))

    Args:
      dx_mm, dy_mm: of one shape.
      contact_mm: contact radius a, < R.
      radius_mm: of the ball, R.

    Returns:
      u, ∂u/∂x, ∂u/∂y, [3, …]; mm and mm/mm.

    Source: Hertz 1882, Johnson, Contact Mechanics, eq. 3.42a.  Departure: Hertz's ball is a paraboloid; the outer part
    carries s = R / √(R² − a²), so that the slope goes on at the edge of a true sphere.
    """
    square = dx_mm**2 + dy_mm**2
    r = np.sqrt(np.maximum(square, 1e-12))
    edge = np.sqrt(radius_mm**2 - contact_mm**2)
    share = radius_mm / edge
    height = np.sqrt(radius_mm**2 - np.minimum(r, contact_mm) ** 2)
    outer = np.maximum(r, contact_mm)
    arc, root = np.arcsin(contact_mm / outer), np.sqrt(np.maximum(outer**2 - contact_mm**2, 0))
    depth_out = share / (np.pi * radius_mm) * ((2 * contact_mm**2 - outer**2) * arc + contact_mm * root)
    slope_out = 2 * share / (np.pi * radius_mm) * (contact_mm * root / outer - outer * arc)
    inside = r <= contact_mm
    per_mm = np.where(inside, -1 / height, slope_out / r)
    depth = np.where(inside, depth_out + height - edge, depth_out)
    return np.stack([depth, per_mm * dx_mm, per_mm * dy_mm])


def shrink(picture: np.ndarray, factor: int) -> np.ndarray:
    """Means over blocks of factor² pixels, float32 [H // factor, W // factor, 3]; what is left over is left out."""
    height, width = (s // factor for s in picture.shape[:2])
    whole = picture[: height * factor, : width * factor]
    return cv2.resize(whole.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
