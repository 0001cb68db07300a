"""Kernel ridge regression against its closed form, and independence of what a probe must not see."""

import numpy as np
import pytest

from touchr1_jax.training.kernel_probe import (
    KernelProbeConfig,
    cross_probe,
    graded_targets,
    kernel_ridge,
    probe,
    ranks,
    standardise,
)

CONFIG = KernelProbeConfig(families=("a", "b"), folds=3)
FAMILY = np.array(["a", "a", "a", "b", "b"])
WEIGHT = np.full(18, 0.5)
OBJECTS = np.repeat([f"o{i}" for i in range(9)], 2)
ONE_HOT = np.eye(3)


@pytest.fixture(scope="module")
def videos():
    rng = np.random.default_rng(0)
    label = np.repeat(rng.integers(0, 3, (9, 3)), 2, axis=0)
    return np.concatenate([label + 0.1 * rng.standard_normal(label.shape), rng.standard_normal((18, 2))], 1), label


def test_kernel_ridge_is_its_closed_form():
    z, target, fit = np.array([[0.0], [1.0], [3.0]]), np.array([[0.0], [1.0]]), np.array([True, True, False])
    kernel = lambda d: np.exp(-d / 0.5)  # the median of the distances 0, 1, 1, 0
    gram = np.array([[1 + 0.1, kernel(1)], [kernel(1), 1 + 0.1]])
    expected = 0.5 + np.array([kernel(3), kernel(2)]) @ np.linalg.solve(gram, [-0.5, 0.5])
    np.testing.assert_allclose(kernel_ridge(z, fit, np.array([0.5, 0.5]), target, 0.1)[2, 0], expected)


def test_probabilities_sum_to_one_and_follow_the_label(videos):
    x, label = videos
    found = probe(x, ONE_HOT[label], WEIGHT, FAMILY, CONFIG)
    assert found.shape == (18, 2, 3, 3)
    np.testing.assert_allclose(found.sum(-1), 1)
    assert (found[:, 0].argmax(-1) == label).mean() > 0.9


def test_the_label_of_an_object_does_not_change_its_own_evidence(videos):
    x, label = videos
    mine = OBJECTS == "o0"
    other = np.where(mine[:, None], (label + 1) % 3, label)
    first, second = (cross_probe(x, ONE_HOT[y], WEIGHT, OBJECTS, FAMILY, CONFIG, 0) for y in (label, other))
    np.testing.assert_allclose(first[mine], second[mine])
    assert not np.allclose(first[~mine], second[~mine])


def test_labels_of_weight_zero_are_ignored(videos):
    x, label = videos
    out = OBJECTS == "o3"
    wrong = np.where(out[:, None], 2 - label, label)
    first, second = (probe(x, ONE_HOT[y], np.where(out, 0.0, WEIGHT), FAMILY, CONFIG) for y in (label, wrong))
    np.testing.assert_allclose(first, second)


def test_standardise_uses_the_fitted_rows_alone():
    x = np.array([[0.0, 5.0], [2.0, 5.0], [100.0, 5.0]])
    np.testing.assert_allclose(standardise(x, np.array([True, True, False])), [[-1, 0], [1, 0], [4, 0]])


def test_graded_targets_by_hand():
    label, rating = np.array([[0], [0], [2], [1]]), np.array([[1.0], [1.0], [1.0], [np.nan]])
    objects = np.array(["a", "b", "c", "d"])
    found = graded_targets(label, rating, np.ones(4), objects, share=0.5, width=1.0)
    np.testing.assert_allclose(found.sum(-1), 1)
    given = (1 + 0.1 * 0.5) / 2.1  # of two others of the same rating one is soft, as are half of all
    np.testing.assert_allclose(found[0, 0, 0], 0.5 + 0.5 * given)
    np.testing.assert_array_equal(found[3, 0], [0, 1, 0])
    np.testing.assert_array_equal(
        graded_targets(label, rating, np.ones(4), objects, share=0.0, width=1.0)[:, 0], ONE_HOT[label[:, 0]]
    )
    label[2] = -1  # would be the last level
    with pytest.raises(ValueError, match=r"label\[2\] is \[-1\]: must be ≥ 0"):
        graded_targets(label, rating, np.ones(4), objects, share=0.5, width=1.0)


def test_ranks_ignore_monotone_changes():
    x = np.random.default_rng(0).standard_normal((50, 2))
    np.testing.assert_allclose(ranks(np.exp(x), np.exp(x)), ranks(x, x))
    assert abs(ranks(x, x).mean()) < 1e-6


def test_errors_name_the_family_and_the_weight(videos):
    x, label = videos
    with pytest.raises(ValueError, match="families holds 'c'"):
        probe(x, ONE_HOT[label], WEIGHT, FAMILY, KernelProbeConfig(families=("c",)))
    with pytest.raises(ValueError, match="weight is 0 everywhere"):
        probe(x, ONE_HOT[label], 0 * WEIGHT, FAMILY, CONFIG)
