"""Quality filters: each flags frames that have one kind of fault; they never delete them.

A filter takes what was recorded and returns which frames it would reject, bool [N].  Flags are bits, so a filter that
is switched off again leaves no trace: `without` takes its bit back.
"""

import dataclasses
import hashlib
from collections.abc import Collection, Mapping

import cv2
import numpy as np

from sensors_io.schema import FRAME_ARRAYS, Flag, Sequence


@dataclasses.dataclass(frozen=True, kw_only=True)
class QualityConfig:
    """Limits of the filters of pictures.

    Args:
      saturated_level: grey level from which a channel counts as saturated.
      saturated_share: of the pixels, beyond what the gel at rest shows.
      gap_periods: time between frames, in median periods.
    """

    saturated_level: int = 254
    saturated_share: float = 0.002
    gap_periods: float = 1.8

    def __post_init__(self) -> None:
        if not 0 < self.saturated_level <= 255:
            raise ValueError(f"saturated_level is {self.saturated_level}: must lie in 1..255; choose a grey level")
        if not self.saturated_share > 0:
            raise ValueError(f"saturated_share is {self.saturated_share}: must be > 0; raise it")
        if not self.gap_periods > 1:
            raise ValueError(f"gap_periods is {self.gap_periods}: must be > 1; a regular frame is one period apart")


_LEAST_DEPTH_MM = 0.03  # a frame whose field stays below it shows no contact
_UNSTABLE_N, _UNSTABLE_WINDOW = 0.5, 5  # change of the force in a hold, and frames that it is judged over

HOLD = 2
"""The phase in which the force is meant to stand still, as in `FRAME_ARRAYS`."""


def saturated(frames: np.ndarray, background: np.ndarray | None, config: QualityConfig) -> np.ndarray:
    """Frames of which more pixels have a channel at its ceiling than of the gel at rest.

        share(frame) − share(background) > `saturated_share`

    Shares, not pixels, are compared: where the gel itself has bright spots, they move with it.  A pixel counts where
    most of its 3 × 3 neighbourhood does: what noise lifts to the ceiling stands alone.

    Args:
      frames: uint8 [N, H, W, 3].
      background: uint8 [H, W, 3]; `None` where there is none, and no bright spot is expected.
      config: ceiling and share.
    """
    bright = np.array([_bright_share(frame, config.saturated_level) for frame in frames])
    at_rest = 0.0 if background is None else _bright_share(background, config.saturated_level)
    found: np.ndarray = bright - at_rest > config.saturated_share
    return found


def _bright_share(picture: np.ndarray, level: int) -> float:
    brightest = cv2.max(cv2.max(picture[..., 0], picture[..., 1]), picture[..., 2])
    return float((cv2.medianBlur(brightest, 3) >= level).mean())


