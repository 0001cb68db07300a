"""Contact force from a displacement field, by ridge regression on recordings with a force sensor under the gel.

    F̂ = b + W (u − ū),   W minimises Σ ‖F − F̂‖² + λ ‖W‖²

A calibration, not a law: it holds for contacts like those it was fitted to.  So `fit` says how well it predicts whole
blocks of time that it has not seen, λ chosen without them.

Force and displacement must be of one time: bring the force to the frames first (`sensors_io.force.estimate_lag` and
`at_frames`).  On a Tac3D recording whose force comes one frame late, that halves the error.
"""

import dataclasses

import numpy as np

_PENALTIES = np.geomspace(1e-8, 1e1, 28)  # λ over the largest squared singular value


class ForceFitError(ValueError):
    """Recordings that no force can be fitted to; the message says why and what to do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceModel:
    """A fitted regression.

    Args:
      mean: ū [D].
      weights: W [D, C], N/mm.
      bias: b [C], N.
      penalty: λ over the largest squared singular value.
      held_out_rmse: root mean square error per component on the held-out blocks [C], N.
      held_out: predictions for every frame by the model that has not seen its block [N, C].
    """

    mean: np.ndarray
    weights: np.ndarray
    bias: np.ndarray
    penalty: float
    held_out_rmse: np.ndarray
    held_out: np.ndarray

    def predict(self, displacement_mm: np.ndarray) -> np.ndarray:
        """Force [N, C] of displacement fields [N, …].

        Raises:
          ValueError: fields of another size than fitted.
        """
        flat = np.asarray(displacement_mm, np.float64).reshape(len(displacement_mm), -1)
        if flat.shape[1] != len(self.mean):
            raise ValueError(
                f"displacement_mm has {flat.shape[1]} values a frame: must have {len(self.mean)} as fitted; resample it"
            )
        return self.bias + (flat - self.mean) @ self.weights


def fit(displacement_mm: np.ndarray, force_n: np.ndarray, blocks: int = 5, gap_frames: int = 3) -> ForceModel:
    """Fit, and predict every block of consecutive frames by the others.

    Args:
      displacement_mm: fields in the order of time [N, …].
      force_n: measured force, or force and moment [N, C].
      blocks: of equal length, each held out once.  λ is chosen within the other blocks, by the same scheme.
      gap_frames: left out on either side of a held-out block, for neighbouring frames are nearly the same.

    Raises:
      ForceFitError: arrays of different length, a NaN, too few frames, or a force that does not vary.
    """
    x = np.asarray(displacement_mm, np.float64).reshape(len(displacement_mm), -1)
    y = np.asarray(force_n, np.float64)
    _check(x, y, blocks, gap_frames)
    parts = np.array_split(np.arange(len(x)), blocks)
    held_out = np.empty_like(y)
    for part in parts:
        train = _others(len(x), part, gap_frames)
        penalty = _chosen(x[train], y[train], blocks - 1, gap_frames)
        mean, weights, bias = _ridge(x[train], y[train], np.array([penalty]))
        held_out[part] = bias + (x[part] - mean) @ weights[0]
    penalty = _chosen(x, y, blocks, gap_frames)
    mean, weights, bias = _ridge(x, y, np.array([penalty]))
    return ForceModel(
        mean=mean,
        weights=weights[0],
        bias=bias,
        penalty=penalty,
        held_out_rmse=np.sqrt(np.mean((held_out - y) ** 2, 0)),
        held_out=held_out,
    )


def _chosen(x: np.ndarray, y: np.ndarray, blocks: int, gap_frames: int) -> float:
    """λ of least squared error over held-out blocks."""
    error = np.zeros(len(_PENALTIES))
    for part in np.array_split(np.arange(len(x)), blocks):
        train = _others(len(x), part, gap_frames)
        mean, weights, bias = _ridge(x[train], y[train], _PENALTIES)
        error += ((bias + (x[part] - mean) @ weights - y[part]) ** 2).sum((1, 2))
    return float(_PENALTIES[error.argmin()])


def _ridge(x: np.ndarray, y: np.ndarray, penalties: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean [D], weights of every λ [L, D, C], bias [C]."""
    mean, bias = x.mean(0), y.mean(0)
    left, singular, right = np.linalg.svd(x - mean, full_matrices=False)
    shrink = singular / (singular**2 + penalties[:, None] * singular[0] ** 2)
    return mean, right.T @ (shrink[:, :, None] * (left.T @ (y - bias))), bias


def _others(count: int, part: np.ndarray, gap_frames: int) -> np.ndarray:
    """Frames [n] further than the gap from a block."""
    frames = np.arange(count)
    return frames[(frames < part[0] - gap_frames) | (frames > part[-1] + gap_frames)]


def _check(x: np.ndarray, y: np.ndarray, blocks: int, gap_frames: int) -> None:
    if y.ndim != 2 or len(x) != len(y):
        raise ForceFitError(f"force_n is {list(y.shape)}: must be [{len(x)}, C] as displacement_mm; give one per frame")
    if blocks < 3:
        raise ForceFitError(f"blocks is {blocks}: must be ≥ 3, for the penalty is chosen within the others; raise it")
    least = blocks * (2 * gap_frames + 4)
    if len(x) < least:
        raise ForceFitError(f"displacement_mm holds {len(x)} frames: must be ≥ {least}; record more or lower blocks")
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        raise ForceFitError("displacement_mm or force_n holds a NaN: must be finite; drop incomplete frames")
    if np.ptp(y, 0).max() == 0 or np.ptp(x, 0).max() == 0:
        raise ForceFitError("displacement_mm or force_n is the same in every frame: must vary; press while recording")
