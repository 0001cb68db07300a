"""Fit of the chooser's law: least squares of the logarithm of the error, then the margins of its promise."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.optimize import least_squares

from sensors_io.scenes.chooser_law import EASY_ABOVE, SLACK, Law, Setting, Survey, log_error, margin_at
from sensors_io.scenes.chooser_survey import FEATURES

RANGE = (2e-3, 0.6)
"""Errors that the law is fitted to: those that anyone requests and some more; the reference is good to about 1e-3."""

KEPT = 0.975
"""Share of the scenes that keep the promise at every requested error when the margins are chosen: more than the 95 % of
the promise itself, for unseen scenes."""

_MARGINS = np.geomspace(0.5, 20, 300)
_EASES = np.linspace(0, 0.3, 31)
_RIDGE = 0.06  # of a coefficient of 1 against one residual of 1
_OUTLIER = 0.3  # residual, in ln ê, from which on it counts linearly


def start() -> Law:
    """The initial law of a fit: every part falls with the grid as Hertz's slope does, whatever the scene."""
    first = np.eye(len(FEATURES))[0]
    return Law(
        grid=-2 * first,
        rate=-first,
        bend=0 * first,
        stop=np.append(0 * first, [0.0, 0.7]),
        wrap=np.array([-1.3, -0.7, 0.0, 0.0, 0.0]),
        margin=np.ones(()),
        ease=np.zeros(()),
        doubt=np.ones(()),
    )


def fit(survey: Survey, errors: np.ndarray, menu: tuple[Setting, ...]) -> Law:
    """Fit the law's coefficients to the surveys and measured errors [S, T] of S scenes; its margins are left at 1."""
    counts = (errors > RANGE[0]) & (errors < RANGE[1])
    theta, unravel = ravel_pytree(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), start()))
    where, logs = np.nonzero(counts.ravel())[0], np.log(errors[counts])

    def residual(theta: jax.Array) -> jax.Array:
        predicted = log_error(survey, unravel(theta), menu)
        return jnp.concatenate([predicted.ravel()[where] - logs, _RIDGE * (theta - begin)])

    begin, jacobian = theta, jax.jit(jax.jacfwd(residual))
    residual = jax.jit(residual)
    found = least_squares(
        lambda t: np.asarray(residual(t), np.float64),
        np.asarray(theta, np.float64),
        jac=lambda t: np.asarray(jacobian(t), np.float64),
        loss="soft_l1",
        f_scale=_OUTLIER,
    )
    return jax.tree.map(np.asarray, unravel(jnp.asarray(found.x, jnp.float32)))


def predict(law: Law, survey: Survey, menu: tuple[Setting, ...]) -> np.ndarray:
    """ê of every scene and setting, [S, T]."""
    return np.exp(np.asarray(log_error(survey, law, menu)))


def promised(law: Law, predicted: np.ndarray, errors: np.ndarray, asked: Sequence[float]) -> Law:
    """The law with the least margins that keep enough promises at every requested error.

    The margin is that of the smallest errors, the ease the greatest that still keeps enough, the doubt the greatest
    that flags no more scenes than no setting meets, over all requested errors.

    Raises:
      ValueError: no margin keeps the promise.
    """

    def keeps(law: Law, asked: Sequence[float]) -> bool:
        return all(_kept_share(law, predicted, errors, a) >= KEPT for a in asked)

    def flags(law: Law) -> int:
        return int(sum((~chosen(law, predicted, a)[1]).sum() for a in asked))

    with_margin = lambda law, **parts: dataclasses.replace(law, **{k: np.asarray(v) for k, v in parts.items()})
    hard = [a for a in asked if a <= EASY_ABOVE] or list(asked)
    sure = next((each for m in _MARGINS if keeps(each := with_margin(law, margin=m, doubt=m), hard)), None)
    if sure is None:
        raise ValueError(f"no margin up to {_MARGINS[-1]} keeps {KEPT:.1%} of the promises: the law does not fit")
    law = next((each for e in _EASES[::-1] if keeps(each := with_margin(sure, ease=e), asked)), sure)
    unreachable = sum(int((errors > a).all(1).sum()) for a in asked)
    doubted = [with_margin(law, doubt=d) for d in _MARGINS[::-1] if d <= law.margin]
    return next((each for each in doubted if flags(each) <= unreachable), doubted[-1])


def _kept_share(law: Law, predicted: np.ndarray, errors: np.ndarray, asked: float) -> float:
    """Share of the scenes promised to be met whose chosen setting errs by at most 1.5 times the requested error."""
    index, met = chosen(law, predicted, asked)
    kept = errors[np.arange(len(errors)), index] <= SLACK * asked
    return float(kept[met].mean()) if met.any() else 1.0


def chosen(law: Law, predicted: np.ndarray, asked: float) -> tuple[np.ndarray, np.ndarray]:
    """Index of the setting and whether it is promised for every scene: `chooser_law.pick` on the host."""
    enough = float(margin_at(asked, law)) * predicted <= SLACK * asked
    index = np.where(enough.any(1), enough.argmax(1), predicted.argmin(1))
    return index, np.asarray(law.doubt * predicted.min(1) <= SLACK * asked)
