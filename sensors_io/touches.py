"""From a video to a touch, the gel at rest and the frames in which something presses it, and to its description.

The description holds at which scales, how strongly and how unevenly the touch differs from the gel at rest.
The change of colour is nearly linear in the slope of the gel, so its energy at a scale is the energy of the relief at
that scale: fine octaves are roughness, middle ones bumps, and the sharpness of contact edges separates hard from soft
objects.  Six octaves of a Gaussian pyramid, and of each

    spread      mean |band| of the colours' sum and of two differences
    patches     quantiles over a 15 × 20 grid of the local energy: a few sharp edges or texture all over
    edges       energy, orientedness and steepest part of the structure tensor

then of the `contact` the energy of every octave where the middle ones are strong, and the area over which they are.
Energies are logarithms, in which the press of a hand, unknown here, is a shift.  Of the whole video, `course` describes
how the change grows, spreads, moves and fades: soft objects spread as they are pressed.

Second-order scattering (Bruna & Mallat 2013), skewness, kurtosis and the relief integrated from the slopes were tried
too: none improved the answers about unseen objects.
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from sensors_io.importers.keep import Keep
from sensors_io.importers.video import VideoError, read_video

SIZE_PX = (240, 320)  # rows and columns that a frame is brought to: those of PhysiCLeAR's videos
PROBE_PX = (60, 80)
"""Rows and columns at which frames are compared: pressing changes large areas, noise does not survive the mean."""

REST_COUNTS = 0.6
"""Mean change against the first frame, grey levels, up to which the gel counts as untouched: twice the noise."""

REST_FRAMES = 12  # of those, the first ones that are averaged: half a second, before anything slides over the gel
CONTACT_SHARE = 0.4
"""Of the way from the least to the greatest change; frames beyond it are in contact, the ramps at its ends not."""

OCTAVES = 6

COLOURS = (np.array([[1, 1, 1], [1, -1, 0], [0.5, 0.5, -1]]).T / np.sqrt([3, 2, 1.5])).astype(np.float32)
"""Orthonormal: the sum of the colours, red against green, both against blue.  A lamp of each colour shines from one
side, so that the differences carry the slope along two directions, and the sum carries the part common to all."""

FLOOR = 0.05  # grey levels added to every energy before its logarithm: the codec's noise
AREAS = (1.0, 2.0, 4.0, 8.0, 16.0)  # local energies, grey levels, whose excess area is measured
GRID = (15, 20)  # rows and columns of the local energies
QUANTILES = (10.0, 50.0, 90.0, 98.0)  # percentiles of the local energies over the grid
_LEAST = (64, 64)  # rows and columns that six octaves can halve

_Part = tuple[str, np.ndarray]


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
      VideoError: fewer than three frames, or all of them alike.
    """
    if len(frames) < 3:
        raise VideoError(f"holds {len(frames)} frames: a touch needs three, at rest, in contact and between; record it")
    if all((frame == frames[0]).all() for frame in frames[1:]):
        raise VideoError(
            f"shows one picture in all of its {len(frames)} frames: a touch changes them; record the touch"
        )
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


def describe(touch: VideoTouch) -> np.ndarray:
    """Describe a touch, float32 [D], D = `len(families())`: the mean over its frames in contact, then its course."""
    return np.concatenate([describe_frames(touch.difference @ COLOURS), _course(touch.change)]).astype(np.float32)


def describe_frames(frames: np.ndarray) -> np.ndarray:
    """Mean description of frames in contact [F, H, W, 3] without the course, float32 [`len(frame_families())`].

    The channels may be fields in the place of colours, scaled to grey levels.
    """
    every = [np.concatenate([values for _, values in _parts(frame)]) for frame in frames]
    return np.mean(every, 0).astype(np.float32)


@functools.cache
def families() -> tuple[str, ...]:
    """The family of each of the D numbers, such as `edges`."""
    return (*frame_families(), *["course"] * len(_course(np.zeros((3, *PROBE_PX), np.float32))))


@functools.cache
def frame_families() -> tuple[str, ...]:
    """Those of the numbers of frames alone."""
    return tuple(name for name, values in _parts(np.zeros((*_LEAST, 3), np.float32)) for _ in values)


