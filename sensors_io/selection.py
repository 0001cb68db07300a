"""Choice of the frames that represent a sequence, and images of a sequence that has fields but no camera frames."""

import dataclasses
import functools
import operator
from collections.abc import Sequence as Seq
from typing import Literal

import numpy as np

from sensors_io.schema import FRAME_ARRAYS, Flag, SchemaError, Sequence

Chooser = Literal["auto", "force", "salience"]
"""By what frames are chosen, see `choose_frames`."""

Shown = Literal["pictures", "fields"]
"""Images of a sequence that has both."""

FIELD_MM_PER_COUNT = 1.5 / 127
"""Scale of field images: count = 128 + mm / (1.5 mm / 127), so that ±1.5 mm fill the range and one count is 11.8 µm."""

_PROBE_ROWS = 16  # rows of the subsampled frames that show how much changes


def choose_frames(sequence: Sequence, count: int, rejected: Seq[Flag], by: Chooser = "auto") -> np.ndarray:
    """Positions of the frames that stand for a sequence, strictly increasing, int64 [min(F, usable frames)].

    With a value v_n of each usable frame and F levels l_k evenly spaced from min v to max v, the frames

        argmin Σ_k |v_{n_k} − l_k|   over   n_1 < n_2 < … < n_F

    "force": v is the measured normal load −Fz, so that the frames cover a press from 0 to its maximum.  "salience":
    v is the cumulative salience Σ_{m≤n} c_m, c_m the mean absolute change of frame m against the first one less that
    of the quietest frame, so that frames lie denser the more is seen of the contact.  "auto" takes the force in a press
    where it was measured, salience elsewhere: in a slide at set force the levels of the load would all fall into the
    first touch.  The most pressed frame, of largest load or else of largest change, is always among them.

    Args:
      sequence: N frames.
      count: F, how many to choose.
      rejected: a frame with one of these flags is left out as long as another one remains.
      by: what v is.

    Raises:
      SchemaError: a sequence without frames, or "force" where none was measured.
    """
    bits = functools.reduce(operator.or_, rejected, Flag.NONE)
    usable = np.flatnonzero((sequence.flags & np.uint32(bits)) == 0)
    if not usable.size:
        usable = np.arange(len(sequence))
    if not usable.size:
        raise SchemaError(f"{sequence.name}: has no frame; drop the empty sequence")
    load = None if sequence.force_n is None else -sequence.force_n[usable, 2]
    if by == "force" and load is None:
        raise SchemaError(f"{sequence.name}: force_n is None: frames cannot be chosen by it; choose by 'auto'")
    if usable.size <= count:
        return usable
    if load is not None and (by == "force" or (by == "auto" and sequence.key.motion == "press")):
        value = peak = load
    else:
        change = _change(sequence, usable)
        floor = np.partition(change, 1)[1]  # noise: the change of the quietest frame but for the first
        value, peak = np.cumsum(np.maximum(change - floor, 0)), change if load is None else load
    if np.ptp(value) == 0:
        value = np.arange(usable.size)
    chosen = nearest_increasing(value, np.linspace(value.min(), value.max(), count))
    top = int(np.argmax(peak))
    if top not in chosen:
        chosen[np.argmin(np.abs(chosen - top))] = top
    return usable[chosen]


def pick_frames(sequence: Sequence, chosen: np.ndarray) -> Sequence:
    """The sequence of some of its frames.

    Args:
      sequence: N frames.
      chosen: their positions, int64 [F].
    """
    arrays = {name: getattr(sequence, name) for name in FRAME_ARRAYS}
    return dataclasses.replace(sequence, **{name: x[chosen] for name, x in arrays.items() if x is not None})


def nearest_increasing(value: np.ndarray, level: np.ndarray) -> np.ndarray:
    """The strictly increasing positions whose values lie nearest to the levels in sum, by dynamic programming.

        B_k(n) = |v_n − l_k| + min_{m<n} B_{k−1}(m),   positions traced back from argmin B_F;  O(F N)

    Args:
      value: v, float [N].
      level: l, float [F], F ≤ N.

    Returns:
      Positions, int64 [F]; of equal sums the earliest positions.
    """
    cost = np.abs(np.asarray(value, np.float64)[None] - np.asarray(level, np.float64)[:, None])
    for k in range(1, len(level)):
        cost[k, 1:] += np.minimum.accumulate(cost[k - 1, :-1])
        cost[k, 0] = np.inf
    positions = np.empty(len(level), np.int64)
    end = cost.shape[1]
    for k in range(len(level) - 1, -1, -1):
        end = positions[k] = np.argmin(cost[k, :end])
    return positions


def field_images(sequence: Sequence) -> np.ndarray:
    """Fields as images, float32 [N, h, w, 3]: channels deformation x, deformation y, depth in counts.

        count = 128 + mm / `FIELD_MM_PER_COUNT`

    A point that is not valid, and a field that the recording lacks, is 128: no displacement.
    """
    present = [f for f in (sequence.deformation_mm, sequence.depth_mm) if f is not None]
    mm = np.zeros((len(sequence), *present[0].shape[1:3], 3), np.float32)
    if sequence.deformation_mm is not None:
        mm[..., :2] = sequence.deformation_mm
    if sequence.depth_mm is not None:
        mm[..., 2] = sequence.depth_mm
    if sequence.valid is not None:
        mm = np.where(sequence.valid[..., None], mm, 0)  # whatever stands there, NaN among it
    return 128 + mm / np.float32(FIELD_MM_PER_COUNT)


def _change(sequence: Sequence, usable: np.ndarray) -> np.ndarray:
    """Mean absolute change of each usable frame against the first frame of the sequence, float64 [n]."""
    if sequence.frames is None:
        pixels = field_images(pick_frames(sequence, np.concatenate([[0], usable])))
    else:
        step = max(1, min(sequence.frames.shape[1:3]) // _PROBE_ROWS)
        pixels = sequence.frames[:, ::step, ::step].astype(np.float32)[np.concatenate([[0], usable])]
    return np.abs(pixels[1:] - pixels[0]).mean(axis=(1, 2, 3), dtype=np.float64)
