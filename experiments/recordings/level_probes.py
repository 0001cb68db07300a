"""Level probabilities from a touch: kernel ridge regression on the labels of real objects, read out of fold.

With 60 labelled objects a probe must have few degrees of freedom (`kernel_probe`).  To regress the level itself, as if
one were half of two, is five points worse.

The properties of generated scenes are known exactly and cost nothing.  Probes learn them from the same description, and
their predictions for a real video are further inputs of the probes above.  Scenes and videos are standardised each by
their own mean and deviation: lamps, gels and hands differ, so only the order of touches within each world is used.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from experiments.recordings.descriptions import AuxiliaryData, DescribedVideos
from sensors_io.touches import families
from touchr1_jax.training.kernel_probe import (
    KernelProbeConfig,
    cross_probe,
    kernel_ridge,
    object_weights,
    probe,
    standardise,
)

SCENES = "scenes"  # family of the numbers that scene probes predict


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelProbeConfig(KernelProbeConfig):
    """The probes; the family `scenes` are the predictions of scene probes, and `scene_ridge` is the λ of these.

    It is ten times that of the others: they are read on another world than they are fitted on, and with λ = 1 the
    answers about real objects depend on which scenes were drawn.
    """

    families: tuple[str, ...] = (SCENES,)
    scene_ridge: float = 10.0


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
