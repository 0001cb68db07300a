"""Arrays as pictures that people read."""

import cv2
import numpy as np

from sensors_io.devices.base import Sample

_DEPTH_TOP_MM = 1.5  # full colour: what a finger does to a 4 mm gel
_SHIFT_TOP_MM = 1.0
_ARROW_GAIN = 4.0  # a shift of 1 mm is drawn over 4 mm
_LEAST_SIDE = 320  # px: small fields are enlarged
_ARROWS = 20  # along the longer side


def panels(sample: Sample) -> dict[str, np.ndarray]:
    """One picture per thing to be seen in a sample, RGB uint8 [H, W, 3], by name."""
    shown = {}
    if sample.frame is not None:
        shown["camera"] = sample.frame if sample.frame.ndim == 3 else coloured(sample.frame, float(sample.frame.max()))
        if "contact" in sample.arrays and sample.frame.ndim == 3:
            shown["camera"] = outlined(sample.frame, sample.arrays["contact"])
    for name, array in sample.arrays.items():
        if name == "depth_mm" and array.ndim == 2:
            shown["depth, 0 to 1.5 mm"] = coloured(array, _DEPTH_TOP_MM)
        elif name in ("deformation_mm", "shear_mm") and array.ndim == 3:
            shown[f"{name.removesuffix('_mm')}, arrows ×{_ARROW_GAIN:g}"] = arrows(array)
    return shown


def outlined(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The picture with the outline of a mask [H, W] in white."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(picture.copy(), outlines, -1, (255, 255, 255), 1)


def coloured(field: np.ndarray, top: float) -> np.ndarray:
    """A field [h, w] from 0 to `top` in the colours of Viridis; where it is not finite, black."""
    share = np.clip(np.nan_to_num(field.astype(np.float32)) / max(top, 1e-9), 0, 1)
    picture = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    picture[~np.isfinite(field)] = 0
    return _enlarged(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def arrows(field_mm: np.ndarray) -> np.ndarray:
    """A vector field [h, w, 2] as arrows over its magnitude."""
    picture = coloured(np.linalg.norm(field_mm, axis=-1), _SHIFT_TOP_MM)
    scale = picture.shape[0] / field_mm.shape[0]
    step = max(1, max(field_mm.shape[:2]) // _ARROWS)
    window_mm = 20.0  # of the sensors: an arrow's length is to the scale of a window of about this height
    gain = _ARROW_GAIN * picture.shape[0] / window_mm
    for i in range(step // 2, field_mm.shape[0], step):
        for j in range(step // 2, field_mm.shape[1], step):
            start = np.array([j + 0.5, i + 0.5]) * scale
            end = start + gain * np.nan_to_num(field_mm[i, j])
            cv2.arrowedLine(
                picture, tuple(map(int, start)), tuple(map(int, end)), (255, 255, 255), 1, cv2.LINE_AA, 0, 0.3
            )
    return picture


def _enlarged(picture: np.ndarray) -> np.ndarray:
    factor = -(-_LEAST_SIDE // max(picture.shape[:2]))
    return np.ascontiguousarray(picture.repeat(factor, 0).repeat(factor, 1))
