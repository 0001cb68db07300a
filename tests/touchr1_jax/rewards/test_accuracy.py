import pytest

from tests.touchr1_jax.rewards.examples import make_parsed, make_target
from touchr1_jax.rewards.accuracy import accuracy


@pytest.mark.parametrize(
    ("answer", "label", "levels", "earned"),
    [
        (0, 0, 3, 1),
        (1, 0, 3, 0.4),
        (1, 2, 3, 0.4),
        (2, 0, 3, 0),
        (4, 1, 5, 0),
        (-1, 0, 3, -0.1),
        (1, 0, 2, 0),
        (1, 1, 2, 1),
    ],
)
def test_ordinal(answer, label, levels, earned):
    target = make_target(label=(label, 0, 0), levels=(levels, 3, 9))
    assert accuracy(make_parsed((answer, 0, 0)), target) == pytest.approx(earned)


@pytest.mark.parametrize(("answer", "earned"), [(4, 1), (3, 0), (0, 0), (-1, 0)])
def test_categorical(answer, earned):
    assert accuracy(make_parsed((0, 0, answer)), make_target(asked=(0, 0, 1), label=(0, 0, 4))) == earned


def test_several_attributes_earn_the_mean_over_the_asked():
    target = make_target(asked=(1, 1, 1), label=(0, 2, 4))
    assert accuracy(make_parsed((0, 1, -1)), target) == pytest.approx((1 + 0.4 + 0) / 3)
    assert accuracy(make_parsed((0, -1, 4)), target.replace(asked=target.asked.at[2].set(False))) == pytest.approx(0.45)


@pytest.mark.parametrize("answer", [-1, 0, 1])
def test_unknown_label_earns_nothing(answer):
    assert accuracy(make_parsed((answer, 0, 0)), make_target(label=(-1, 0, 0))) == 0
