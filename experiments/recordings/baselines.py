"""Answers without touch, by logistic regression on hand features, and by what people said of the objects."""

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize
from scipy.special import log_softmax, softmax

from experiments.recordings.cross_validation import joint_log_prob
from experiments.recordings.descriptions import DescribedVideos
from touchr1_jax.models.description_policy import COMBINATIONS, LEVELS
from touchr1_jax.training.kernel_probe import object_weights, standardise

PENALTY = 100.0  # λ of the logistic regression, chosen from 10, 100 and 1000 on other partitions


def constants(
    label: Int[np.ndarray, "n A"], objects: np.ndarray, fold: Int[np.ndarray, "n"]
) -> dict[str, Int[np.ndarray, "n A"]]:
    """Answers without touch: per attribute and joint mode of the training objects of each fold."""
    answers = {name: np.zeros_like(label) for name in ("constant, each attribute's mode", "constant, joint mode")}
    for k in np.unique(fold):
        weight = object_weights(objects, fold != k)
        each = [np.bincount(label[:, a], weight, LEVELS).argmax() for a in range(label.shape[1])]
        joint = np.bincount((label * LEVELS ** np.arange(label.shape[1])[::-1]).sum(1), weight, len(COMBINATIONS))
        for rows, level in zip(answers.values(), (each, COMBINATIONS[joint.argmax()]), strict=True):
            rows[fold == k] = level
    return answers


def logistic(videos: DescribedVideos, fold: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 27"]:
    """Log-probabilities by multinomial logistic regression on the description, one for each attribute and fold.

    The description (`sensors_io.touches`) holds the hand features: texture by octave, edges, contact area, and growth,
    motion and decay over the video.
    """
    found = np.zeros((*videos.label.shape, LEVELS))
    for k in np.unique(fold):
        fit = fold != k
        z, weight = standardise(videos.x.astype(np.float64), fit), object_weights(videos.objects, fit)[fit]
        for a in range(videos.label.shape[1]):
            coefficient = _fit(z[fit], np.eye(LEVELS)[videos.label[fit, a]], weight / weight.mean())
            found[~fit, a] = softmax(z[~fit] @ coefficient[:-1] + coefficient[-1], -1)
    return joint_log_prob(found, sharpness=1.0)


def _fit(z: np.ndarray, target: np.ndarray, weight: np.ndarray) -> Float[np.ndarray, "D+1 K"]:
    """Coefficients and, last, intercepts that minimise Σ w CE + λ/2 ‖coefficients‖²."""
    shape = (z.shape[1] + 1, LEVELS)

    def loss(flat: np.ndarray) -> tuple[float, np.ndarray]:
        b = flat.reshape(shape)
        log = log_softmax(z @ b[:-1] + b[-1], -1)
        error = weight[:, None] * (np.exp(log) - target)
        slope = np.concatenate([z.T @ error + PENALTY * b[:-1], error.sum(0, keepdims=True)])
        return -(weight[:, None] * target * log).sum() + PENALTY / 2 * (b[:-1] ** 2).sum(), slope.ravel()

    return minimize(loss, np.zeros(shape).ravel(), jac=True, method="L-BFGS-B").x.reshape(shape)


def people(videos: DescribedVideos) -> dict[int, Int[np.ndarray, "n"]]:
    """Levels of each rated attribute by the ratings, cut at two thresholds that fit all other objects best.

    Keys are positions of attributes; those that nobody rated are missing, and so are all if there are no ratings.
    """
    names, first = np.unique(videos.objects, return_index=True)
    member = np.searchsorted(names, videos.objects)
    found = {}
    for a in range(videos.label.shape[1]):
        rating, level = videos.rating[first, a], videos.label[first, a]
        if not np.isfinite(rating).all():
            continue
        at = np.unique(rating)
        cuts = [(low, high) for i, low in enumerate(at) for high in at[i:]]
        cut = np.array([(rating >= low).astype(int) + (rating >= high) for low, high in cuts])
        right = cut == level
        others = right.sum(1)[:, None] - right
        best = others == others.max(0)
        middle = [int(np.median(cut[best[:, i], i])) for i in range(len(names))]
        found[a] = np.array(middle)[member]
    return found