def _parts(picture: np.ndarray) -> Iterator[_Part]:
    """Families of numbers of one picture [H, W, 3], in order."""
    picture = np.ascontiguousarray(picture, np.float32)
    local = []
    for _ in range(OCTAVES):
        smooth = _blur(picture, 1.0)
        size = np.abs(picture - smooth)
        resize_by = cv2.INTER_AREA if size.shape[0] >= GRID[0] else cv2.INTER_LINEAR
        local.append(cv2.resize(size.sum(-1), GRID[::-1], interpolation=resize_by))
        yield "spread", np.log(size.mean((0, 1)) + FLOOR)
        yield "patches", np.log(np.percentile(local[-1], QUANTILES) + FLOOR)
        yield "edges", _edges(smooth)
        picture = cv2.resize(smooth, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    yield "spread", np.log(np.abs(picture).mean((0, 1)) + FLOOR)
    yield from _contact(np.stack(local))


def _edges(smooth: np.ndarray) -> np.ndarray:
    """Log energy of the gradient, share of it that has one orientation, log of its 95th percentile; [3]."""
    along_x, along_y = (cv2.Sobel(smooth, cv2.CV_32F, *order) / 8 for order in ((1, 0), (0, 1)))
    products = ((along_x, along_x), (along_y, along_y), (along_x, along_y))
    xx, yy, xy = (_blur((a * b).sum(-1), 2.0) for a, b in products)
    energy = xx + yy
    oriented = np.sqrt((xx - yy) ** 2 + 4 * xy**2).sum() / (energy.sum() + FLOOR / 10 * energy.size)
    return np.array([np.log(energy.mean() + FLOOR / 5), oriented, np.log(np.percentile(energy, 95) + FLOOR / 5)])


def _contact(local: np.ndarray) -> Iterator[_Part]:
    """Log area beyond each energy of the middle octaves, and every octave's energy there; local [octave, h, w]."""
    middle = local[1:5].sum(0)
    yield "contact", np.log(np.array([(middle > energy).mean() for energy in AREAS]) + 0.02)
    inside = (local * middle).sum((1, 2)) / (middle.sum() + 1e-6)
    yield "contact", np.log(inside + FLOOR)


def _course(change: np.ndarray) -> np.ndarray:
    """Numbers of the whole video, [17]; change [N, h, w]."""
    smooth = np.stack([_blur(frame, 1.0) for frame in change])
    pixels = smooth.reshape(len(change), -1)
    total, top, middle = pixels.mean(1), np.percentile(pixels, 99, axis=1), np.percentile(pixels, 50, axis=1)
    area, wide = (pixels > 3).mean(1), (pixels > 0.5 * top[:, None]).mean(1)
    log_total, log_top, log_wide = np.log(total + 0.3), np.log(top + 0.5), np.log(wide + 0.01)
    contact = np.flatnonzero(total >= total.min() + 0.3 * np.ptp(total))
    press = np.arange(max(contact[0] - 8, 0), contact[-1] + 1)  # with the third of a second in which it is built up
    peak = int(total.argmax())
    moved = np.abs(np.diff(smooth[contact], axis=0)).mean() if len(contact) > 1 else 0.0
    return np.array(
        [
            *(log_total[peak], log_top[peak], np.log(middle[peak] + 0.5), area[peak], log_wide[peak]),
            *(log_total[contact].mean(), log_top[contact].mean(), log_wide[contact].mean(), area[contact].mean()),
            *(_growth(log_total[press], y[press]) for y in (log_top, log_wide, np.log(middle + 0.5))),
            len(contact) / len(total),
            np.log(total[-3:].mean() + 0.3),
            log_total[contact].std(),
            np.log(np.abs(np.diff(log_total[press])).mean() + 0.01) if len(press) > 1 else np.log(0.01),
            np.log(moved / (smooth[contact].mean() + 0.1) + 0.01),
        ]
    )


def _growth(x: np.ndarray, y: np.ndarray) -> float:
    """Slope of y over x by least squares; 0 where x hardly varies."""
    return 0.0 if len(x) < 4 or np.ptp(x) <= 0.05 else float(np.polyfit(x, y, 1)[0])


def _blur(x: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(x, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
