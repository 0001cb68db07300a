"""Detection of contact, and the region of the gel in contact."""

import dataclasses

import cv2
import numpy as np

from sensors_io.schema import SchemaError

EDGE_SHARE = 0.5
"""Of a contact's greatest depth: that at the edge of a ball's contact on a half-space (Hertz), whatever its size."""


STEEP = 0.08
"""Slope that untouched gel stays below: a contact reaches it at its rim, a zero level that drifts nowhere."""

RIM_CELL_PX = 4
"""Side of the cells whose slope is judged: noise makes single pixels steep anywhere."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactConfig:
    """Hysteresis of the contact mask, and what change of the picture makes a contact.

    Args:
      low_mm, high_mm: an indented region deeper than `low_mm` counts if it reaches `high_mm` somewhere.
      least_mm2: smaller regions are specks.
      rim: slope that the depth of a contact reaches somewhere.
      steepness: grey levels per millimetre that the smoothed change must reach somewhere for a contact.
      smoothing_mm: standard deviation of that smoothing.
    """

    low_mm: float = 0.03
    high_mm: float = 0.06
    least_mm2: float = 0.05
    rim: float = STEEP
    steepness: float = 10.0
    smoothing_mm: float = 0.3

    def __post_init__(self) -> None:
        if not 0 < self.low_mm <= self.high_mm:
            raise ValueError(f"low_mm is {self.low_mm}, high_mm {self.high_mm}: must be 0 < low ≤ high; lower low_mm")
        for name in ("least_mm2", "rim", "steepness", "smoothing_mm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}: must be > 0; raise it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactRegions:
    """The mask bool [H, W], the number of its separate contacts, whether one meets the border of the picture."""

    mask: np.ndarray
    count: int
    at_border: bool


def find_contacts(depth_mm: np.ndarray, mm_per_px: float, config: ContactConfig | None = None) -> ContactRegions:
    """Contact by hysteresis: in each connected region deeper than `low_mm` that reaches `high_mm` and slopes by `rim`,

        the pixels with u ≥ max(low_mm, ½ max u)

    A ball of radius R that sinks in by u slopes by √(u/R) at its rim (Hertz), over a cell by somewhat less: one of
    10 mm is seen from 0.1 mm or so.  A flat face slopes at its edges, and is missed where the picture shows none.

    Args:
      depth_mm: float32 [H, W], 0 where nothing touches.
      mm_per_px: pitch.
      config: thresholds.
    """
    config = config or ContactConfig()
    count, labels, stats, _ = cv2.connectedComponentsWithStats((depth_mm > config.low_mm).astype(np.uint8))
    steep = _slope(depth_mm, mm_per_px) >= config.rim
    mask, kept, border = np.zeros(depth_mm.shape, bool), 0, False
    for label in range(1, count):
        x, y, w, h, area = stats[label]
        if area * mm_per_px**2 < config.least_mm2:
            continue
        box = np.s_[y : y + h, x : x + w]
        inside = labels[box] == label
        peak = float(depth_mm[box][inside].max())
        if peak < config.high_mm or not steep[box][inside].any():
            continue
        touched = inside & (depth_mm[box] >= EDGE_SHARE * peak)
        mask[box] |= touched
        kept += 1
        border |= _meets_border(touched, (x, y), depth_mm.shape)
    return ContactRegions(mask=mask, count=kept, at_border=border)


def _slope(depth_mm: np.ndarray, mm_per_px: float) -> np.ndarray:
    """Length of the gradient of the depth, averaged over cells of `RIM_CELL_PX`, float32 [H, W]."""
    height, width = depth_mm.shape
    size = (max(2, width // RIM_CELL_PX), max(2, height // RIM_CELL_PX))
    cells = cv2.resize(depth_mm, size, interpolation=cv2.INTER_AREA)
    down, across = np.gradient(cells, mm_per_px * height / size[1], mm_per_px * width / size[0])
    slope: np.ndarray = cv2.resize(np.hypot(down, across), (width, height), interpolation=cv2.INTER_NEAREST)
    return slope


def changed_contacts(
    picture: np.ndarray, background: np.ndarray, mm_per_px: float, config: ContactConfig | None = None
) -> ContactRegions:
    """Contact where no depth is known: regions about a steep change of colour, by hysteresis on its gradient.

    The gradient of the smoothed change reaches `steepness` somewhere in a region and half of it throughout; holes, such
    as the even middle of a flat contact, are filled.

    Args:
      picture, background: uint8 [H, W, 3].
      mm_per_px: pitch.
      config: thresholds.
    """
    config = config or ContactConfig()
    steep = cv2.resize(_steepness(picture, background, mm_per_px, config.smoothing_mm), picture.shape[1::-1])
    outlines, _ = cv2.findContours(
        (steep > config.steepness / 2).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    mask, kept, border = np.zeros(steep.shape, bool), 0, False
    for outline in outlines:
        x, y, w, h = cv2.boundingRect(outline)
        region = np.zeros((h, w), np.uint8)
        cv2.drawContours(region, [outline], -1, 1, cv2.FILLED, offset=(-x, -y))
        inside, box = region.astype(bool), np.s_[y : y + h, x : x + w]
        if inside.sum() * mm_per_px**2 >= config.least_mm2 and steep[box][inside].max() >= config.steepness:
            mask[box] |= inside
            kept += 1
            border |= _meets_border(inside, (x, y), steep.shape)
    return ContactRegions(mask=mask, count=kept, at_border=border)


def steepest_change(picture: np.ndarray, background: np.ndarray, mm_per_px: float, smoothing_mm: float = 0.3) -> float:
    """Greatest gradient of the smoothed change of any channel, grey levels per mm.

    A contact changes colours over the width of its edge; a drift of lamps, gain or gel changes them slowly.

    Args:
      picture, background: uint8 [H, W, 3].
      mm_per_px: pitch.
      smoothing_mm: standard deviation of the Gaussian, which averages the camera's noise away.

    Raises:
      SchemaError: a picture narrower than the smoothing.
    """
    return float(_steepness(picture, background, mm_per_px, smoothing_mm).max())


def _steepness(picture: np.ndarray, background: np.ndarray, mm_per_px: float, smoothing_mm: float) -> np.ndarray:
    """Length of the gradient of the smoothed change, grey levels/mm: the greatest of the channels, coarser pixels."""
    scale = max(1, round(smoothing_mm / mm_per_px / 2))  # the smoothed change needs no finer pixels
    difference = cv2.subtract(picture, background, dtype=cv2.CV_32F)
    height, width = difference.shape[0] // scale, difference.shape[1] // scale
    if min(height, width) < 2:
        raise SchemaError(
            f"the picture is {picture.shape[0]} × {picture.shape[1]} px of {mm_per_px:g} mm: must be ≥ {2 * scale} px "
            f"along either side, to be smoothed over {smoothing_mm:g} mm; correct mm_per_px or take a larger picture"
        )
    small = cv2.resize(difference, (width, height), interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small, (0, 0), smoothing_mm / (mm_per_px * scale))
    down, across = (np.diff(smooth, axis=axis) / (mm_per_px * scale) for axis in (0, 1))
    steep: np.ndarray = np.hypot(down[:, :-1], across[:-1]).max(-1)
    return steep


def _meets_border(mask: np.ndarray, corner: tuple[int, int], shape: tuple[int, ...]) -> bool:
    """True if a mask placed at `corner` (x, y) of a picture reaches the outermost pixels of the window."""
    (x, y), (height, width) = corner, mask.shape
    sides = [mask[0].any() and y == 0, mask[-1].any() and y + height == shape[0]]
    return bool(any(sides) or (mask[:, 0].any() and x == 0) or (mask[:, -1].any() and x + width == shape[1]))
