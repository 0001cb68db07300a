import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.rewards.examples import constant, make_parsed, make_target
from touchr1_jax.rewards.consistency import consistency, consistency_applies


@pytest.mark.parametrize(
    ("perceive", "compare", "streams", "earned"),
    [
        ((0, 0, 0), 0, (1, 1, 1), 1),
        ((0, 1, 2), 1, (1, 1, 1), 1 - (0.5 + 0 + 0.5) / 3),
        ((0, 2, 2), 0, (1, 1, 1), 1 - 2 / 3),
        ((0, 1, -1), 1, (1, 1, 0), 1 - 0.5 * 0.5),
        ((2, 2, 2), 0, (1, 1, 0), 0),
        ((0, -1, 0), 0, (1, 1, 1), 0),
        ((0, 0, 0), -1, (1, 1, 1), 0),
        ((-1, -1, -1), -1, (1, 1, 1), 0),
    ],
)
def test_hand_values(perceive, compare, streams, earned):
    parsed = make_parsed(compare=(compare, -1, -1), perceive=perceive)
    assert consistency(parsed, make_target(streams=streams)) == pytest.approx(earned)


@pytest.mark.parametrize(("levels", "earned"), [(2, 0.5), (5, 1 - 1 / 8)])
def test_disagreement_is_measured_in_the_range_of_levels(levels, earned):
    parsed = make_parsed(compare=(1, -1, -1), perceive=(0, 1, -1))
    target = make_target(levels=(levels, 3, 9), streams=(1, 1, 0))
    assert consistency(parsed, target) == pytest.approx(earned)


def test_mean_over_the_asked_ordinal_attributes():
    parsed = constant(1).replace(compare=jnp.array([1, 0, 8]))
    assert consistency(parsed, make_target(asked=(1, 1, 1))) == pytest.approx((1 + 0.5) / 2)


@pytest.mark.parametrize(
    ("asked", "streams", "applies"),
    [
        ((1, 0, 0), (1, 1, 0), True),
        ((1, 0, 0), (0, 1, 0), False),
        ((1, 0, 0), (0, 0, 0), False),
        ((0, 0, 1), (1, 1, 1), False),
        ((0, 1, 1), (1, 1, 1), True),
    ],
)
def test_defined_for_two_sensors_and_an_ordinal_attribute(asked, streams, applies):
    assert consistency_applies(make_target(asked=asked, streams=streams)) == applies
    assert np.isfinite(consistency(constant(1), make_target(asked=asked, streams=streams)))
