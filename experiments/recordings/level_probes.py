"""Level probabilities from a touch: kernel ridge regression on the labels of real objects, read out of fold.

With 60 labelled objects a probe must have few degrees of freedom; in closed form, with targets Y,

    K_ij = exp(−‖z_i − z_j‖ / median),   p = μ + k (K + λ W⁻¹)⁻¹ (Y − μ)

z standardised on the fitted videos and clipped, W the weight of each video, μ the weighted mean, Y one-hot.  To regress
the level itself, as if one were half of two, is five points worse.

The properties of generated scenes are known exactly and cost nothing.  Probes learn them from the same description, and
their predictions for a real video are further inputs of the probes above.  Scenes and videos are standardised each by
their own mean and deviation: lamps, gels and hands differ, so only the order of touches within each world is used.
"""

import collections
import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.recordings.description_policy import LEVELS
from experiments.recordings.descriptions import AuxiliaryData, DescribedVideos
from experiments.recordings.touches import families

LEAST = 0.02  # least probability of a level: a regression on one-hot targets may leave 0 to 1
CLIP = 4.0  # standard deviations to which inputs are clipped
SCENES = "scenes"  # family of the numbers that scene probes predict


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelProbeConfig:
    """The probes.

    Args:
      families: of numbers, each with a probe of its own; `scenes` are the predictions of scene probes.
      ridge: λ; the kernel's diagonal is 1.
      scene_ridge: λ of the probes that learn from scenes.  Ten times that of the others: they are read on another
        world than they are fitted on, and with λ = 1 the answers about real objects depend on which scenes were drawn.
      folds: parts of the training objects, each read by probes on the others.
    """

    families: tuple[str, ...] = (SCENES,)
    ridge: float = 1.0
    scene_ridge: float = 10.0
    folds: int = 10


class ProbedVideos:
    """Labelled training videos and others with the predictions of scene probes, as the level probes read them."""

    def __init__(
        self, training: DescribedVideos, auxiliary: AuxiliaryData, videos: DescribedVideos, config: LevelProbeConfig
    ) -> None:
        world = np.concatenate([training.x, auxiliary.unlabelled])
        widen = lambda x: np.concatenate([x, sense(auxiliary, world, x, config)], 1).astype(np.float64)
        self.fitted, self.others = widen(training.x), widen(videos.x)
        self._training, self._config = training, config
        self._family = np.array([*families(), *[SCENES] * (self.fitted.shape[1] - training.x.shape[1])])
        self._weight = object_weights(training.objects, np.ones(len(training.names), bool))

    def evidence(self) -> Float[np.ndarray, "n M A K"]:
        """Predictions for the other videos by probes that were fitted on all training videos."""
        n, label = len(self.fitted), self._training.label
        label = np.concatenate([label, np.zeros((len(self.others), label.shape[1]), np.int32)])
        weight = np.concatenate([self._weight, np.zeros(len(self.others))])
        return probe(np.concatenate([self.fitted, self.others]), label, weight, self._family, self._config)[n:]

    def crossed(self, seed: int) -> Float[np.ndarray, "n M A K"]:
        """Predictions for the training videos by probes that were fitted without the object in question."""
        t = self._training
        return cross_probe(self.fitted, t.label, self._weight, t.objects, self._family, self._config, seed)


def object_weights(objects: np.ndarray, chosen: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """1 over the number of chosen videos of the object, 0 for the others: every object counts the same."""
    size = collections.Counter(objects[chosen].tolist())
    return np.array([1 / size[name] if use else 0.0 for name, use in zip(objects, chosen, strict=True)], np.float32)


def probe(
    x: Float[np.ndarray, "n D"],
    label: Int[np.ndarray, "n A"],
    weight: Float[np.ndarray, "n"],
    family: np.ndarray,
    config: LevelProbeConfig,
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
    config: LevelProbeConfig,
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


def sense(
    auxiliary: AuxiliaryData, world: Float[np.ndarray, "m D"], x: Float[np.ndarray, "n D"], config: LevelProbeConfig
) -> Float[np.ndarray, "n T"]:
    """Predictions of scene probes for videos: each level of hardness, roughness and protrusion, and each material.

    `x` is standardised by mean and deviation of the descriptions of real videos in `world`, which need no label.
    """
    count = len(auxiliary.scene_x)
    known = np.arange(len(world) + len(x)) < len(world)
    real = standardise(np.concatenate([world, x]).astype(np.float64), known)[len(world) :]
    made = standardise(auxiliary.scene_x.astype(np.float64), np.ones(count, bool))
    both, fit = np.concatenate([made, real]), np.arange(count + len(x)) < count
    return kernel_ridge(both, fit, np.full(count, 1 / count), auxiliary.scene_target, config.scene_ridge)[count:]


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
