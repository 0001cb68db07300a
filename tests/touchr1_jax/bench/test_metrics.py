"""Metrics by hand values, and the identities that hold between them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from touchr1_jax.bench import metrics
from touchr1_jax.bench.metrics import METRICS, Answers, evaluate

LEVELS = np.array([3, 3, 3])


def test_accuracy_counts_bottom_as_wrong_and_skips_unscored_labels():
    scores = metrics.accuracy(np.array([0, -1, 2, -1]), np.array([0, 1, 1, -1]))
    assert scores.mean() == pytest.approx(100 / 3)
    assert scores.items.tolist() == [0, 1, 2]


def test_balanced_accuracy_weighs_the_levels_alike():
    label = np.array([0, 0, 0, 1])
    assert metrics.accuracy(np.zeros(4, int), label).mean() == 75.0
    assert metrics.balanced_accuracy(np.zeros(4, int), label).mean() == 50.0


def test_mean_accuracy_weighs_the_attributes_alike():
    label = np.array([[0, 0], [0, -1], [0, -1]])
    answer = np.array([[0, 1], [0, 0], [1, 0]])
    assert metrics.mean_accuracy(answer, label).mean() == pytest.approx((200 / 3 + 0) / 2)


def test_exact_match_by_hand():
    label = np.array([[0, 1], [2, 0], [1, -1], [-1, -1]])
    answer = np.array([[0, 1], [2, 1], [1, 2], [0, 0]])
    scores = metrics.exact_match(answer, label)
    assert scores.values.tolist() == [100.0, 0.0, 100.0]
    assert scores.items.tolist() == [0, 1, 2]  # nothing was asked of the last
    assert metrics.exact_match(np.full((1, 2), -1), np.array([[0, -1]])).mean() == 0.0


def test_ordinal_mae_by_hand():
    label = np.array([[0, 1, 2], [2, 0, -1]])
    answer = np.array([[2, 1, 1], [-1, 0, 1]])  # distances 2, 0, 1, K−1 = 2, 0; the last is not scored
    assert metrics.ordinal_mae(answer, label, LEVELS).mean() == pytest.approx(1.0)


def test_csc_by_hand():
    alone = np.array([[[1], [1], [2]], [[0], [0], [0]]])  # [N=2, S=3, A=1]
    label = np.array([[1], [2]])
    streams = np.ones((2, 3), bool)
    csc = metrics.cross_sensor_consistency(alone, label, streams)
    agree = metrics.cross_sensor_agreement(alone, label, streams)
    assert csc.mean() == pytest.approx(100 / 6)  # of six pairs only (0, 1) of the first question is twice right
    assert agree.mean() == pytest.approx(400 / 6)
    assert agree.items.tolist() == [0, 0, 0, 1, 1, 1]


def test_csc_skips_absent_sensors_and_bottom_never_agrees():
    alone = np.array([[[-1], [-1], [1]]])
    label = np.array([[1]])
    only_bottoms = metrics.cross_sensor_agreement(alone, label, np.array([[True, True, False]]))
    assert only_bottoms.values.tolist() == [0.0]
    assert len(metrics.cross_sensor_consistency(alone, label, np.array([[True, False, False]])).values) == 0


def test_middle_and_parse_rate_by_hand():
    label = np.array([[0, 1], [2, -1]])
    answer = np.array([[1, -1], [1, -1]])
    assert metrics.middle_rate(answer, label, np.array([3, 5])).mean() == pytest.approx(200 / 3)
    parsed = metrics.parse_rate(np.array([True, True]), answer, label)
    assert parsed.values.tolist() == [0.0, 100.0]  # ⊥ on an attribute that was not asked is no fault


def test_an_even_number_of_levels_has_no_middle():
    with pytest.raises(ValueError, match="no middle"):
        metrics.middle_rate(np.zeros((1, 1), int), np.zeros((1, 1), int), np.array([2]))


def test_no_scored_answer_is_an_error():
    with pytest.raises(ValueError, match="empty"):
        metrics.accuracy(np.array([0]), np.array([-1])).mean()


def test_shapes_are_checked():
    with pytest.raises(ValueError, match="equal"):
        metrics.accuracy(np.zeros(2, int), np.zeros(3, int))
    with pytest.raises(ValueError, match=r"\[N, S, A\]"):
        metrics.cross_sensor_agreement(np.zeros((2, 2, 1), int), np.zeros((2, 2), int), np.ones((2, 2), bool))


@st.composite
def answered(draw):
    n, sensors = draw(st.integers(1, 12)), draw(st.integers(2, 4))
    level = st.integers(-1, 2)
    return (
        draw(hnp.arrays(int, (n, sensors, 3), elements=level)),
        draw(hnp.arrays(int, (n, 3), elements=st.integers(0, 2))),
    )


@given(answered())
def test_omae_is_at_least_the_error_rate(case):
    alone, label = case
    omae = metrics.ordinal_mae(alone[:, 0], label, LEVELS).mean()
    acc = metrics.mean_accuracy(alone[:, 0], label).mean()
    assert omae >= 1 - acc / 100 - 1e-12


@given(answered())
def test_exact_match_is_at_most_the_least_accuracy(case):
    alone, label = case
    least = min(metrics.accuracy(alone[:, 0, a], label[:, a]).mean() for a in range(3))
    assert metrics.exact_match(alone[:, 0], label).mean() <= least + 1e-9


@given(answered())
def test_csc_is_bounded_by_agreement_and_by_single_sensor_accuracy(case):
    alone, label = case
    streams = np.ones(alone.shape[:2], bool)
    csc = metrics.cross_sensor_consistency(alone, label, streams).mean()
    right = metrics.accuracy(alone, np.repeat(label[:, None], alone.shape[1], axis=1)).mean()
    assert csc <= metrics.cross_sensor_agreement(alone, label, streams).mean() + 1e-9
    assert csc <= right + 1e-9


@given(answered(), st.integers(0, 2))
def test_a_constant_answer_agrees_with_itself_and_is_balanced_to_chance(case, level):
    alone, label = case
    constant = np.full_like(alone, level)
    assert metrics.cross_sensor_agreement(constant, label, np.ones(alone.shape[:2], bool)).mean() == 100.0
    balanced = metrics.balanced_accuracy(constant[:, 0, 0], label[:, 0]).mean()
    occurring = np.unique(label[:, 0])
    assert balanced == pytest.approx(100 / len(occurring) if level in occurring else 0)


def answers(sensors: int, alone: bool) -> Answers:
    rng = np.random.default_rng(0)
    return Answers(
        conclude=rng.integers(-1, 3, (6, 4)),
        label=rng.integers(0, 3, (6, 4)),
        formatted=np.ones(6, bool),
        reward=rng.random(6),
        streams=np.ones((6, sensors), bool),
        perceive=rng.integers(-1, 3, (6, sensors, 4)),
        alone=rng.integers(-1, 3, (6, sensors, 4)) if alone else None,
    )


ATTRIBUTES = ("hardness", "roughness", "protrusion", "material")


def test_evaluate_gives_every_metric_in_the_order_of_the_table():
    table = evaluate(answers(4, alone=True), ATTRIBUTES, (3, 3, 3, 9))
    assert list(table) == [m for m in METRICS if m != "reward_trained"]  # that one depends on the arm
    accs = [table[f"{p}_acc"].mean() for p in "hrp"]
    assert table["acc"].mean() == pytest.approx(np.mean(accs))


def test_evaluate_leaves_out_what_is_undefined():
    one_sensor = evaluate(answers(1, alone=True), ATTRIBUTES, (3, 3, 3, 9))
    assert not {"csc", "csc_agree", "csc_slot"} & set(one_sensor)
    assert "csc" not in evaluate(answers(4, alone=False), ATTRIBUTES, (3, 3, 3, 9))


def test_evaluate_refuses_an_attribute_without_metrics():
    with pytest.raises(ValueError, match="stickiness"):
        evaluate(answers(1, alone=False), ("stickiness",), (3,))
