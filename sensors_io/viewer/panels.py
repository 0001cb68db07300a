"""Arrays as pictures that people read."""

import functools
from collections.abc import Callable

import cv2
import numpy as np

from sensors_io.devices.base import Sample

Panel = Callable[[], np.ndarray]
"""A picture that is drawn when somebody looks: RGB uint8 [H, W, 3]."""

_DEPTH_TOP_MM = 1.5  # full colour: what a finger does to a 4 mm gel
_SHIFT_TOP_MM = 1.0
_ARROW_GAIN = 4.0  # a shift of 1 mm is drawn over 4 mm
_WINDOW_MM = 20.0  # an arrow's length is to the scale of a sensor's window of about this height
_LEAST_SIDE = 320  # px: small fields are enlarged
_ARROWS = 20  # along the longer side
_LEAST_ARROW_PX = 1.5  # shorter ones are left out: a field of noise stays empty
_BARB = 0.25  # of an arrow's length, back and to the side
_SUBPIXEL_BITS = 4  # of coordinates that OpenCV draws by
_INK, _HALO = (255, 255, 255), (20, 23, 26)
_RULES_MM = (1.0, 2.0, 5.0, 10.0)  # lengths of the scale; the longest that is a third of the picture at most
_FONT, _FONT_SCALE, _DRAWN_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.42, 320  # of numbers on a picture of this width


def panels(sample: Sample, mm_per_px: float | None = None) -> dict[str, Panel]:
    """Panels of a sample, by name; the pitch of its picture, mm/px, where it is known, gives them a scale."""
    arrays, frame = sample.arrays, sample.frame
    mm = None if frame is None or mm_per_px is None else frame.shape[1] * mm_per_px
    shown: dict[str, Panel] = {}
    if frame is not None and frame.ndim == 3:
        mask = arrays.get("contact")
        shown["camera"] = lambda: with_rule(frame if mask is None else outlined(frame, mask), mm)
    elif frame is not None:
        shown["camera"] = lambda: coloured(frame, float(frame.max()))
    if "view_depth_mm" in arrays:
        shown["distance"] = lambda: coloured(arrays["view_depth_mm"], float(arrays["view_depth_mm"].max()))
    for name, array in arrays.items():
        if name == "depth_mm" and array.ndim == 2:
            shown["depth"] = functools.partial(_drawn, coloured, array, _DEPTH_TOP_MM, mm)
        elif name in ("deformation_mm", "shear_mm") and array.ndim == 3:
            shown[name.removesuffix("_mm")] = functools.partial(_drawn, arrows, array, _SHIFT_TOP_MM, mm)
    return shown


SCALES = {
    "camera": "contact outlined in white",
    "depth": f"indentation, 0 to {_DEPTH_TOP_MM:g} mm",
    "deformation": f"arrows {_ARROW_GAIN:g} times as long, colour 0 to {_SHIFT_TOP_MM:g} mm",
    "shear": f"arrows {_ARROW_GAIN:g} times as long, colour 0 to {_SHIFT_TOP_MM:g} mm",
    "distance": "from the camera, dark is near",
}
"""Meaning of the colours and lengths of a panel, by its name."""


