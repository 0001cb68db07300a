"""From a video to a touch: the gel at rest and the frames in which something presses it."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np

from sensors_io.importers.keep import Keep
from sensors_io.importers.video import VideoError, read_video

SIZE_PX = (240, 320)
"""Rows and columns that a frame is brought to: those of PhysiCLeAR's videos."""

PROBE_PX = (60, 80)
"""Rows and columns at which frames are compared: pressing changes large areas, noise does not survive the mean."""

REST_COUNTS = 0.6
"""Mean change against the first frame, grey levels, up to which the gel counts as untouched: twice the noise."""

REST_FRAMES = 12
"""Of those, the first ones that are averaged: half a second, before anything slides over the gel."""

CONTACT_SHARE = 0.4
"""Of the way from the least to the greatest change; frames beyond it are in contact, the ramps at its ends not."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoTouch:
    """Contact data of a video.

    Args:
      rest: float32 [H, W, 3], the untouched gel, RGB counts.
      frames: uint8 [F, H, W, 3], frames in contact, in order of time.
      position: int [F], their indices in the video.
      change: float32 [N, h, w], change of every frame of the video against `rest` at a quarter of its size, grey levels
        summed over the colours.
    """

    rest: np.ndarray
    frames: np.ndarray
    position: np.ndarray
    change: np.ndarray

    @property
    def difference(self) -> np.ndarray:
        """Change of the frames in contact against the gel at rest, float32 [F, H, W, 3]."""
        return self.frames.astype(np.float32) - self.rest


def read_touch(path: Path, count: int) -> VideoTouch:
    """Decode a video and find its touch; arguments and errors are those of `read_video` and `find_touch`."""
    return find_touch(read_video(path, Keep(height=0, max_frames=0)).frames, count)


def find_touch(frames: np.ndarray, count: int) -> VideoTouch:
    """Find the touch where the change is large; the gel at rest is the mean of the first frames like the very first.

    The F frames cut the sum of the change over the frames in contact into equal parts, at their middles, so that they
    are denser where the contact is stronger.  A video of fewer frames than F in contact repeats some.  One that begins
    in contact has no rest: its first frame takes that place, and the motion since then is described.

    Args:
      frames: uint8 [N, H, W, 3], RGB.
      count: F.

    Raises:
      VideoError: fewer than three frames.
    """
    if len(frames) < 3:
        raise VideoError(f"holds {len(frames)} frames: a touch needs three, at rest, in contact and between; record it")
    small = np.stack([_resize(frame, PROBE_PX) for frame in frames]).astype(np.float32)
    since_start = np.abs(small - small[0]).mean((1, 2, 3))
    quiet = np.flatnonzero(since_start <= max(REST_COUNTS, float(np.quantile(since_start, 0.1))))[:REST_FRAMES]
    change = np.abs(small - small[quiet].mean(0)).sum(-1)
    position = _equal_parts(change.mean((1, 2)), count)
    rest = np.stack([_resize(frames[n], SIZE_PX) for n in quiet]).mean(0, dtype=np.float32)
    kept = np.stack([_resize(frames[n], SIZE_PX) for n in position])
    return VideoTouch(rest=rest, frames=kept, position=position, change=change)


def touch_of_scene(frames: np.ndarray) -> VideoTouch:
    """The touch of a generated press: its first, lightest frame counts as rest, its later half is in contact.

    The last frame is left out: few hands press with 20 N.

    Args:
      frames: uint8 [N, H, W, 3], N ≥ 4, load rising.
    """
    position = np.arange(max(1, (len(frames) - 1) // 2), len(frames) - 1)
    small = np.stack([_resize(frame, PROBE_PX) for frame in frames]).astype(np.float32)
    return VideoTouch(
        rest=_resize(frames[0], SIZE_PX).astype(np.float32),
        frames=np.stack([_resize(frames[n], SIZE_PX) for n in position]),
        position=position,
        change=np.abs(small - small[0]).sum(-1),
    )


def _equal_parts(change: np.ndarray, count: int) -> np.ndarray:
    """Positions of the frames that share the change in contact equally, int [count]; the greatest is among them."""
    least, most = float(change.min()), float(change.max())
    contact = np.flatnonzero(change >= least + CONTACT_SHARE * (most - least))
    total = np.cumsum(np.maximum(change[contact], np.finfo(np.float32).tiny))
    share = (np.arange(count) + 0.5) / count * total[-1]
    position = contact[np.minimum(np.searchsorted(total, share), len(contact) - 1)]
    position[np.argmin(np.abs(position - change.argmax()))] = change.argmax()
    return np.sort(position)


def _resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if image.shape[:2] == size:
        return image
    shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
