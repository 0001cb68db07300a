import pytest

from tests.touchr1_jax.rewards.examples import make_parsed, make_target
from touchr1_jax.rewards.exact import exact


@pytest.mark.parametrize(("answer", "earned"), [(1, 1), (0, 0), (2, 0), (-1, -0.1)])
@pytest.mark.parametrize("attribute", [0, 2])
def test_right_or_not(answer, earned, attribute):
    def at(value):
        return tuple(value if a == attribute else 0 for a in range(3))

    assert exact(make_parsed(at(answer)), make_target(asked=at(1), label=at(1))) == pytest.approx(earned)


def test_several_attributes_earn_the_mean_over_the_asked():
    target = make_target(asked=(1, 1, 1), label=(0, 2, 4))
    assert exact(make_parsed((0, 1, -1)), target) == pytest.approx(0.3)


@pytest.mark.parametrize("answer", [-1, 0])
def test_unknown_label_earns_nothing(answer):
    assert exact(make_parsed((answer, 0, 0)), make_target(label=(-1, 0, 0))) == 0
