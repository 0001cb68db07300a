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


def panels(sample: Sample) -> dict[str, Panel]:
    """Panels of a sample, by name."""
    arrays, frame = sample.arrays, sample.frame
    shown: dict[str, Panel] = {}
    if frame is not None and frame.ndim == 3:
        mask = arrays.get("contact")
        shown["camera"] = (lambda: frame) if mask is None else functools.partial(outlined, frame, mask)
    elif frame is not None:
        shown["camera"] = lambda: coloured(frame, float(frame.max()))
    if "view_depth_mm" in arrays:
        shown["distance"] = lambda: coloured(arrays["view_depth_mm"], float(arrays["view_depth_mm"].max()))
    for name, array in arrays.items():
        if name == "depth_mm" and array.ndim == 2:
            shown["depth"] = functools.partial(coloured, array, _DEPTH_TOP_MM)
        elif name in ("deformation_mm", "shear_mm") and array.ndim == 3:
            shown[name.removesuffix("_mm")] = functools.partial(arrows, array)
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
    share = np.clip(np.nan_to_num(field.astype(np.float32)) / max(top, 1e-9), 0, 1)
    picture = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    picture[~np.isfinite(field)] = 0
    return _enlarged(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def arrows(field_mm: np.ndarray) -> np.ndarray:
    """A vector field [h, w, 2] as arrows over its magnitude."""
    picture = coloured(np.linalg.norm(field_mm, axis=-1), _SHIFT_TOP_MM)
    height, width = field_mm.shape[:2]
    step = max(1, max(height, width) // _ARROWS)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    scale = np.array([picture.shape[1] / width, picture.shape[0] / height])
    start = (np.stack([columns, rows], -1) + 0.5) * scale
    shift = _ARROW_GAIN * picture.shape[0] / _WINDOW_MM * np.nan_to_num(field_mm[rows, columns])
    seen = np.hypot(shift[..., 0], shift[..., 1]) >= _LEAST_ARROW_PX
    strokes = _strokes(start[seen], shift[seen])
    for colour, thickness in ((_HALO, 3), (_INK, 1)):  # white in a dark halo is seen on every colour
        cv2.polylines(picture, strokes, False, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
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
