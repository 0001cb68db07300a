"""R_tu by hand, and how often it pays by chance, enumerated."""

import itertools
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.rl.config import Stable
from touchr1_jax.rl.tactile_use import bar, literal, recommended

G, CONTROLS = 8, 3
CREDIT = np.array([0.0, 0.4, 1.0])


def counts(n: int) -> np.ndarray:
    """All ways to spread n rollouts over the three credits, [m, 3]."""
    return np.array([c for c in itertools.product(range(n + 1), repeat=3) if sum(c) == n])


def probability(count: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Multinomial probability of each count."""
    ways = np.array([factorial(sum(c)) / np.prod([factorial(x) for x in c]) for c in count.tolist()])
    return ways * np.prod(p**count, -1)


def table(j: int, margin: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Own counts, control counts, control means, and whether any m_i > 0 for each pair, by the engine's own formula."""
    own, control = counts(G), counts(j)
    rows = jnp.asarray([np.repeat(CREDIT, c) for c in own.tolist()], jnp.float32)
    mean = (control @ CREDIT / j).astype(np.float32)
    pays = jax.vmap(lambda s: jax.vmap(lambda b: jnp.any(recommended(s, b, jnp.ones(G, bool), margin) > 0))(mean))(rows)
    return own, control, mean, np.asarray(pays)


def paid_share(parts, real: np.ndarray, null: np.ndarray, controls: int) -> float:
    """Exact probability that a group earns credit when b is the largest mean of independent controls."""
    own, control, mean, pays = parts
    order = np.argsort(mean, kind="stable")
    up_to = np.cumsum(probability(control[order], null)) ** controls
    # equal means share their step of the distribution function
    largest = np.diff(np.concatenate([[0.0], up_to]))
    return float(probability(own, real) @ pays[:, order] @ largest)


@pytest.fixture(scope="module")
def stable():
    return table(Stable().controls, Stable().tactile_margin)


def test_false_credit_and_power_of_the_stable_preset(stable):
    """Null: answers and controls from one distribution over 0, .4, 1, for every split of what is not right."""
    splits = [
        np.array([(1 - p) * (1 - q), (1 - p) * q, p]) for p in np.arange(1, 10) / 10 for q in np.linspace(0, 1, 11)
    ]
    worst = max(paid_share(stable, p, p, CONTROLS) for p in splits)
    power = paid_share(stable, np.array([0.05, 0.25, 0.70]), np.array([0.22, 0.45, 0.33]), CONTROLS)
    assert worst <= 0.12
    assert worst == pytest.approx(0.086, abs=0.002)
    assert power >= 0.5
    assert power == pytest.approx(0.5115, abs=0.002)


def test_the_literal_margin_is_too_small():
    """At δ = .1 one right answer in eight passes for touch: why the stable preset departs from the paper."""
    parts = table(4, 0.1)
    assert paid_share(parts, np.array([0.9, 0, 0.1]), np.array([0.9, 0, 0.1]), CONTROLS) > 0.15


def test_recommended_by_hand():
    own, ok = jnp.array([1.0, 0.4, 0.0, 1.0]), jnp.array([True, True, True, False])
    np.testing.assert_allclose(recommended(own, jnp.array(0.3), ok, 0.1), [0.7, 0.1, 0, 0], rtol=1e-6)
    assert not recommended(own, jnp.array(0.55), ok, 0.1).any()  # .6 is no lead of .1


def test_literal_by_hand():
    own, right = jnp.array([1.0, 0.4, 0.0, 1.0]), jnp.array([True, False, False, True])
    np.testing.assert_array_equal(literal(own, jnp.array(0.3), right, 0.1), [1, 0, 0, 1])


def test_nothing_right_earns_nothing():
    """Video-R1's bonus for correct frames' order is paid at zero accuracy; this one cannot be."""
    zero = jnp.zeros(4)
    assert not recommended(zero, jnp.array(0.0), jnp.ones(4, bool), 0.1).any()
    assert not literal(zero, jnp.array(0.0), jnp.zeros(4, bool), 0.1).any()


def test_the_bar_is_the_best_control_that_counts():
    control = jnp.array([[0.0, 0.4], [1.0, 1.0], [0.0, 0.0]])
    assert bar(control, jnp.array([True, False, True])) == pytest.approx(0.2)
    assert bar(control, jnp.array([True, True, True])) == 1
    assert bar(control, jnp.zeros(3, bool)) == 1  # nothing passes where no control could be made
