"""Pattern of a gel at rest that allows lateral motion to be measured: printed dots, a dense texture, or neither.

On a bare gel every tracker returns a plausible field, which is wrong by the motion itself: shading moves with the
contact, not with the gel.  So a field is refused where the picture at rest cannot carry it.
"""

import dataclasses
import enum

import cv2
import numpy as np

from sensors_io.fields.markers import Markers, find_markers
from sensors_io.schema import SchemaError

LEAST_CONTRAST = 20.0
"""Grey levels.  Bare gels under a load reach 15 (their shading), at rest 3; the faintest dots have 34."""

MOST_SCATTER = 0.4
"""Of the distances to the nearest neighbour: lattices and printed dots have up to 0.2, chance 0.4 to 1."""

LEAST_SPREAD = 0.6
"""Share of the 4 × 4 cells of the picture that hold a dot: a contact's shading covers few."""

LEAST_COUNT = 12
"""Dots; with fewer no deformation field is drawn through them."""

LEAST_ROOM = 3.5
"""Pitch over radius: printed dots stand 4 to 7 radii apart, the grains of a dense pattern touch, 2 to 3."""

LEAST_TEXTURE = 1.0
"""Grey levels per pixel.  Bare gels have 0.06 to 0.3, which is camera noise and coating; printed patterns 3 or more."""

_TEXTURE_WINDOW_PX = 21
_TEXTURED_SHARE = 0.9  # of the windows, which must have the texture
_FINE_PX, _COARSE_PX = 1.0, 6.0  # band of the pattern: between noise and shading


class Pattern(enum.Enum):
    """Kinds of pattern in a gel."""

    BARE = "bare"
    MARKERS = "markers"
    DENSE = "dense"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evidence:
    """Pattern found in a gel at rest, its dots if there are any, and its texture in grey levels per pixel.

    `reason` says why a bare gel is taken for bare, empty otherwise.
    """

    pattern: Pattern
    markers: Markers | None
    texture: float
    reason: str


def examine(grey: np.ndarray) -> Evidence:
    """Judge a gel at rest.

    Args:
      grey: uint8 or float32 [H, W].

    Raises:
      SchemaError: a picture too small to hold one window of texture.
    """
    if min(grey.shape) < _TEXTURE_WINDOW_PX:
        raise SchemaError(
            f"the gel at rest is {grey.shape[0]} × {grey.shape[1]} px: must be ≥ {_TEXTURE_WINDOW_PX} px along either "
            "side, to show whether it carries a pattern; take a larger picture"
        )
    texture, markers = texture_of(grey), find_markers(grey)
    missing = _missing(markers)
    if not missing:
        return Evidence(pattern=Pattern.MARKERS, markers=markers, texture=texture, reason="")
    if texture >= LEAST_TEXTURE:
        return Evidence(pattern=Pattern.DENSE, markers=None, texture=texture, reason="")
    reason = f"{missing}; texture is {texture:.2f} grey levels/px, must be ≥ {LEAST_TEXTURE}"
    return Evidence(pattern=Pattern.BARE, markers=None, texture=texture, reason=reason)


def texture_of(grey: np.ndarray) -> float:
    """Gradient across the weakest direction, root mean square over a window, that 9 windows in 10 reach.

        √(λ_min / n),  λ_min of Σ ∇I ∇Iᵀ over a window of n pixels, I band-passed

    The error of a translation read from the window is at least σ / √λ_min for pixel noise σ.

    Args:
      grey: uint8 or float32 [H, W].

    Returns:
      Grey levels per pixel.

    Source: Shi & Tomasi, CVPR 1994.
    """
    image = grey.astype(np.float32)
    band = cv2.GaussianBlur(image, (0, 0), _FINE_PX) - cv2.GaussianBlur(image, (0, 0), _COARSE_PX)
    along_x, along_y = (cv2.Sobel(band, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    side = (_TEXTURE_WINDOW_PX, _TEXTURE_WINDOW_PX)
    xx, yy, xy = (cv2.boxFilter(product, -1, side) for product in (along_x**2, along_y**2, along_x * along_y))
    weakest = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    half = _TEXTURE_WINDOW_PX // 2
    return float(np.sqrt(max(np.quantile(weakest[half:-half, half:-half], 1 - _TEXTURED_SHARE), 0)))


def _missing(markers: Markers | None) -> str:
    """Reason why candidates are no printed dots; empty if they may be."""
    if markers is None:
        return "no dots"
    room = markers.pitch_px / markers.radius_px
    limits = (
        (len(markers) < LEAST_COUNT, f"{len(markers)} dots, must be ≥ {LEAST_COUNT}"),
        (markers.contrast < LEAST_CONTRAST, f"contrast {markers.contrast:.1f}, must be ≥ {LEAST_CONTRAST}"),
        (markers.scatter > MOST_SCATTER, f"scatter {markers.scatter:.2f}, must be ≤ {MOST_SCATTER}"),
        (room < LEAST_ROOM, f"pitch {room:.1f} radii, must be ≥ {LEAST_ROOM}"),
        (markers.spread < LEAST_SPREAD, f"spread {markers.spread:.2f}, must be ≥ {LEAST_SPREAD}"),
    )
    return "; ".join(text for failed, text in limits if failed)
