"""Kernel ridge regression against its closed form, and what it must not see."""

import numpy as np
import pytest

from experiments.recordings.evidence import EvidenceConfig, cross_probe, kernel_ridge, probe, standardise

CONFIG = EvidenceConfig(families=("a", "b"), folds=3)


@pytest.fixture(scope="module")
def videos():
    rng = np.random.default_rng(0)
    objects = np.repeat([f"o{i}" for i in range(9)], 2)
    label = np.repeat(rng.integers(0, 3, (9, 3)), 2, axis=0)
    x = np.concatenate([label + 0.1 * rng.standard_normal(label.shape), rng.standard_normal((18, 2))], 1)
    return x, label, np.full(18, 0.5), objects, np.array(["a", "a", "a", "b", "b"])


def test_kernel_ridge_is_its_closed_form():
    z, target, fit = np.array([[0.0], [1.0], [3.0]]), np.array([[0.0], [1.0]]), np.array([True, True, False])
    kernel = lambda d: np.exp(-d / 0.5)  # the median of the distances 0, 1, 1, 0
    expected = 0.5 + np.array([kernel(3), kernel(2)]) @ np.linalg.solve(
        np.array([[1 + 0.1, kernel(1)], [kernel(1), 1 + 0.1]]), [-0.5, 0.5]
    )
    said = kernel_ridge(z, fit, np.array([0.5, 0.5]), target, 0.1)
    np.testing.assert_allclose(said[2, 0], expected)


def test_probabilities_sum_to_one_and_follow_the_label(videos):
    x, label, weight, _, family = videos
    said = probe(x, label, weight, family, CONFIG)
    assert said.shape == (18, 2, 3, 3)
    np.testing.assert_allclose(said.sum(-1), 1)
    assert (said[:, 0].argmax(-1) == label).mean() > 0.9


def test_a_held_out_label_changes_nothing_of_what_is_said_of_it(videos):
    x, label, weight, objects, family = videos
    other = np.where((objects == "o0")[:, None], (label + 1) % 3, label)
    first = cross_probe(x, label, weight, objects, family, CONFIG, 0)
    second = cross_probe(x, other, weight, objects, family, CONFIG, 0)
    np.testing.assert_allclose(first[objects == "o0"], second[objects == "o0"])
    assert not np.allclose(first[objects != "o0"], second[objects != "o0"])


def test_weight_zero_is_not_looked_at(videos):
    x, label, weight, objects, family = videos
    held = objects == "o3"
    out = np.where(held, 0.0, weight)
    wrong = np.where(held[:, None], 2 - label, label)
    np.testing.assert_allclose(probe(x, label, out, family, CONFIG), probe(x, wrong, out, family, CONFIG))


def test_standardise_uses_the_fitted_rows_alone():
    x = np.array([[0.0, 5.0], [2.0, 5.0], [100.0, 5.0]])
    z = standardise(x, np.array([True, True, False]), 4.0)
    np.testing.assert_allclose(z, [[-1, 0], [1, 0], [4, 0]])


def test_errors_name_the_family_and_the_weight(videos):
    x, label, weight, _, family = videos
    with pytest.raises(ValueError, match="families holds 'c'"):
        probe(x, label, weight, family, EvidenceConfig(families=("c",)))
    with pytest.raises(ValueError, match="weight is 0 everywhere"):
        probe(x, label, 0 * weight, family, CONFIG)
