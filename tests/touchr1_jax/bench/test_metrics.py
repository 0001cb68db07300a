"""Metrics by hand values, and the identities that hold between them."""

import dataclasses

import numpy as np
import pytest

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


@pytest.mark.parametrize("field", ["formatted", "reward"])
def test_evaluate_refuses_one_value_for_all_questions(field):
    """It was stretched over them, or its mean was taken for theirs."""
    one = dataclasses.replace(answers(1, alone=False), **{field: np.ones(1, bool)})
    with pytest.raises(ValueError, match=rf"'{field}': \(1,\).*must be equal"):
        evaluate(one, ("hardness", "roughness", "protrusion", "material"), (3, 3, 3, 9))


def test_evaluate_refuses_an_attribute_without_metrics():
    with pytest.raises(ValueError, match="stickiness"):
        evaluate(answers(1, alone=False), ("stickiness",), (3,))