def outlined(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The picture with the outline of a mask [H, W] in white."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(picture.copy(), outlines, -1, _INK, 1)


def coloured(field: np.ndarray, top: float) -> np.ndarray:
    """A field [h, w] from 0 to `top` in the colours of Viridis; where it is not finite, black."""
    share = np.clip(np.nan_to_num(field) / max(top, 1e-9), 0, 1)
    picture = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    picture[~np.isfinite(field)] = 0
    return _enlarged(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def arrows(field_mm: np.ndarray, top_mm: float = _SHIFT_TOP_MM) -> np.ndarray:
    """A vector field [h, w, 2] as arrows over its magnitude, from 0 to `top_mm`; none is longer than the picture."""
    field_mm = field_mm.astype(np.float64)
    picture = coloured(np.linalg.norm(field_mm, axis=-1), top_mm)
    height, width = field_mm.shape[:2]
    step = max(1, max(height, width) // _ARROWS)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    scale = np.array([picture.shape[1] / width, picture.shape[0] / height])
    start = (np.stack([columns, rows], -1) + 0.5) * scale
    drawn = field_mm[rows, columns]
    shift = _ARROW_GAIN * picture.shape[0] / _WINDOW_MM * np.where(np.isfinite(drawn), drawn, 0)
    length, longest = np.hypot(shift[..., 0], shift[..., 1]), sum(picture.shape[:2])  # OpenCV draws 10⁹ px for minutes
    seen = length >= _LEAST_ARROW_PX
    strokes = _strokes(start[seen], shift[seen] * np.minimum(1, longest / length[seen])[:, None])
    for colour, thickness in ((_HALO, 3), (_INK, 1)):  # white in a dark halo is seen on every colour
        cv2.polylines(picture, strokes, False, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    return picture


def with_rule(picture: np.ndarray, width_mm: float | None) -> np.ndarray:
    """The picture, enlarged if it is small, with a scale in millimetres if its width is known and not too small."""
    if width_mm is None or width_mm < _RULES_MM[0]:
        return picture
    picture = _enlarged(picture)
    length_mm = max((mm for mm in _RULES_MM if 3 * mm <= width_mm), default=_RULES_MM[0])
    unit, height = picture.shape[1] / _DRAWN_PX, picture.shape[0]
    left, low = round(8 * unit), height - round(8 * unit)
    ends = (left, low), (left + round(length_mm / width_mm * picture.shape[1]), low)
    for colour, width in ((_HALO, 4 * unit), (_INK, 2 * unit)):
        cv2.line(picture, *ends, colour, round(width))
    return _written(picture, f"{length_mm:g} mm", (left, low - round(7 * unit)), unit)


def with_bar(picture: np.ndarray, top_mm: float) -> np.ndarray:
    """The picture next to the colours from 0 to `top_mm`, with both numbers."""
    height, unit = picture.shape[0], picture.shape[1] / _DRAWN_PX
    top, left = f"{top_mm:g} mm", round(21 * unit)
    (width, _), _ = cv2.getTextSize(top, _FONT, _FONT_SCALE * unit, round(3 * unit))
    bar = np.full((height, left + width + round(4 * unit), 3), _HALO, np.uint8)
    colours = coloured(np.linspace(np.full(_LEAST_SIDE, top_mm), 0, height), top_mm)
    bar[:, round(6 * unit) : round(18 * unit)] = colours[:, :1]
    _written(bar, top, (left, round(14 * unit)), unit)
    _written(bar, "0", (left, height - round(5 * unit)), unit)
    return np.hstack([picture, bar])


def _drawn(
    draw: Callable[[np.ndarray, float], np.ndarray], field: np.ndarray, top_mm: float, width_mm: float | None
) -> np.ndarray:
    """A field with its colours and, where the width of its picture is known, its scale."""
    return with_bar(with_rule(draw(field, top_mm), width_mm), top_mm)


def _written(picture: np.ndarray, words: str, at: tuple[int, int], unit: float) -> np.ndarray:
    """The picture with words, white in a dark halo, in place; `unit` enlarges them."""
    for colour, width in ((_HALO, 3), (_INK, 1)):
        cv2.putText(picture, words, at, _FONT, _FONT_SCALE * unit, colour, round(width * unit), cv2.LINE_AA)
    return picture


def _strokes(start: np.ndarray, shift: np.ndarray) -> list[np.ndarray]:
    """Arrows from `start` by `shift`, px [n, 2] each, as one line: shaft, tip, one barb, tip, the other barb."""
    tip = start + shift
    along, across = _BARB * shift, _BARB * np.stack([-shift[:, 1], shift[:, 0]], -1)
    points = np.stack([start, tip, tip - along + across, tip, tip - along - across], 1)
    return list(np.rint(points * 2**_SUBPIXEL_BITS).astype(np.int32))


def _enlarged(picture: np.ndarray) -> np.ndarray:
    factor = -(-_LEAST_SIDE // max(picture.shape[:2]))
    return np.ascontiguousarray(picture.repeat(factor, 0).repeat(factor, 1))
