import pytest

from tests.touchr1_jax.rewards.examples import constant, make_parsed, make_target
from touchr1_jax.rewards.consistency_gated import consistency_gated


@pytest.mark.parametrize(
    ("conclude", "label", "earned"), [(1, 1, 0.75), (0, 1, 0), (2, 1, 0), (-1, 1, 0), (-1, -1, 0), (1, -1, 0)]
)
def test_counts_only_where_the_answer_is_right(conclude, label, earned):
    parsed = make_parsed(conclude=(conclude, 0, 0), compare=(1, 0, 0), perceive=(0, 1, -1))
    assert consistency_gated(parsed, make_target(label=(label, 0, 0), streams=(1, 1, 0))) == pytest.approx(earned)


def test_attributes_are_gated_one_by_one():
    parsed = constant(1)
    assert consistency_gated(parsed, make_target(asked=(1, 1, 1), label=(1, 0, 1))) == pytest.approx(0.5)
