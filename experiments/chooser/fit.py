"""The chooser's law, fitted: least squares of the logarithm of the error, then a margin that makes it a promise."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.optimize import least_squares

from experiments.chooser.bench import Outcomes
from sensors_io.scenes import chooser
from sensors_io.scenes.chooser import SLACK, Law, Setting

RANGE = (5e-3, 0.6)
"""Errors that the law is fitted to: what anyone asks for, and some more."""

KEPT = 0.97
"""Share of the fitted scenes that keep the promise at every error asked for: more than the 95 % of the promise itself,
for scenes that the law has not seen."""

_MARGINS = np.geomspace(0.5, 20, 300)
_RIDGE = 0.03  # of a coefficient of 1 against one residual of 1


def fit(outcomes: Outcomes, menu: tuple[Setting, ...], asked: Sequence[float], start: Law = chooser.LAW) -> Law:
    """Fit the law to measured errors.

    Raises:
      ValueError: no margin keeps the promise.
    """
    error = outcomes.errors.max(-1)
    counts = (error > RANGE[0]) & (error < RANGE[1])
    theta, unravel = ravel_pytree(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), start))

    def residual(theta: jax.Array) -> jax.Array:
        law = unravel(theta)
        predicted = jax.vmap(lambda s: chooser.log_error(s, law, menu))(outcomes.survey)
        return jnp.concatenate([(predicted - np.log(error))[counts], _RIDGE * theta])

    jacobian = jax.jit(jax.jacfwd(residual))
    found = least_squares(
        lambda t: np.asarray(residual(t), np.float64),
        np.asarray(theta, np.float64),
        jac=lambda t: np.asarray(jacobian(t), np.float64),
        loss="soft_l1",
        f_scale=0.5,
    )
    law = unravel(jnp.asarray(found.x, jnp.float32))
    return dataclasses.replace(law, margin=jnp.float32(least_margin(predict(law, outcomes, menu), error, asked)))


def predict(law: Law, outcomes: Outcomes, menu: tuple[Setting, ...]) -> np.ndarray:
    """ê of every scene and setting, [S, T]."""
    return np.exp(np.asarray(jax.vmap(lambda s: chooser.log_error(s, law, menu))(outcomes.survey)))


def least_margin(predicted: np.ndarray, error: np.ndarray, asked: Sequence[float]) -> float:
    """The least factor on ê with which enough scenes keep their promise at every error asked for."""
    for margin in _MARGINS:
        if all(kept_share(margin * predicted, error, a) >= KEPT for a in asked):
            return float(margin)
    raise ValueError(f"no margin up to {_MARGINS[-1]} keeps {KEPT:.0%} of the promises: the law does not fit")


def kept_share(promised: np.ndarray, error: np.ndarray, asked: float) -> float:
    """Share of the scenes promised to be met whose chosen setting errs by at most 1.5 times the error asked for."""
    index, met = chosen(promised, asked)
    kept = error[np.arange(len(error)), index] <= SLACK * asked
    return float(kept[met].mean()) if met.any() else 1.0


def chosen(promised: np.ndarray, asked: float) -> tuple[np.ndarray, np.ndarray]:
    """`chooser.pick` of every scene, on the host."""
    keeps = promised <= SLACK * asked
    met = np.any(keeps, 1)
    return np.where(met, keeps.argmax(1), promised.argmin(1)), np.asarray(met)
