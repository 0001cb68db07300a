"""Level probabilities by kernel ridge regression, also out of fold: probes with few degrees of freedom, in closed form.

    K_ij = exp(−‖z_i − z_j‖ / median),   p = μ + k (K + λ W⁻¹)⁻¹ (Y − μ)

z are standardised and clipped inputs, W the weight of each row, μ the weighted mean of the targets Y.
"""

import collections
import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtri

LEVELS = 3
"""K of every ordinal attribute."""

TAIL = 0.002  # least share of the reference beyond a rank
LEAST = 0.02  # least probability of a level: a regression on one-hot targets may leave 0 to 1
FEW = 0.1  # objects that the mean counts for where few others were rated alike
CLIP = 4.0  # standard deviations to which inputs are clipped


@dataclasses.dataclass(frozen=True, kw_only=True)
class KernelProbeConfig:
    """The probes.

    Args:
      families: of numbers, one probe for each family.
      ridge: λ; the kernel's diagonal is 1.
      folds: parts of the training objects; probes fitted on the other parts read each part.
    """

    families: tuple[str, ...]
    ridge: float = 1.0
    folds: int = 10


def object_weights(objects: np.ndarray, chosen: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """1 over the number of chosen videos of the object, 0 for the others: every object counts the same."""
    size = collections.Counter(objects[chosen].tolist())
    return np.array([1 / size[name] if use else 0.0 for name, use in zip(objects, chosen, strict=True)], np.float32)


def probe(
    x: Float[np.ndarray, "n D"],
    target: Float[np.ndarray, "n A K"],
    weight: Float[np.ndarray, "n"],
    family: np.ndarray,
    config: KernelProbeConfig,
) -> Float[np.ndarray, "n M A K"]:
    """Probabilities of every level of every attribute, by each family's probe, for all videos.

    A video of weight 0 is left out of the fit, and its target ignored; `target` holds the probability of each level,
    one-hot where it is certain, and `family` [D] names the family of each number.

    Raises:
      ValueError: no video to fit on, or a family without numbers.
    """
    fit = weight > 0
    if not fit.any():
        raise ValueError("weight is 0 everywhere: a probe needs videos to fit; give the training videos a weight")
    targets = target[fit].reshape(fit.sum(), -1)
    share = weight[fit] / weight[fit].sum()
    found = []
    for name in config.families:
        chosen = family == name
        if not chosen.any():
            raise ValueError(f"families holds {name!r}: must be one of {', '.join(sorted(set(family)))}; correct it")
        z = standardise(x[:, chosen], fit)
        p = np.clip(kernel_ridge(z, fit, share, targets, config.ridge).reshape(len(x), -1, LEVELS), LEAST, 1)
        found.append(p / p.sum(-1, keepdims=True))
    return np.stack(found, 1)


def cross_probe(
    x: Float[np.ndarray, "n D"],
    target: Float[np.ndarray, "n A K"],
    weight: Float[np.ndarray, "n"],
    objects: np.ndarray,
    family: np.ndarray,
    config: KernelProbeConfig,
    seed: int,
) -> Float[np.ndarray, "n M A K"]:
    """As `probe`, but only probes that saw no video of the same object read a video of the fit."""
    found = probe(x, target, weight, family, config)
    names = np.unique(objects[weight > 0])
    order = np.random.default_rng(seed).permutation(len(names))
    for k in range(min(config.folds, len(names))):
        out = np.isin(objects, names[order % config.folds == k]) & (weight > 0)
        found[out] = probe(x, target, np.where(out, 0.0, weight), family, config)[out]
    return found


def graded_targets(
    label: Int[np.ndarray, "n A"],
    rating: Float[np.ndarray, "n A"],
    weight: Float[np.ndarray, "n"],
    objects: np.ndarray,
    *,
    share: float,
    width: float,
) -> Float[np.ndarray, "n A K"]:
    """Targets that mix the label and the probability of each level given people's rating of the object.

        t = (1 − share) onehot(y) + share p,   p_k = (Σ_j w_j g_ij 1[y_j = k] + π μ_k) / (Σ_j w_j g_ij + π)

    over videos j of other objects, with g_ij = exp(−(r_i − r_j)² / 2 width²), π = 0.1 and μ the weighted mean.  A label
    that contradicts the rating has less weight.

    Args:
      label, rating: levels, and ratings on one scale for all objects; a rating of NaN is unknown, its target one-hot.
      weight: w, all of objects that may be learned from.
      objects: [n], the object of each video.
      share: of the ratings in the target, 0 to 1.
      width: of the kernel, in units of the rating.

    Raises:
      ValueError: a video with weight whose level is unknown.
    """
    unknown = np.flatnonzero((weight > 0) & np.any(label < 0, axis=1))
    if len(unknown):
        raise ValueError(f"label[{unknown[0]}] is {label[unknown[0]]}: must be ≥ 0 where weight is; set weight 0 there")
    hard = np.eye(LEVELS)[label]
    target = hard.copy()
    for a in range(label.shape[1]):
        known = np.isfinite(rating[:, a])
        gap = rating[:, None, a] - rating[None, :, a]
        near = np.nan_to_num(np.exp(-0.5 * (gap / width) ** 2)) * weight * (objects[:, None] != objects)
        mean = weight @ hard[:, a] / weight.sum()
        given = (near @ hard[:, a] + FEW * mean) / (near.sum(1, keepdims=True) + FEW)
        target[known, a] = ((1 - share) * hard[:, a] + share * given)[known]
    return target


def kernel_ridge(
    z: Float[np.ndarray, "n D"],
    fit: Bool[np.ndarray, "n"],
    share: Float[np.ndarray, "m"],
    target: Float[np.ndarray, "m T"],
    ridge: float,
) -> Float[np.ndarray, "n T"]:
    """Estimates of all rows of z from the m of `fit`, with weights `share` of sum 1; the formula is the module's."""
    square = (z**2).sum(1)
    distance = np.sqrt(np.maximum(square[:, None] + square[fit] - 2 * z @ z[fit].T, 0))
    median = float(np.median(distance[fit]))
    kernel = np.exp(-distance / (median if median > 0 else 1.0))  # rows that coincide have no scale of their own
    mean = share @ target
    return mean + kernel @ np.linalg.solve(kernel[fit] + ridge * np.diag(share.mean() / share), target - mean)


def ranks(x: Float[np.ndarray, "n D"], among: Float[np.ndarray, "m D"]) -> Float[np.ndarray, "n D"]:
    """Normal quantiles of each number's rank among reference rows, invariant to monotone changes of a number."""
    sorted_ = np.sort(among, 0)
    sides = [[np.searchsorted(sorted_[:, d], x[:, d], side) for d in range(x.shape[1])] for side in ("left", "right")]
    middle = (np.sum(sides, 0).T + 1) / 2 / (len(among) + 1)
    return ndtri(np.clip(middle, TAIL, 1 - TAIL))


def standardise(x: np.ndarray, fit: np.ndarray) -> np.ndarray:
    """x with mean 0 and standard deviation 1 over the rows that are fitted on, within ± `CLIP`."""
    spread = x[fit].std(0)
    return np.clip((x - x[fit].mean(0)) / np.where(spread > 1e-6, spread, 1), -CLIP, CLIP)
