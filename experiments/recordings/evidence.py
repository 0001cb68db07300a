"""Level probabilities from a touch: kernel ridge regression on the labels of real objects, read out of fold.

With 60 objects to learn from, what is learned must be little; in closed form, with targets Y,

    K_ij = exp(−‖z_i − z_j‖ / median),   p = μ + k (K + λ W⁻¹)⁻¹ (Y − μ)

z standardised on the fitted videos and clipped, W the weight of each video, μ the weighted mean, Y one-hot.  To regress
the level itself, as if one were half of two, is five points worse.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.recordings.policy import LEVELS

LEAST = 0.02
"""Probability below which no level is held to be: a regression on one-hot targets may leave 0 to 1."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvidenceConfig:
    """The probes.

    Args:
      families: of numbers, each with a probe of its own; `scenes` is what scenes teach of a touch.
      ridge: λ; the kernel's diagonal is 1.
      scene_ridge: λ of the probes that learn from scenes.  Ten times that of the others: they are read on another
        world than they are fitted on, and with λ = 1 the answers about real objects hang on which scenes were drawn.
      clip: standard deviations beyond which a number says no more.
      folds: parts of the training objects, each read by probes on the others.
    """

    families: tuple[str, ...] = ("scenes",)
    ridge: float = 1.0
    scene_ridge: float = 10.0
    clip: float = 4.0
    folds: int = 10


def probe(
    x: Float[np.ndarray, "n D"],
    label: Int[np.ndarray, "n A"],
    weight: Float[np.ndarray, "n"],
    family: np.ndarray,
    config: EvidenceConfig,
) -> Float[np.ndarray, "n M A K"]:
    """Probabilities of every level of every attribute, by each family's probe, for all videos.

    Args:
      x: descriptions.
      label: levels; those of videos with weight 0 are not looked at.
      weight: of each video in the fit, 0 holds it out.
      family: name of the family of each of the D numbers.
      config: the probes.

    Raises:
      ValueError: no video to fit on, or a family without numbers.
    """
    fit = weight > 0
    if not fit.any():
        raise ValueError("weight is 0 everywhere: a probe needs videos to fit; give the training videos a weight")
    targets = np.eye(LEVELS)[label[fit]].reshape(fit.sum(), -1)
    share = weight[fit] / weight[fit].sum()
    said = []
    for name in config.families:
        chosen = family == name
        if not chosen.any():
            raise ValueError(f"families holds {name!r}: must be one of {', '.join(sorted(set(family)))}; correct it")
        z = standardise(x[:, chosen], fit, config.clip)
        estimate = kernel_ridge(z, fit, share, targets, config.ridge).reshape(len(x), -1, LEVELS)
        p = np.clip(estimate, LEAST, 1)
        said.append(p / p.sum(-1, keepdims=True))
    return np.stack(said, 1)


def cross_probe(
    x: Float[np.ndarray, "n D"],
    label: Int[np.ndarray, "n A"],
    weight: Float[np.ndarray, "n"],
    objects: np.ndarray,
    family: np.ndarray,
    config: EvidenceConfig,
    seed: int,
) -> Float[np.ndarray, "n M A K"]:
    """As `probe`, but a video that is fitted on is read by probes that saw no video of its object."""
    said = probe(x, label, weight, family, config)
    names = np.unique(objects[weight > 0])
    order = np.random.default_rng(seed).permutation(len(names))
    for k in range(min(config.folds, len(names))):
        held = np.isin(objects, names[order % config.folds == k]) & (weight > 0)
        said[held] = probe(x, label, np.where(held, 0.0, weight), family, config)[held]
    return said


def kernel_ridge(
    z: Float[np.ndarray, "n D"],
    fit: Bool[np.ndarray, "n"],
    share: Float[np.ndarray, "m"],
    target: Float[np.ndarray, "m T"],
    ridge: float,
) -> Float[np.ndarray, "n T"]:
    """Estimates of all rows from the m that are fitted on; see the module.

    Args:
      z: standardised inputs.
      fit: which rows are fitted on.
      share: their weights, of sum 1.
      target: their targets.
      ridge: λ.
    """
    square = (z**2).sum(1)
    distance = np.sqrt(np.maximum(square[:, None] + square[fit] - 2 * z @ z[fit].T, 0))
    median = float(np.median(distance[fit]))
    kernel = np.exp(-distance / (median if median > 0 else 1.0))  # rows that coincide have no scale of their own
    mean = share @ target
    return mean + kernel @ np.linalg.solve(kernel[fit] + ridge * np.diag(share.mean() / share), target - mean)


def standardise(x: np.ndarray, fit: np.ndarray, clip: float) -> np.ndarray:
    """x with mean 0 and standard deviation 1 over the videos that are fitted on, within ± clip."""
    spread = x[fit].std(0)
    return np.clip((x - x[fit].mean(0)) / np.where(spread > 1e-6, spread, 1), -clip, clip)
