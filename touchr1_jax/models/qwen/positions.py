"""Position ids of prompts that mix text, pictures, videos and touch, as the decoder's rotary positions read them.

    (time, row, column) of a text token:    its index, three times
    of a token of a picture or video:       start of its block + (time id of its step, its row, its column)

A block starts one after the largest id before it (Qwen2-VL, arXiv 2409.12191, §2.1).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from touchr1_jax.models.qwen.geometry import Grid


class Seen(NamedTuple):
    """Tokens of one picture, video or tactile stream: steps × rows × columns, and the time id of each step."""

    times: np.ndarray  # int [steps], from 0
    rows: int
    columns: int

    @property
    def tokens(self) -> int:
        """Number of tokens."""
        return len(self.times) * self.rows * self.columns


def picture(grid: Grid, merge: int) -> Seen:
    """A picture: one step at time 0."""
    return Seen(np.zeros(grid.steps, np.int64), grid.rows // merge, grid.columns // merge)


def video(grid: Grid, merge: int, seconds_per_step: float, tokens_per_second: int) -> Seen:
    """A video: step i at ⌊i · seconds_per_step · tokens_per_second⌋ (arXiv 2502.13923, §2.1.2).

    The product is rounded down, not its factors: casting seconds to integers first, as some versions of transformers
    do, gives every step of a video above `patch_frames` frames a second the same id.  Even so steps closer than
    1/tokens_per_second share an id, which is why touch has `tactile`.

    Args:
      grid: patches.
      merge: side of a token in patches.
      seconds_per_step: time from one step to the next, patch_frames / frames per second.
      tokens_per_second: time ids of one second.

    Raises:
      ValueError: time that stands still or runs backwards.
    """
    if not seconds_per_step > 0:
        raise ValueError(f"seconds_per_step is {seconds_per_step}: must be positive, patch_frames / frames per second")
    times = np.floor(np.arange(grid.steps) * (seconds_per_step * tokens_per_second)).astype(np.int64)
    return Seen(times, grid.rows // merge, grid.columns // merge)


def tactile(frame_index: Int[np.ndarray, "n"], tokens_per_step: int) -> Seen:
    """A tactile stream: step i at its integer frame index; its tokens lie in one row.

    A departure from videos: sensors run at 25 to 120 frames a second, where ids by the second would coincide and the
    order of frames could not be told.

    Raises:
      ValueError: frame indices below 0 or that do not rise.
    """
    index = np.asarray(frame_index)
    if np.any(np.diff(index, prepend=-1) <= 0):
        raise ValueError(f"frame_index is {index.tolist()}: must rise from step to step, from 0; drop repeated frames")
    return Seen(index, 1, tokens_per_step)


def position_ids(runs: Sequence[int | Seen]) -> Int[np.ndarray, "3 L"]:
    """Position ids of a prompt.

    transformers ≥ 5 starts the text after a video behind its rows and columns alone, so that the ids of a long video
    run into those of the text; this follows the released model, where they do not.

    Args:
      runs: the prompt in order, a number of text tokens or what is seen.
    """
    start, blocks = 0, []
    for run in runs:
        if isinstance(run, Seen):
            steps, rows, columns = np.indices((len(run.times), run.rows, run.columns)).reshape(3, -1)
            local = np.stack([run.times[steps], rows, columns])
        else:
            local = np.tile(np.arange(run), (3, 1))
        blocks.append(start + local)
        start += local.max(initial=-1) + 1
    return np.concatenate(blocks, 1) if blocks else np.zeros((3, 0), np.int64)
