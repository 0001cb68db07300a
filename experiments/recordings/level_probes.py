"""Level probabilities from a touch: kernel ridge regression on the labels of real objects, read out of fold.

With 60 labelled objects, a probe must have few degrees of freedom (`kernel_probe`).  Regression on the level as a
number, as if level 1 were half of level 2, is five points worse.

The properties of generated scenes are known exactly and cost nothing.  Probes learn them from descriptions of scenes,
and their predictions for a real video are the inputs of the probes above.  Lamps, gels and hands differ between scenes
and real videos, so that only the order of touches within each set is used: numbers are standardised by the mean and
deviation of their own set, or replaced by their ranks.  Hardness is read from standardised numbers and protrusion from
ranks, both by probes of levels; roughness from both, by probes of levels and of physical properties.  Predictions are
means over scenes of several seeds, because the seed changes single answers.
"""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float

from experiments.recordings.descriptions import AuxiliaryData, DescribedVideos
from touchr1_jax.training.kernel_probe import (
    KernelProbeConfig,
    cross_probe,
    graded_targets,
    kernel_ridge,
    object_weights,
    probe,
    ranks,
    standardise,
)

READINGS = ("standardised", "ranked")  # how numbers of the two worlds are made comparable

GROUPS = {
    "all": ("levels", "material", "physics"),
    "named": ("levels", "material"),
    "graded": ("levels", "physics"),
    "levels": ("levels",),
}
"""Groups of the properties of scenes, each read by a probe of its own."""

SCENES = tuple(f"scenes, {reading}, {group}" for reading in READINGS for group in GROUPS)
"""Families of the numbers that scene probes predict."""

BY_ATTRIBUTE = (
    ("scenes, standardised, levels",),
    ("scenes, standardised, graded", "scenes, ranked, graded"),
    ("scenes, ranked, levels",),
)
"""Families by which hardness, roughness and protrusion are read."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelProbeConfig(KernelProbeConfig):
    """The probes; families other than those of the description are the predictions of scene probes."""

    families: tuple[str, ...] = tuple(dict.fromkeys(itertools.chain(*BY_ATTRIBUTE)))
    by_attribute: tuple[tuple[str, ...], ...] = BY_ATTRIBUTE
    """Those of the families by which each attribute is read; (), and all read every attribute."""
    ridge: float = 0.7
    scene_ridge: float = 10.0
    """λ of the scene probes, far above that of the others: they are read on another world than they are fitted on, and
    with λ = 1 the answers about real objects depend on which scenes were drawn.
    """
    rating_share: float = 0.5  # of the ratings in the targets, see `graded_targets`
    rating_width: float = 1.0  # of their kernel, on the scale of 0 to 10


class ProbedVideos:
    """Labelled training videos and others with the predictions of scene probes, as the level probes read them."""

    def __init__(
        self, training: DescribedVideos, auxiliary: AuxiliaryData, videos: DescribedVideos, config: LevelProbeConfig
    ) -> None:
        world = np.concatenate([training.x, auxiliary.unlabelled]).astype(np.float64)
        sensed, names = sense(auxiliary, world, np.concatenate([training.x, videos.x]).astype(np.float64), config)
        both = np.concatenate([np.concatenate([training.x, videos.x]), sensed], 1).astype(np.float64)
        self._fitted, self._others = both[: len(training.x)], both[len(training.x) :]
        self._training, self._config = training, config
        self._family = np.array([*training.families, *names])
        self._weight = object_weights(training.objects, np.ones(len(training.names), bool))
        self.target = graded_targets(
            training.label,
            training.rating,
            self._weight,
            training.objects,
            share=config.rating_share,
            width=config.rating_width,
        )

    def evidence(self) -> Float[np.ndarray, "n A K"]:
        """Predictions for the other videos by probes that were fitted on all training videos."""
        n = len(self._fitted)
        target = np.concatenate([self.target, np.zeros((len(self._others), *self.target.shape[1:]))])
        weight = np.concatenate([self._weight, np.zeros(len(self._others))])
        rows = np.concatenate([self._fitted, self._others])
        return self._mean(probe(rows, target, weight, self._family, self._config)[n:])

    def crossed(self, seed: int) -> Float[np.ndarray, "n A K"]:
        """Predictions for the training videos by probes that were fitted without the object in question."""
        objects = self._training.objects
        found = cross_probe(self._fitted, self.target, self._weight, objects, self._family, self._config, seed)
        return self._mean(found)

    def _mean(self, p: Float[np.ndarray, "n M A K"]) -> Float[np.ndarray, "n A K"]:
        """Mean over the families by which each attribute is read."""
        families, by_attribute = self._config.families, self._config.by_attribute
        chosen = by_attribute or (families,) * p.shape[2]
        of = lambda a: p[:, [families.index(name) for name in chosen[a]], a].mean(1)
        return np.stack([of(a) for a in range(p.shape[2])], 1)


def sense(
    auxiliary: AuxiliaryData, world: Float[np.ndarray, "m D"], x: Float[np.ndarray, "n D"], config: LevelProbeConfig
) -> tuple[Float[np.ndarray, "n T"], list[str]]:
    """Predictions of scene probes for videos, the mean over the sets of scenes, and the family of each number.

    Both worlds are compared by mean and deviation or by rank; those of real videos come from `world`, which needs no
    label.
    """
    chosen, found, names = set(config.families), [], list[str]()
    for reading in READINGS:
        wanted = [group for group in GROUPS if f"scenes, {reading}, {group}" in chosen]
        if not wanted:
            continue
        predicted = np.mean(
            [_predict(s, auxiliary, world, x, reading, config) for s in range(len(auxiliary.scene_x))], 0
        )
        for group in wanted:
            part = predicted[:, np.isin(auxiliary.kinds, GROUPS[group])]
            found.append(part)
            names += [f"scenes, {reading}, {group}"] * part.shape[1]
    return np.concatenate(found, 1) if found else np.zeros((len(x), 0)), names


def _predict(
    number: int, auxiliary: AuxiliaryData, world: np.ndarray, x: np.ndarray, reading: str, config: LevelProbeConfig
) -> Float[np.ndarray, "n T"]:
    """All properties of videos, by a probe of one set of scenes."""
    scenes = auxiliary.scene_x[number].astype(np.float64)
    count, known = len(scenes), np.arange(len(world) + len(x)) < len(world)
    if reading == "ranked":
        made, real = ranks(scenes, scenes), ranks(x, world)
    else:
        made = standardise(scenes, np.ones(count, bool))
        real = standardise(np.concatenate([world, x]), known)[len(world) :]
    both, fit = np.concatenate([made, real]), np.arange(count + len(x)) < count
    share = np.full(count, 1 / count)
    return kernel_ridge(both, fit, share, auxiliary.scene_target[number], config.scene_ridge)[count:]