def untouched(depth_mm: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
    """Frames without contact, by their depth [N, h, w] where it may be read."""
    depth = depth_mm if valid is None else np.where(valid, depth_mm, 0)
    found: np.ndarray = depth.max((1, 2)) < _LEAST_DEPTH_MM
    return found


def incomplete(*columns: np.ndarray | None) -> np.ndarray:
    """Rows in which any measured value is not finite; columns [N, …] that are `None` were never measured."""
    rows = [np.isfinite(c).reshape(len(c), -1).all(1) for c in columns if c is not None]
    if not rows:
        raise ValueError("columns are all None: at least one must be measured; give the arrays of the rows")
    found: np.ndarray = ~np.logical_and.reduce(rows)
    return found


def unstable(force_n: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Frames of a hold about which the normal force changes by more than `_UNSTABLE_N` within the window.

    Args:
      force_n: float [N, 3].
      phase: uint8 [N].
    """
    normal = np.asarray(force_n[:, 2], np.float64)
    before = _UNSTABLE_WINDOW // 2
    padded = np.pad(normal, (before, _UNSTABLE_WINDOW - 1 - before), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, _UNSTABLE_WINDOW)
    swing: np.ndarray = np.ptp(windows, axis=1) > _UNSTABLE_N
    return swing & (phase == HOLD)


def time_gap(host_time_ns: np.ndarray, config: QualityConfig) -> np.ndarray:
    """Frames before which time is missing: more than `gap_periods` median periods since the one before."""
    steps = np.diff(host_time_ns)
    late = np.zeros(len(host_time_ns), bool)
    if len(steps):
        late[1:] = steps > config.gap_periods * np.median(steps)
    return late


def after_gap(sequence: Sequence, config: QualityConfig) -> np.ndarray:
    """Frames before which time is missing, by their times or by the flag that they were recorded with."""
    flagged: np.ndarray = (sequence.flags & Flag.TIME_GAP).astype(bool)
    return flagged | time_gap(sequence.host_time_ns, config)


def judge(sequence: Sequence) -> Mapping[Flag, np.ndarray]:
    """Every filter that a sequence has the arrays for: flag → frames that it marks, bool [N].

    Contact at the border, several contacts and lost markers need the pictures and a calibration: the extraction of the
    fields marks them.
    """
    config = QualityConfig()
    found = {Flag.TIME_GAP: time_gap(sequence.host_time_ns, config)}
    if sequence.frames is not None:
        found[Flag.SATURATED] = saturated(sequence.frames, None, config)
    if sequence.depth_mm is not None:
        found[Flag.NO_CONTACT] = untouched(sequence.depth_mm, sequence.valid)
    if sequence.force_n is not None and (sequence.phase == HOLD).any():
        found[Flag.UNSTABLE_FORCE] = unstable(sequence.force_n, sequence.phase)
    measured = [sequence.force_n, sequence.moment_nmm, sequence.target_force_n]
    if any(column is not None for column in measured):
        found[Flag.INCOMPLETE] = incomplete(*measured)
    return found


def judged(sequence: Sequence, found: Mapping[Flag, np.ndarray]) -> Sequence:
    """The sequence with the flags of filters alone, what `judge` found, in place of those it was recorded with."""
    return dataclasses.replace(sequence, flags=marked(np.zeros(len(sequence), np.uint32), found))


def marked(flags: np.ndarray, found: Mapping[Flag, np.ndarray]) -> np.ndarray:
    """Flags uint32 [N] with the bits of the frames that filters marked."""
    result = flags.copy()
    for flag, frames in found.items():
        result[frames] |= np.uint32(flag)
    return result


def oddities(sequence: Sequence, rejected: Collection[Flag] = ()) -> tuple[str, ...]:
    """Why a legal sequence teaches nothing, or little, about touch; empty for an ordinary one.

    Pictures and fields are judged in the frames that are used, without those that are `rejected` for a flag.
    """
    steps = np.diff(sequence.host_time_ns)
    found = {
        "times that run backwards": bool((steps < 0).any()),
        "times that stand still": len(steps) > 0 and not steps.any(),
        "every frame flagged": bool(sequence.flags.all()),
    }
    used = np.flatnonzero((sequence.flags & np.uint32(sum(set(rejected)))) == 0)
    shown = sequence
    if 0 < len(used) < len(sequence):
        arrays = {name: getattr(sequence, name) for name in FRAME_ARRAYS}
        shown = dataclasses.replace(sequence, **{name: x[used] for name, x in arrays.items() if x is not None})
    found["one frame"] = len(shown) == 1
    if shown.frames is not None:
        small, even = shown.frames.shape[1:3] == (1, 1), all((f == f[:1, :1]).all() for f in shown.frames)
        colour = {(0,): "black", (255,): "white"}.get(tuple(np.unique(shown.frames[:, 0, 0])), "of one colour")
        found["pictures of one pixel"] = small
        found[f"all pictures {colour}"] = even and not small
        found["no change between pictures"] = not even and _stands_still(shown.frames)
    if shown.depth_mm is not None:
        found["no contact in any frame"] = bool(untouched(shown.depth_mm, shown.valid).all())
    fields = [field for field in (shown.deformation_mm, shown.shear_mm, shown.depth_mm) if field is not None]
    unread = shown.valid is not None and not shown.valid.any()
    found["fields that are nowhere valid"] = unread
    found["no change between fields"] = bool(fields) and not unread and all(map(_stands_still, fields))
    return tuple(name for name, holds in found.items() if holds)


def _stands_still(rows: np.ndarray) -> bool:
    return len(rows) > 1 and all((row == rows[0]).all() for row in rows[1:])


def recorded_digest(sequence: Sequence) -> str:
    """First 16 digits of a hash of pictures, else of fields: a copy under another name has the same."""
    digest = hashlib.sha256()
    fields = (sequence.deformation_mm, sequence.depth_mm)
    for array in fields if sequence.frames is None else (sequence.frames,):
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def without(flags: np.ndarray, *filters: Flag) -> np.ndarray:
    """Flags uint32 [N] with the bits of some filters taken back."""
    bits = np.uint32(sum(filters))
    return flags & ~bits
