"""The table and the picture of sampled answers."""

import dataclasses

import numpy as np
import pytest

from experiments.study.sampled import calibration_chart, pooled_votes, sampled_table
from tests.experiments.study.test_study import TEST, answers_about
from touchr1_jax.bench.sampled import Votes

SAMPLES = 4


@pytest.fixture(scope="module")
def seeds():
    """Greedy answers are random; of two seeds the first samples the label always, the second half of the time."""
    greedy = answers_about(TEST)
    right = np.repeat(np.where(greedy.label >= 0, greedy.label, 0)[:, None], SAMPLES, 1)
    wrong = (right + 1) * (np.arange(SAMPLES) % 2)[:, None] + right * (np.arange(SAMPLES) % 2 == 0)[:, None]
    return [dataclasses.replace(greedy, sampled=sampled) for sampled in (right, wrong)]


def test_scores_of_sampled_answers(seeds):
    """Of the second seed's even votes the first sample, a right one, wins: .5 certain and always right."""
    (row,) = sampled_table({"sft": seeds}, np.arange(len(TEST))).rows
    name, _, once, several, majority, error = row
    assert name == "sft"
    assert [float(cell.split()[0]) for cell in (once, several, majority)] == [75.0, 100.0, 100.0]
    assert error == pytest.approx(25.0)


def test_calibration_is_drawn(seeds):
    votes = pooled_votes(seeds)
    assert len(votes.right) == 2 * len(seeds[0].label)
    assert isinstance(votes, Votes)
    assert calibration_chart({"sft": votes}).startswith(b"<")
