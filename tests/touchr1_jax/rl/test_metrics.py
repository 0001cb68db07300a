"""Metrics of a step by hand."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.rl.metrics import advantage_metrics, answer_metrics, reward_metrics, rollout_metrics, touch_metrics
from touchr1_jax.types import Parsed, Rollout


def assert_metrics(found: dict, expected: dict[str, float]) -> None:
    assert {name: pytest.approx(float(value), rel=1e-5) for name, value in found.items()} == expected


def test_rollout_metrics_by_hand():
    """Two prompts of two rollouts: hardness with label 2, material with label 1."""
    conclude = np.full((2, 2, 4), -1)
    conclude[0, :, 0] = 2, 1  # right; the middle
    conclude[1, 1, 3] = 4  # ⊥; wrong, and 4 is the middle of 9 but material is not ordinal
    parsed = Parsed(
        perceive=jnp.zeros((2, 2, 2, 4), jnp.int32),
        compare=jnp.zeros((2, 2, 4), jnp.int32),
        conclude=jnp.asarray(conclude),
        formatted=jnp.array([[True, True], [True, False]]),
        truncated=jnp.array([[False, False], [False, True]]),
        length=jnp.zeros((2, 2), jnp.int32),
    )
    mask = jnp.arange(4) < jnp.array([[4, 2], [1, 1]])[..., None]
    reward = jnp.array([[1.0, 0.4], [0.0, 0.0]])
    rollout = Rollout(tokens=jnp.zeros((2, 2, 4), jnp.int32), log_prob=jnp.zeros((2, 2, 4)), mask=mask)
    target = tiny.target(np.array([0, 3]), np.array([2, 1]))
    flags = jnp.array([False, True]), jnp.array([True, True])
    ours = rollout_metrics(rollout, reward, *flags, parsed, target)
    expected = {
        "reward": 0.35,
        "reward_std": 0.15,
        "degenerate_share": 0.5,
        "accuracy": 0.25,
        "middle_rate": 0.5,
        "middle_labels": 0.0,
        "parse_rate": 0.5,  # the two of prompt 0; one ⊥, one not formatted
        "truncated_share": 0.25,
        "length": 2.0,
    }
    assert_metrics(ours, expected)
    for levels, below, middle in ((2, 1, (0.0, 0.0)), (5, 0, (0.5, 1.0))):  # two levels have no middle one
        changed = dataclasses.replace(parsed, conclude=parsed.conclude - below)
        scale = dataclasses.replace(target, levels=jnp.full_like(target.levels, levels))
        found = rollout_metrics(rollout, reward, *flags, changed, scale)
        assert (found["middle_rate"], found["middle_labels"]) == middle
    without_last = rollout_metrics(rollout, reward, flags[0], ~flags[0], parsed, target)
    assert_metrics({n: without_last[n] for n in ("reward", "reward_std")}, {"reward": 0.7, "reward_std": 0.3})


def test_answer_metrics_by_hand():
    """Hardness with labels 2 and 2, roughness with label 0, material with label 1; two rollouts each."""
    attribute = np.array([0, 1, 0, 3])
    at = lambda levels: np.where((np.arange(tiny.A) == attribute[:, None])[:, None], np.array(levels)[..., None], -1)
    conclude, compare = at([[2, 1], [0, -1], [2, 2], [4, -1]]), at([[2, 1], [0, -1], [2, 0], [4, 4]])
    perceive = np.stack([at([[2, 1], [0, -1], [2, 2], [-1, -1]]), at([[2, 2], [0, -1], [2, 2], [-1, -1]])], 2)
    parsed = Parsed(
        perceive=jnp.asarray(perceive),
        compare=jnp.asarray(compare),
        conclude=jnp.asarray(conclude),
        formatted=jnp.array([[True, True], [False, True], [True, True], [True, True]]),
        truncated=jnp.zeros((4, 2), bool),
        length=jnp.zeros((4, 2), jnp.int32),
    )
    expected = {
        "right_level_0": 0.5,
        "right_level_1": 0.0,
        "right_level_2": 0.75,
        "labels_level_0": 2.0,
        "labels_level_1": 0.0,
        "labels_level_2": 4.0,
        "mode_share": 0.6,  # 2 in three of the five ordinal answers
        "label_mode_share": 4 / 6,
        "echo_share": 0.4,  # the first rollouts of both questions for hardness, of five formatted ordinal answers
        "echo_right": 0.6,  # among these five
        "gamed_share": 0.25,  # roughness without format, material without a conclusion
    }
    found = answer_metrics(parsed, tiny.target(attribute, np.array([2, 0, 2, 1])), levels=3)
    assert_metrics(found, expected)
    five = dataclasses.replace(parsed, conclude=jnp.where(parsed.conclude == 2, 4, parsed.conclude))
    of_five = answer_metrics(five, tiny.target(attribute, np.array([4, 0, 4, 1])), levels=5)
    assert of_five["mode_share"] == found["mode_share"]
    assert [float(of_five[f"labels_level_{k}"]) for k in range(5)] == [2, 0, 0, 0, 4]
    assert (of_five["right_level_4"], of_five["right_level_2"]) == (found["right_level_2"], 0)


def test_metrics_of_rewards_and_advantages_by_hand():
    reward = jnp.array([[1.0, 0.0], [0.5, 0.25], [0.4, 0.4], [0.0, 0.0]])
    right = jnp.array([[True, True], [True, False], [False, False], [False, False]])
    found = reward_metrics({"a": reward}, right, *jnp.array([[False, False, True, True], [True, True, True, False]]))
    expected = {"reward_a": 2.55 / 6, "all_right_share": 0.25, "none_right_share": 0.5, "nonfinite_share": 0.25}
    assert_metrics(found, expected | {"unsolved_share": 0.5, "idle_share": 0.25})
    advantage = jnp.array([[1.0, -3.0], [2.0, -2.0], [0.0, 0.0], [0.0, 0.0]])
    expected = {"advantage_abs": 1.0, "advantage_peak": 3.0, "lively_groups": 2.0}
    assert_metrics(advantage_metrics(reward, advantage), expected)


def test_touch_metrics_by_hand():
    """One of two present streams of several steps stands still; prompt 2 has no touch.  One step of two tokens is no
    stream of several steps.
    """
    time = jnp.array([[[3, 3, -1], [1, 2, 2]], [[5, -1, -1], [0, 0, 0]], [[0, 0, 0], [0, 0, 0]]])
    present = jnp.array([[True, True], [True, False], [False, False]])
    features = tiny.features(0, 3).replace(touch_time=time, stream_mask=present)
    assert_metrics(touch_metrics(features, 1), {"static_time_share": 0.5, "touch_share": 2 / 3})
    assert_metrics(touch_metrics(features, 2), {"static_time_share": 0.0, "touch_share": 2 / 3})
    empty = features.replace(touch_time=jnp.full_like(time, -1))
    assert touch_metrics(empty, 1)["touch_share"] == 0
