"""Where the patches of pictures and videos lie: window order, rows and columns, places in a table, who attends to whom.

All of it follows from the grids alone, so it is NumPy and constant in the compiled program.
"""

import functools
from typing import NamedTuple

import numpy as np

from touchr1_jax.models.qwen.config import Qwen3VisionConfig, QwenVisionConfig, TowerConfig


class Grid(NamedTuple):
    """Patches of one picture or video: steps of time, rows and columns; a picture has one step."""

    steps: int
    rows: int
    columns: int

    @property
    def patches(self) -> int:
        """Number of patches."""
        return self.steps * self.rows * self.columns


class Groups(NamedTuple):
    """Runs of consecutive patches that attend among themselves, padded to the longest: G runs of at most M patches."""

    patch: np.ndarray  # int [G, M], patch at each place, any patch where there is none
    length: np.ndarray  # int [G]
    back: np.ndarray  # int [n], place of each patch in the flat (G, M)

    @property
    def even(self) -> bool:
        """True if all runs are equally long, so that grouping is a reshape."""
        return bool(np.all(self.length == self.patch.shape[1]))


class Geometry(NamedTuple):
    """Order, positions and groups of the n patches of a few grids; `row` … `frames` are in window order."""

    order: np.ndarray  # int [n], patch that comes at each place of the window order
    token_order: np.ndarray  # int [n / merge²], place in window order of each token of the given order
    row: np.ndarray  # int [n]
    column: np.ndarray  # int [n]
    windows: Groups
    frames: Groups


@functools.lru_cache(maxsize=256)
def geometry(grids: tuple[Grid, ...], config: QwenVisionConfig) -> Geometry:
    """Layout of the patches of all grids together, window by window, frame by frame (arXiv 2502.13923, §2.1.1).

    Patches come merged square by merged square, row by row in each.  Windows tile every frame from its upper left
    corner; those at the right and lower edge are cut off, not padded.

    Args:
      grids: pictures and videos in the order of their patches.
      config: patch, merge and window sizes.

    Raises:
      ValueError: no grid, or one whose rows and columns are no whole number of merged patches.
    """
    check_grids(grids, config)
    side, square = config.window_px // config.cell_px, config.merge**2
    tokens, window_sizes, frame_sizes, start = [], [], [], 0
    for grid in grids:
        rows, columns = grid.rows // config.merge, grid.columns // config.merge
        frame = np.arange(rows * columns).reshape(rows, columns)
        windows = [
            frame[r : r + side, c : c + side].ravel() for r in range(0, rows, side) for c in range(0, columns, side)
        ]
        for _ in range(grid.steps):
            tokens += [start + w for w in windows]
            window_sizes += [square * w.size for w in windows]
            frame_sizes.append(square * frame.size)
            start += frame.size
    token_at = np.concatenate(tokens)
    order = (token_at[:, None] * square + np.arange(square)).ravel()
    row, column = np.concatenate([patch_places(grid, config.merge) for grid in grids], 1)[:, order]
    return Geometry(order, np.argsort(token_at), row, column, group(window_sizes), group(frame_sizes))


class Stretched(NamedTuple):
    """Positions and frames of the n patches of a few grids, and the four places of a table around each patch."""

    row: np.ndarray  # int [n]
    column: np.ndarray  # int [n]
    frames: Groups
    corner: np.ndarray  # int [4, n], places in the table
    weight: np.ndarray  # float32 [4, n], of each in the bilinear mean


@functools.lru_cache(maxsize=256)
def stretched(grids: tuple[Grid, ...], config: Qwen3VisionConfig) -> Stretched:
    """Layout of patches in the given order; the table's corners lie on those of every frame.

    Args:
      grids: pictures and videos in the order of their patches.
      config: merge size, and places of the table.

    Raises:
      ValueError: as `geometry`.
    """
    check_grids(grids, config)
    row, column = np.concatenate([patch_places(grid, config.merge) for grid in grids], 1)
    last = lambda axis: np.repeat([getattr(g, axis) - 1 for g in grids], [g.patches for g in grids])
    places, shares = [], []
    for at, most in ((row, last("rows")), (column, last("columns"))):
        place = at * (config.side - 1) / most
        low = np.floor(place).astype(int)
        places.append((low, np.minimum(low + 1, config.side - 1)))
        shares.append((1 - (place - low), place - low))
    corner = np.stack([r * config.side + c for r in places[0] for c in places[1]])
    weight = np.stack([r * c for r in shares[0] for c in shares[1]]).astype(np.float32)
    frames = group([g.rows * g.columns for g in grids for _ in range(g.steps)])
    return Stretched(row, column, frames, corner, weight)


def check_grids(grids: tuple[Grid, ...], config: TowerConfig) -> None:
    """Refuse grids that no whole number of tokens fills.

    Raises:
      ValueError: no grid, or one whose rows and columns are no whole number of merged patches.
    """
    if not grids:
        raise ValueError("grids is empty: the vision tower needs a picture or video; leave the tower out for text")
    for grid in grids:
        if min(grid) < 1 or grid.rows % config.merge or grid.columns % config.merge:
            raise ValueError(
                f"grid {tuple(grid)} must have at least one step, and rows and columns in multiples of merge = "
                f"{config.merge}; resize the picture to multiples of {config.cell_px} px"
            )


def patch_places(grid: Grid, merge: int) -> np.ndarray:
    """Row and column of every patch of a grid, int [2, n], merged square by merged square."""
    place = np.indices((grid.rows, grid.columns)).reshape(2, grid.rows // merge, merge, grid.columns // merge, merge)
    return np.tile(place.swapaxes(2, 3).reshape(2, -1), (1, grid.steps))


def group(sizes: list[int]) -> Groups:
    """Consecutive runs of the given sizes."""
    length = np.array(sizes)
    start = np.cumsum(length) - length
    inside = np.arange(length.max())
    patch = np.minimum(start[:, None] + inside, length.sum() - 1)
    back = np.flatnonzero((inside < length[:, None]).ravel())
    return Groups(patch, length, back)
