"""Which part of the window the presses of a ball cover, and where to press next."""

import dataclasses

import cv2
import numpy as np

from sensors_io.calibration.presses import Touches

REACH = 1.5
"""Contact radii from its centre that a press covers: the map changes little over that distance."""

MARGIN = 0.6
"""Contact radii from the border, nearer than which no press is asked for: too little of the ball is seen there."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Coverage:
    """Pixels that some press covers, bool [H, W], their share, and the place (x, y) in px farthest from all presses."""

    covered: np.ndarray
    share: float
    next_px: tuple[float, float]

    def where(self) -> str:
        """The place to press next in words, such as "upper left"."""
        (height, width), (x, y) = self.covered.shape, self.next_px
        down = ("upper", "middle", "lower")[min(int(3 * y / height), 2)]
        across = ("left", "middle", "right")[min(int(3 * x / width), 2)]
        return "the middle" if down == across else f"the {down} {across}"


def coverage(touches: Touches, shape: tuple[int, int]) -> Coverage:
    """Coverage of a window [H, W] by presses; with no press the place is its centre.

    Args:
      touches: of the presses, in pixels.
      shape: rows and columns of the pictures.
    """
    height, width = shape
    if not len(touches):
        return Coverage(covered=np.zeros(shape, bool), share=0.0, next_px=((width - 1) / 2, (height - 1) / 2))
    rows = touches.stacked()
    y, x = np.mgrid[:height, :width]
    away = np.min([np.hypot(x - row[0], y - row[1]) for row in rows], 0).astype(np.float32)
    radius = float(np.median(rows[:, 2]))
    edge = min(round(MARGIN * radius), (min(shape) - 1) // 2)
    inside = np.s_[edge : height - edge, edge : width - edge]
    row, column = np.unravel_index(int(cv2.blur(away, (9, 9))[inside].argmax()), away[inside].shape)
    covered = away < REACH * radius
    return Coverage(
        covered=covered, share=float(covered[inside].mean()), next_px=(float(column + edge), float(row + edge))
    )
