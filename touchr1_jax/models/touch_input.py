"""One touch as the arrays that a policy reads."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from touchr1_jax.models.saved_policy import SavedPolicy
from touchr1_jax.text.plain_questions import QuestionError

LAST_INDEX = 2**24
"""Largest position of a frame: rotary angles are float32, which has no odd numbers beyond, and positions add up."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TouchInput:
    """One touch of an object as some of a policy's sensors recorded it.

    Attributes:
      frames: sensor → RGB pictures in the order of time, uint8 [F, H, W, 3], at most as many as the policy reads.
      force_n: sensor → force on the gel, pressing is z < 0, float [F, 3]; absent where it was not measured.
      index: sensor → position of each frame in its recording, int [F], increasing; 0, 1, … by default.
      view: RGB picture of the object, uint8 [H, W, 3], or `None`.
    """

    frames: Mapping[str, np.ndarray]
    force_n: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    index: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    view: np.ndarray | None = None


def clip_arrays(touch: TouchInput, saved: SavedPolicy) -> dict[str, np.ndarray]:
    """The arrays of `TouchBatch` for one touch, without P: pictures resized, absent streams and frames masked.

    Raises:
      QuestionError: no sensor or an unknown one, arrays of other shapes or types, numbers that are not finite, an
        index that does not increase, or more frames than the policy reads.
    """
    model, sensors = saved.model, saved.sensors
    for field in ("frames", "force_n", "index"):
        if not isinstance(given := getattr(touch, field), Mapping):
            raise QuestionError(
                f"{field} is {type(given).__name__}: must name its sensor, as in {{{sensors[0]!r}: …}}; name it"
            )
    without_frames = sorted(map(str, (touch.force_n.keys() | touch.index.keys()) - touch.frames.keys()))
    if without_frames:
        raise QuestionError(
            f"force_n and index are of {', '.join(without_frames)}: must be of sensors with frames; rename them"
        )
    unknown = sorted(map(str, touch.frames.keys() - {*sensors}))
    if unknown or not touch.frames:
        raise QuestionError(
            f"frames are of {unknown or 'no sensor'}: the policy reads {', '.join(sensors)}; rename them"
        )
    shape = (len(sensors), model.frames)
    of: dict[str, np.ndarray] = {
        "frames": np.zeros((*shape, model.image_px, model.image_px, 3), np.uint8),
        "force_n": np.zeros((*shape, 3), np.float32),
        "frame_index": np.zeros(shape, np.int32),
        "frame_mask": np.zeros(shape, bool),
        "stream_mask": np.array([sensor in touch.frames for sensor in sensors]),
        "view": np.zeros((saved.view_px, saved.view_px, 3), np.uint8),
        "view_mask": np.array(touch.view is not None),
        "label": np.full(len(saved.policy.language.attributes), -1, np.int32),
    }
    for s, sensor in enumerate(sensors):
        if sensor not in touch.frames:
            continue
        frames, force, index = _checked(touch, sensor, model.frames)
        n = len(frames)
        of["frames"][s, :n] = [_resized(frame, model.image_px) for frame in frames]
        of["force_n"][s, :n], of["frame_index"][s, :n], of["frame_mask"][s, :n] = force, index, True
    if touch.view is not None:
        view = _array(touch.view, "view")
        if not _is_picture(view):
            raise QuestionError(f"view is {view.dtype}{list(view.shape)}: must be RGB uint8 [H, W, 3]; convert it")
        of["view"] = _resized(view, saved.view_px)
    return of


def _checked(touch: TouchInput, sensor: str, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames of one sensor, their force and their index, of as many frames each and no more than `most`."""
    frames = _array(touch.frames[sensor], f"frames[{sensor}]")
    n = len(frames) if frames.ndim == 4 else 0
    if not 1 <= n <= most or not all(map(_is_picture, frames)):
        raise QuestionError(
            f"frames[{sensor}] are {frames.dtype}{list(frames.shape)}: must be uint8 [F, H, W, 3] with 1 ≤ F ≤ "
            f"{most}; choose frames that cover the contact, as sensors_io.selection.choose_frames does"
        )
    force, index = (
        _array(given.get(sensor, default), f"{name}[{sensor}]")
        for name, given, default in (
            ("force_n", touch.force_n, np.zeros((n, 3))),
            ("index", touch.index, np.arange(n)),
        )
    )
    if np.shape(force) != (n, 3) or np.shape(index) != (n,):
        raise QuestionError(
            f"force_n[{sensor}] and index[{sensor}] are {np.shape(force)} and {np.shape(index)}: must be "
            f"({n}, 3) and ({n},) for {n} frames; align them"
        )
    measured = force.dtype.kind in "iuf" and (np.abs(force) <= np.finfo(np.float32).max).all()  # false of NaN
    if not measured or index.dtype.kind not in "iu" or index.min() < 0 or index.max() > LAST_INDEX:
        raise QuestionError(
            f"force_n[{sensor}] and index[{sensor}] must be finite numbers (float32) and whole numbers from 0 to "
            f"{LAST_INDEX}; leave a force out that was not measured, count frames from the first one"
        )
    if not (index[1:] > index[:-1]).all():
        raise QuestionError(f"index[{sensor}] is {index}: must increase with time; sort the frames, each once")
    return frames, force, index


def _array(given: Any, what: str) -> np.ndarray:
    """An array of what was given; `QuestionError` for parts of several shapes."""
    try:
        return np.asarray(given)
    except ValueError as error:
        raise QuestionError(f"{what} is no array ({error}): its parts must have one shape; resize them") from error


def _is_picture(image: np.ndarray) -> bool:
    return image.dtype == np.uint8 and image.ndim == 3 and image.shape[-1] == 3 and image.size > 0


def _resized(image: np.ndarray, px: int) -> np.ndarray:
    """The whole picture at px × px, as clips of training are made."""
    if image.shape[:2] == (px, px):
        return image
    how: Any = cv2.INTER_AREA if min(image.shape[:2]) >= px else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (px, px), interpolation=how))
