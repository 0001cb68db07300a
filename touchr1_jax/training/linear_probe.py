"""Linear probes, and the targets that they give the `perceive` and `compare` slots in supervised fine-tuning.

These slots must not repeat the object's label: cross-sensor consistency would start at 1 and give no gradient.
Instead, a multinomial probe on fixed features of one stream is fitted on the other folds of objects and evaluated on
the held-out fold, so that its levels have the errors of that sensor.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt8

from touchr1_jax.models.frame_statistics import frame_statistics
from touchr1_jax.models.tactile_vit import force_features
from touchr1_jax.validation import above, at_least

ROUNDING = 1e-5  # a spread below this share of the mean is that of a constant feature in float32


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProbeConfig:
    """Out-of-fold multinomial logistic regression with an L2 penalty."""

    folds: int = 5
    penalty: float = 0.03
    iterations: int = 60

    def __post_init__(self) -> None:
        at_least(self, 2, "folds")
        above(self, 0, "penalty")
        at_least(self, 1, "iterations")


@jax.jit
def stream_features(frames: UInt8[Array, "*n F H W 3"], force_n: Float[Array, "*n F 3"]) -> Float[Array, "*n D"]:
    """Fixed summary of one stream: the statistics of each whole frame (`frame_statistics`), and its force."""
    stacked = jnp.concatenate([frame_statistics(frames)[..., 0, :], force_features(force_n)], -1)
    return stacked.reshape(*stacked.shape[:-2], -1)


def probe_log_probs(
    features: Float[np.ndarray, "n D"],
    labels: Int[np.ndarray, "n"],
    weights: Shaped[np.ndarray, "fit n"],
    levels: int,
    config: ProbeConfig,
) -> Float[np.ndarray, "fit n K"]:
    """Log-probabilities of all rows under one multinomial probe per row of weights.

    Args:
      features: one row per example.
      labels: 0 … levels − 1; a row below 0 must have weight 0.
      weights: how much each example counts in each fit; 0 holds it out.
      levels: number of classes K.
      config: penalty and iterations.

    Raises:
      ValueError: a fit without a single weighted row.
    """
    empty = np.flatnonzero(~np.any(weights, axis=1))
    if empty.size:
        raise ValueError(f"weights[{empty[0]}] are all 0: a probe needs rows; label more or use fewer folds")
    fits = [
        _fit_probe(jnp.asarray(features), jnp.maximum(labels, 0), jnp.asarray(w, jnp.float32), levels, config)
        for w in weights
    ]
    return np.asarray(jax.nn.log_softmax(jnp.stack(fits)))


def cross_fit(
    features: Float[np.ndarray, "n D"],
    labels: Int[np.ndarray, "n"],
    groups: np.ndarray,
    levels: int,
    config: ProbeConfig,
) -> Float[np.ndarray, "n K"]:
    """Out-of-fold log-probabilities: each row is read by a probe that was trained on the other folds.

    Args:
      features: one row per example.
      labels: 0 … levels − 1; rows below 0 are read but not trained on.
      groups: identity whose rows stay together in a fold, such as the object.
      levels: number of classes K.
      config: folds and fit.

    Raises:
      ValueError: fewer groups than folds, or a feature that is not finite, which would erase it in all rows.
    """
    odd = np.argwhere(~np.isfinite(features))
    if odd.size:
        (row, column), value = odd[0], features[tuple(odd[0])]
        raise ValueError(f"features[{row}, {column}] is {value}: must be finite; correct the contact or leave it out")
    fold = group_folds(groups, config)
    weights = np.stack([(fold != k) & (labels >= 0) for k in range(config.folds)])
    return probe_log_probs(features, labels, weights, levels, config)[fold, np.arange(len(fold))]


def sensor_evidence(
    features: Float[np.ndarray, "n S D"],
    present: Bool[np.ndarray, "n S"],
    label: Int[np.ndarray, "n A"],
    groups: np.ndarray,
    levels: Sequence[int],
    config: ProbeConfig,
    track: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    read_only: Bool[np.ndarray, "n"] | None = None,
) -> Float[np.ndarray, "n S A K"]:
    """Out-of-fold log-probabilities of each sensor's own probe for every attribute.

    Levels that an attribute lacks have −∞.  A stream that was not recorded gives 0 for every level; so does every
    stream if too few groups have labels of the attribute.

    Args:
      features: of every contact's streams.
      present: whether the stream was recorded.
      label: −1 for unknown.
      groups: identity whose rows stay together in a fold, such as the object.
      levels: K of each attribute.
      config: folds and fit.
      track: passes the (attribute, sensor) pairs through, for example under a progress bar.
      read_only: rows of other groups that no probe is fitted on and that a probe of all other rows reads; none by
        default.
    """
    n, sensors = present.shape
    read_only = np.zeros(n, bool) if read_only is None else read_only
    out = np.full((n, sensors, len(levels), max(levels)), -np.inf, np.float32)
    for a, s in track(itertools.product(range(len(levels)), range(sensors))):
        out[:, s, a, : levels[a]] = 0.0
        known = np.flatnonzero(present[:, s] & (label[:, a] >= 0) & ~read_only)
        if len(np.unique(groups[known])) < config.folds:
            continue
        out[known, s, a, : levels[a]] = cross_fit(features[known, s], label[known, a], groups[known], levels[a], config)
        asked = np.flatnonzero(present[:, s] & read_only)
        if len(asked):
            x = np.concatenate([features[known, s], features[asked, s]])
            fitted, y = np.arange(len(x)) < len(known), np.pad(label[known, a], (0, len(asked)), constant_values=-1)
            out[asked, s, a, : levels[a]] = probe_log_probs(x, y, fitted[None], levels[a], config)[0, len(known) :]
    return out


def group_folds(groups: np.ndarray, config: ProbeConfig, field: str = "groups") -> Int[np.ndarray, "n"]:
    """Fold of each row, 0 … folds − 1, dealt at random to whole groups by a fixed seed.

    Args:
      groups: identity whose rows stay together.
      config: number of folds.
      field: what an error calls the groups.

    Raises:
      ValueError: fewer groups than folds.
    """
    names, group = np.unique(groups, return_inverse=True)
    if len(names) < config.folds:
        raise ValueError(f"{field} has {len(names)} members, fewer than folds = {config.folds}; lower folds")
    return np.random.default_rng(0).permutation(len(names))[group] % config.folds


@functools.partial(jax.jit, static_argnames=("levels", "config"))
def _fit_probe(
    x: Float[Array, "n D"], y: Int[Array, "n"], weight: Float[Array, "n"], levels: int, config: ProbeConfig
) -> Float[Array, "n K"]:
    """Scores of all rows under the W, b that minimise Σ w CE / Σ w + penalty/2 ‖W‖², on standardised features."""
    total = jnp.sum(weight)
    centre = weight @ x / total
    spread = jnp.sqrt(weight @ (x - centre) ** 2 / total)
    varies = spread > ROUNDING * jnp.abs(centre)
    z = jnp.where(varies, (x - centre) / jnp.where(varies, spread, 1.0), 0.0)

    def loss(parameters):
        matrix, bias = parameters
        cost = optax.softmax_cross_entropy_with_integer_labels(z @ matrix + bias, y)
        return jnp.sum(weight * cost) / total + 0.5 * config.penalty * jnp.sum(matrix**2)

    solver = optax.lbfgs()
    value_and_grad = optax.value_and_grad_from_state(loss)

    def body(_, carry):
        parameters, state = carry
        value, grad = value_and_grad(parameters, state=state)
        updates, state = solver.update(grad, state, parameters, value=value, grad=grad, value_fn=loss)
        return optax.apply_updates(parameters, updates), state

    start = (jnp.zeros((x.shape[1], levels)), jnp.zeros(levels))
    (matrix, bias), _ = jax.lax.fori_loop(0, config.iterations, body, (start, solver.init(start)))
    return z @ matrix + bias
