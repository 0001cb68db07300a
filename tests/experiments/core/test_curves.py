"""Training curves of logged lines."""

import numpy as np
import pytest

from experiments.core import curves


def test_curves_are_sorted_by_phase_arm_and_seed():
    lines = [
        {"stage": "grpo/paid/1", "step": 1, "reward": 0.5},
        {"stage": "grpo/paid/1", "step": 0, "reward": 0.25, "note": "text"},
        {"stage": "sft/0", "step": 0, "loss": 1},
    ]
    found = curves.curves_by_phase(lines)
    steps, values = found["grpo"]["reward"]["paid", "1"]
    assert (steps.tolist(), values.tolist()) == ([0, 1], [0.25, 0.5])
    assert list(found["sft"]["loss"]) == [("", "0")]
    assert "note" not in found["grpo"]


def test_running_mean_keeps_lines_and_short_series():
    line = np.arange(100.0)
    assert curves.running_mean(line)[10:90] == pytest.approx(line[10:90])
    assert curves.running_mean(np.array([1.0, 5.0])).tolist() == [1.0, 5.0]
    assert curves.running_mean(np.array([2.0])).tolist() == [2.0]
