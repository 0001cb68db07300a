"""Probability that the recommended R_tu is paid by chance, or if touch helps: exact, by enumeration.

The G rollouts of a group and the J rollouts of each control have credits 0, .4 or 1; every combination of counts has a
multinomial probability, and `tactile_use.recommended` decides whether it is paid.
"""

import functools
import itertools
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from touchr1_jax.rl.tactile_use import recommended

CREDIT = np.array([0.0, 0.4, 1.0], np.float32)
"""Credits of an ordinal answer."""
HELPED, HINDERED = np.array([0.05, 0.25, 0.70]), np.array([0.22, 0.45, 0.33])
"""The case for which power is reported: probabilities of `CREDIT` with touch, and under a control."""


def credit_odds(
    touch: Float[np.ndarray, "3"],
    control: Float[np.ndarray, "3"],
    *,
    group: int,
    rollouts: int,
    controls: int = 3,
    margin: float,
) -> float:
    """Probability that any rollout of a group earns R_tu, P(∃ i: m_i > 0), with b the largest mean of the controls.

    Args:
      touch: probability of each of `CREDIT` for a rollout with touch.
      control: the same under every control; controls are independent.
      group: G.
      rollouts: J, rollouts of each control.
      controls: number of controls.
      margin: δ.
    """
    own, order, pays = _pays(group, rollouts, margin)
    up_to = np.cumsum(_probability(_spreads(rollouts)[order], control)) ** controls
    largest = np.diff(np.concatenate([[0.0], up_to]))  # equal means share their step of the distribution
    return float(_probability(own, touch) @ pays[:, order] @ largest)


def false_credit(*, group: int, rollouts: int, controls: int = 3, margin: float) -> float:
    """Largest `credit_odds` when touch and controls have one distribution.

    The maximum is over p(1) = .1 … .9 and splits of the rest in tenths.
    """
    shares = itertools.product(np.arange(1, 10) / 10, np.linspace(0, 1, 11))
    splits = [np.array([(1 - p) * (1 - q), (1 - p) * q, p]) for p, q in shares]
    odds = functools.partial(credit_odds, group=group, rollouts=rollouts, controls=controls, margin=margin)
    return max(odds(split, split) for split in splits)


@functools.cache
def _pays(group: int, rollouts: int, margin: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Counts of a group, a control's counts in the order of their means, and true for each pair that is paid."""
    own = _spreads(group)
    earned = np.stack([np.repeat(CREDIT, count) for count in own])
    mean = (_spreads(rollouts) @ CREDIT / rollouts).astype(np.float32)
    pays = _pays_each(jnp.asarray(earned), jnp.asarray(mean), jnp.float32(margin))
    return own, np.argsort(mean, kind="stable"), np.asarray(pays)


@jax.jit
def _pays_each(earned: Float[Array, "n G"], bars: Float[Array, "m"], margin: Float[Array, ""]) -> Array:
    formatted = jnp.ones(earned.shape[1], bool)
    one = lambda own, bar: jnp.any(recommended(own, bar, formatted, margin) > 0)
    return jax.vmap(lambda own: jax.vmap(lambda bar: one(own, bar))(bars))(earned)


def _spreads(n: int) -> Int[np.ndarray, "m 3"]:
    """All counts of the three credits among n rollouts."""
    return np.array([c for c in itertools.product(range(n + 1), repeat=3) if sum(c) == n])


def _probability(count: Int[np.ndarray, "m 3"], p: Float[np.ndarray, "3"]) -> Float[np.ndarray, "m"]:
    """Multinomial probability of the counts."""
    orders = np.array([factorial(sum(c)) / np.prod([factorial(x) for x in c]) for c in count.tolist()])
    return orders * np.prod(p**count, -1)
