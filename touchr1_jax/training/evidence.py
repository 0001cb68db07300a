"""What each sensor's own evidence says: the targets of the `perceive` and `compare` slots in supervised fine-tuning.

The slots must not repeat the object's label: then cross-sensor consistency would start at 1 and could teach nothing.  A
multinomial probe on fixed features of one stream is fitted on the other folds of objects and read on the held-out fold,
so that its answers are as fallible as that sensor is.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, UInt8

from touchr1_jax.models.tactile_vit import force_features

TINY = 1e-4  # keeps log(energy) of a constant image finite; energies are in units of full scale


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProbeConfig:
    """Out-of-fold multinomial logistic regression with an L2 penalty."""

    folds: int = 5
    penalty: float = 0.03
    iterations: int = 60


@jax.jit
def stream_features(frames: UInt8[Array, "*n F H W 3"], force_n: Float[Array, "*n F 3"]) -> Float[Array, "*n D"]:
    """Fixed summary of one stream: how much each frame changed, at which scales it has gradients, and its force.

    Per frame and channel: mean, mean absolute and spread of the change since the first frame, and the logarithm of the
    mean absolute gradient at pixel and at 4-pixel scale, with its change since the first frame.
    """
    x = frames.astype(jnp.float32) / 255.0
    change = x - x[..., :1, :, :, :]
    over = (-3, -2)
    *lead, h, w, c = x.shape
    coarse = x.reshape(*lead, h // 4, 4, w // 4, 4, c).mean((-4, -2))
    fine_energy, coarse_energy = _gradient_energy(x), _gradient_energy(coarse)
    parts = [
        change.mean(over),
        jnp.log(jnp.abs(change).mean(over) + TINY),
        jnp.log(change.std(over) + TINY),
        fine_energy,
        coarse_energy,
        fine_energy - fine_energy[..., :1, :],
        coarse_energy - coarse_energy[..., :1, :],
    ]
    stacked = jnp.concatenate([*parts, force_features(force_n)], -1)
    return stacked.reshape(*stacked.shape[:-2], -1)


def cross_fit(
    features: Float[np.ndarray, "n D"], labels: Int[np.ndarray, "n"], groups: np.ndarray, levels: int, config: ProbeConfig
) -> Int[np.ndarray, "n"]:
    """Level that a probe trained on the other folds gives each row; folds are made of whole groups.

    Args:
      features: one row per example.
      labels: 0 … levels − 1; rows below 0 are predicted but not trained on.
      groups: identity whose rows stay together, such as the object.
      levels: number of classes.
      config: folds and fit.

    Raises:
      ValueError: fewer groups than folds.
    """
    names, group = np.unique(groups, return_inverse=True)
    if len(names) < config.folds:
        raise ValueError(f"groups has {len(names)} members, fewer than folds = {config.folds}; lower folds")
    fold = np.random.default_rng(0).permutation(len(names))[group] % config.folds
    weights = np.stack([(fold != k) & (labels >= 0) for k in range(config.folds)]).astype(np.float32)
    rows, targets = jnp.asarray(features), jnp.maximum(jnp.asarray(labels), 0)
    fit = jax.vmap(lambda w: _fit_probe(rows, targets, w, levels, config))
    scores = jax.jit(fit)(jnp.asarray(weights))
    return np.asarray(jnp.argmax(scores, -1))[fold, np.arange(len(fold))]


def _fit_probe(
    x: Float[Array, "n D"], y: Int[Array, "n"], weight: Float[Array, "n"], levels: int, config: ProbeConfig
) -> Float[Array, "n K"]:
    """Scores of all rows under W, b that minimise Σ w CE / Σ w + penalty/2 ‖W‖², features standardised by the weighted rows."""
    total = jnp.sum(weight)
    centre = weight @ x / total
    spread = jnp.sqrt(weight @ (x - centre) ** 2 / total)
    z = (x - centre) / jnp.where(spread > 0, spread, 1.0)

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


def _gradient_energy(x: Float[Array, "*n h w c"]) -> Float[Array, "*n c"]:
    vertical = jnp.abs(jnp.diff(x, axis=-3)).mean((-3, -2))
    horizontal = jnp.abs(jnp.diff(x, axis=-2)).mean((-3, -2))
    return jnp.log(vertical + horizontal + TINY)
