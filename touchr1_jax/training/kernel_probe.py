"""Level probabilities by kernel ridge regression, also out of fold: probes with few degrees of freedom, in closed form.

    K_ij = exp(−‖z_i − z_j‖ / median),   p = μ + k (K + λ W⁻¹)⁻¹ (Y − μ)

z are standardised and clipped inputs, W the weight of each row, μ the weighted mean of the one-hot targets Y.
"""

import collections
import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

LEVELS = 3
"""K of every ordinal attribute."""

LEAST = 0.02  # least probability of a level: a regression on one-hot targets may leave 0 to 1
CLIP = 4.0  # standard deviations to which inputs are clipped


@dataclasses.dataclass(frozen=True, kw_only=True)
class KernelProbeConfig:
    """The probes.

    Args:
      families: of numbers, each with a probe of its own.
      ridge: λ; the kernel's diagonal is 1.
      folds: parts of the training objects, each read by probes on the others.
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
    label: Int[np.ndarray, "n A"],
    weight: Float[np.ndarray, "n"],
    family: np.ndarray,
    config: KernelProbeConfig,
) -> Float[np.ndarray, "n M A K"]:
    """Probabilities of every level of every attribute, by each family's probe, for all videos.

    A video of weight 0 is left out of the fit, and its label ignored; `family` [D] names the family of each number.

    Raises:
      ValueError: no video to fit on, or a family without numbers.
    """
    fit = weight > 0
    if not fit.any():
        raise ValueError("weight is 0 everywhere: a probe needs videos to fit; give the training videos a weight")
    targets = np.eye(LEVELS)[label[fit]].reshape(fit.sum(), -1)
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
    label: Int[np.ndarray, "n A"],
    weight: Float[np.ndarray, "n"],
    objects: np.ndarray,
    family: np.ndarray,
    config: KernelProbeConfig,
    seed: int,
) -> Float[np.ndarray, "n M A K"]:
    """As `probe`, but a video of the fit is read by probes that saw no video of its object."""
    found = probe(x, label, weight, family, config)
    names = np.unique(objects[weight > 0])
    order = np.random.default_rng(seed).permutation(len(names))
    for k in range(min(config.folds, len(names))):
        out = np.isin(objects, names[order % config.folds == k]) & (weight > 0)
        found[out] = probe(x, label, np.where(out, 0.0, weight), family, config)[out]
    return found


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


def standardise(x: np.ndarray, fit: np.ndarray) -> np.ndarray:
    """x with mean 0 and standard deviation 1 over the rows that are fitted on, within ± `CLIP`."""
    spread = x[fit].std(0)
    return np.clip((x - x[fit].mean(0)) / np.where(spread > 1e-6, spread, 1), -CLIP, CLIP)
