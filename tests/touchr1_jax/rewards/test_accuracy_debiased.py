import numpy as np
import pytest

from tests.touchr1_jax.rewards.examples import constant, make_parsed, make_target
from touchr1_jax.rewards.accuracy_debiased import accuracy_debiased

UNIFORM = np.array([[1 / 3] * 3 + [0] * 6, [0.5, 0.2, 0.3] + [0] * 6, [1 / 9] * 9])


def one_of_three(level: int, label: int, prior=UNIFORM) -> float:
    return float(accuracy_debiased(prior).value(make_parsed((level, 0, 0)), make_target(label=(label, 0, 0))))


def test_hand_values():
    mean = (1.4 / 3 + 0.6 + 1.4 / 3) / 3
    assert one_of_three(1, 1) == pytest.approx(1 - (0.6 - mean))
    assert one_of_three(0, 0) == pytest.approx(1 - (1.4 / 3 - mean))
    assert one_of_three(2, 1) == pytest.approx(0.4 - (1.4 / 3 - mean))
    assert one_of_three(-1, 1) == pytest.approx(-0.1)
    assert one_of_three(1, -1) == 0


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("attribute", range(3))
def test_every_constant_earns_the_same(attribute, seed):
    levels = (3, 3, 9)[attribute]
    prior = UNIFORM.copy()
    prior[attribute, :levels] = np.random.default_rng(seed).dirichlet(np.ones(levels))
    reward = accuracy_debiased(prior).value
    asked, label = np.eye(3)[attribute], np.zeros(3, int)
    earned = [
        sum(
            prior[attribute, y] * float(reward(constant(level), make_target(asked, np.where(asked, y, label))))
            for y in range(levels)
        )
        for level in range(levels)
    ]
    np.testing.assert_allclose(earned, np.mean(earned), atol=1e-6)
    assert earned[0] > -0.1, "guessing beats saying nothing"


def test_several_attributes_earn_the_mean_over_the_asked():
    value = accuracy_debiased(UNIFORM).value
    parsed, label = make_parsed((0, 1, 4)), (0, 2, 4)
    alone = [float(value(parsed, make_target(np.eye(3)[a], label))) for a in range(3)]
    assert value(parsed, make_target((1, 1, 1), label)) == pytest.approx(np.mean(alone))


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ([0.5, 0.5], r"prior has shape \(2,\): must be \[A, K\]"),
        ([[0.5, 0.5], [0, 0]], r"prior\[1\] is \[0\.0, 0\.0\]: must be ≥ 0 and sum to 1"),
        ([[1.5, -0.5]], r"prior\[0\] is \[1\.5, -0\.5\]: must be ≥ 0"),
        ([[np.nan, 1.0]], r"prior\[0\] is \[nan, 1\.0\]: must be ≥ 0"),
    ],
)
def test_bad_priors_are_named(prior, message):
    with pytest.raises(ValueError, match=message):
        accuracy_debiased(np.array(prior))
