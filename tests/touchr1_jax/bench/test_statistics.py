"""Intervals and tests by hand values, and their coverage where no hand value exists."""

import numpy as np
import pytest
from scipy import stats

from touchr1_jax.bench import statistics
from touchr1_jax.bench.statistics import clustered_bootstrap, skill


def test_bootstrap_of_two_clusters_is_exact():
    # Resamples are {aa, ab, bb} with probabilities ¼, ½, ¼, so the outer quantiles are the cluster means.
    interval = clustered_bootstrap(np.array([0.0, 0.0, 1.0]), np.array(["a", "a", "b"]))
    assert (interval.mean, interval.low, interval.high) == (pytest.approx(1 / 3), 0.0, 1.0)


def test_bootstrap_agrees_with_a_plain_loop():
    rng = np.random.default_rng(3)
    clusters = rng.integers(0, 8, 40)
    strata = rng.integers(0, 2, 40)
    values = rng.random(40)
    got = clustered_bootstrap(values, clusters, strata=strata, resamples=4000)
    means = []
    for _ in range(4000):
        index = np.concatenate([np.nonzero(clusters == c)[0] for c in rng.choice(np.unique(clusters), 8)])
        means.append(np.mean([values[index][strata[index] == s].mean() for s in np.unique(strata[index])]))
    assert (got.low, got.high) == pytest.approx(np.quantile(means, (0.025, 0.975)), abs=0.02)
    assert got.mean == pytest.approx(np.mean([values[strata == s].mean() for s in (0, 1)]))


@pytest.mark.parametrize(
    ("values", "clusters", "message"),
    [
        ([1.0, 2.0], ["a"], "lengths"),
        ([1.0, np.nan], ["a", "b"], r"values\[1\] is nan"),
        ([1.0, 2.0], ["a", "a"], "two"),
    ],
)
def test_bootstrap_names_what_is_wrong(values, clusters, message):
    with pytest.raises(ValueError, match=message):
        clustered_bootstrap(np.array(values), np.array(clusters))


def test_student_interval_by_hand():
    interval = statistics.student_interval(np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    assert interval.mean == 3.0
    assert interval.high - 3.0 == pytest.approx(2.776445 * np.sqrt(2.5 / 5), rel=1e-6)
    with pytest.raises(ValueError, match="seeds"):
        statistics.student_interval(np.array([1.0]))


def test_interquartile_mean_drops_a_quarter_at_either_end():
    assert statistics.interquartile_mean(np.array([[100.0, 1.0], [3.0, -50.0]])) == 2.0
    scores = np.random.default_rng(0).random(23)
    assert statistics.interquartile_mean(scores) == pytest.approx(stats.trim_mean(scores, 0.25))


def test_probability_of_improvement_is_mann_whitneys_statistic():
    rng = np.random.default_rng(0)
    better, than = rng.integers(0, 6, (7, 3)).astype(float), rng.integers(0, 5, (4, 3)).astype(float)
    tasks = [stats.mannwhitneyu(better[:, t], than[:, t]).statistic / (7 * 4) for t in range(3)]
    assert statistics.probability_of_improvement(better, than) == pytest.approx(np.mean(tasks))
    with pytest.raises(ValueError, match="tasks"):
        statistics.probability_of_improvement(np.ones((2, 1)), np.ones((2, 2)))


def test_interval_of_the_improvement_agrees_with_a_plain_loop():
    rng = np.random.default_rng(1)
    better, than = rng.normal(0.5, 1, (5, 2)), rng.normal(0, 1, (4, 2))
    got = statistics.improvement_interval(better, than, resamples=2000)
    drawn = [
        statistics.probability_of_improvement(
            *(np.stack([rng.choice(a[:, t], len(a)) for t in range(2)], 1) for a in (better, than))
        )
        for _ in range(2000)
    ]
    assert (got.low, got.high) == pytest.approx(np.quantile(drawn, (0.025, 0.975)), abs=0.03)
    apart = statistics.improvement_interval(np.ones((3, 1)), np.zeros((3, 1)))
    assert (apart.low, apart.mean, apart.high) == (1.0, 1.0, 1.0)


@pytest.mark.long
def test_stratified_bootstrap_agrees_with_a_plain_loop():
    rng = np.random.default_rng(2)
    scores = rng.normal(size=(5, 3))
    got = statistics.stratified_bootstrap_iqm(scores, resamples=3000)
    drawn = [
        stats.trim_mean(np.stack([rng.choice(scores[:, t], 5) for t in range(3)], 1), 0.25, axis=None)
        for _ in range(3000)
    ]
    assert (got.low, got.high) == pytest.approx(np.quantile(drawn, (0.025, 0.975)), abs=0.06)


def test_sign_flip_test_by_hand():
    assert statistics.sign_flip_test(np.ones(5)) == 2 / 32
    assert statistics.sign_flip_test(np.array([1.0, -1.0])) == 1.0
    assert statistics.sign_flip_test(np.array([1.0, 2.0, -1.0])) == 6 / 8  # |sum| is 4 twice, 2 four times, 0 twice
    with pytest.raises(ValueError, match="empty"):
        statistics.sign_flip_test(np.array([]))


def test_sampled_sign_flips_agree_with_a_t_test():
    differences = np.random.default_rng(0).normal(0.4, 1, 40)
    assert statistics.sign_flip_test(differences) == pytest.approx(stats.ttest_1samp(differences, 0).pvalue, abs=0.01)
    assert statistics.sign_flip_test(np.ones(40)) == pytest.approx(1 / 20_001)


def test_a_crossed_test_of_answers_that_are_alike_is_a_t_test_over_seeds_or_over_objects():
    rng = np.random.default_rng(0)
    objects = np.repeat(np.arange(30), 2)
    seeds = rng.normal(0.5, 1, 5)
    found = statistics.crossed_test(np.repeat(seeds[:, None], 60, axis=1), objects)
    assert found == pytest.approx(stats.ttest_1samp(seeds, 0).pvalue)
    shares = rng.normal(0.5, 1, 30)
    t = stats.ttest_1samp(shares, 0).statistic
    assert statistics.crossed_test(np.tile(shares[objects], (5, 1)), objects) == pytest.approx(2 * stats.t.sf(t, 4))
    assert statistics.crossed_test(np.ones((5, 60)), objects) == 0.0
    assert statistics.crossed_test(np.zeros((5, 60)), objects) == 1.0
    with pytest.raises(ValueError, match="two at least"):
        statistics.crossed_test(np.ones((1, 60)), objects)


def test_a_crossed_test_weighs_the_strata_alike():
    # Means of the strata are 2 and 0; the stratum of one answer counts as much as that of four.
    values = np.array([[2.0, 1.0, -1.0, 1.0, -1.0], [2.2, 1.0, -1.0, 1.0, -1.0]])
    strata, objects = np.array([0, 1, 1, 1, 1]), np.arange(5)
    one, two = (statistics.crossed_test(values, objects, strata=s) for s in (strata, np.zeros(5, int)))
    assert one < two


@pytest.mark.parametrize(("of_seeds", "of_objects"), [(1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (0.1, 0.5)])
def test_a_crossed_test_keeps_its_level_with_five_seeds(of_seeds, of_objects):
    rng = np.random.default_rng(0)
    objects = np.repeat(np.arange(40), 3)
    effects = 0.3 * of_seeds * rng.normal(size=(400, 5, 1)) + (of_objects * rng.normal(size=(400, 1, 40)))[..., objects]
    p = [statistics.crossed_test(d, objects) for d in effects + rng.normal(size=(400, 5, 120))]
    assert np.mean(np.array(p) <= 0.05) <= 0.075


def test_holm_by_hand():
    assert statistics.holm(np.array([0.04, 0.01, 0.03])).tolist() == pytest.approx([0.06, 0.03, 0.06])
    assert statistics.holm(np.array([0.6, 0.9])).tolist() == [1.0, 1.0]


def test_kappa_by_hand():
    # 20 yes/yes, 15 no/no, 5 + 10 apart of 50: observed .7, expected .5 (a textbook case)
    a = np.repeat([1, 1, 0, 0], [20, 5, 10, 15])
    b = np.repeat([1, 0, 1, 0], [20, 5, 10, 15])
    assert statistics.cohens_kappa(a, b, 2) == pytest.approx(0.4) == statistics.cohens_kappa(b, a, 2)


def test_quadratic_weights_forgive_the_neighbour():
    a, near, far = np.array([0, 1, 2, 0, 1, 2]), np.array([0, 1, 1, 0, 1, 2]), np.array([0, 1, 0, 0, 1, 2])
    assert statistics.cohens_kappa(a, near, 3, weights="quadratic") > statistics.cohens_kappa(
        a, far, 3, weights="quadratic"
    )
    plain = statistics.cohens_kappa(a, near, 2 + 1)
    assert statistics.cohens_kappa(a, near, 3, weights="quadratic") > plain


@pytest.mark.parametrize(
    ("a", "b", "message"), [([0], [0, 1], "lengths 1 and 2"), ([0, 3], [0, 1], "0 to 3"), ([1, 1], [1, 1], "undefined")]
)
def test_kappa_names_what_is_wrong(a, b, message):
    with pytest.raises(ValueError, match=message):
        statistics.cohens_kappa(np.array(a), np.array(b), 3)


def test_wilson_is_scipys():
    for passed, of in ((0, 7), (7, 7), (1832, 2000)):
        ours, known = statistics.wilson_interval(passed, of), stats.binomtest(passed, of).proportion_ci(method="wilson")
        assert (ours.low, ours.high) == pytest.approx((known.low, known.high))
    with pytest.raises(ValueError, match="8 of 7"):
        statistics.wilson_interval(8, 7)


def test_skill_is_a_ratio_of_sums():
    error, reference = np.array([1.0, 3.0, 2.0, 2.0]), np.array([2.0, 4.0, 6.0, 4.0])
    found = skill(error, reference, np.array(["a", "a", "b", "c"]))
    np.testing.assert_allclose(found.mean, 1 - 8 / 16)
    assert 1 - 4 / 6 - 1e-9 <= found.low <= found.mean <= found.high <= 1 - 2 / 6 + 1e-9  # objects alone: 1/3, 2/3, 1/2


def test_contacts_of_one_object_are_resampled_together():
    """Two objects of opposite skill: many contacts of each make the interval no narrower."""
    found = skill(np.repeat([0.0, 2.0], 500), np.ones(1000), np.repeat([0, 1], 500))
    assert (found.low, found.high) == (-1.0, 1.0)


def test_a_reference_without_error_is_refused():
    with pytest.raises(ValueError, match=r"reference sums to 0\.0: must be > 0"):
        skill(np.ones(2), np.zeros(2), np.arange(2))


def test_one_object_has_neither_an_interval_of_skill_nor_a_crossed_test():
    with pytest.raises(ValueError, match="objects holds 1: an interval over objects needs two"):
        skill(np.ones(3), np.full(3, 2.0), np.zeros(3, int))
    with pytest.raises(ValueError, match="objects holds 1"):
        statistics.crossed_test(np.ones((5, 3)), np.zeros(3, int))


@pytest.mark.parametrize(
    ("name", "interval"),
    [
        ("scores", statistics.stratified_bootstrap_iqm),
        ("better", lambda one: statistics.improvement_interval(one, np.eye(2))),
        ("than", lambda one: statistics.improvement_interval(np.eye(2), one)),
    ],
)
def test_one_run_has_no_interval_over_runs(name, interval):
    with pytest.raises(ValueError, match=f"{name} holds 1 runs: an interval over runs needs two"):
        interval(np.eye(2)[:1])


def test_resamples_of_objects_without_reference_error_are_left_out():
    """An eighth of the resamples of three objects holds none but the two that have no reference error."""
    found = skill(np.array([1.0, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]), np.arange(3))
    assert (found.low, found.mean, found.high) == (0.5, 0.5, 0.5)


@pytest.mark.parametrize(
    ("low", "high", "excludes"), [(0.0, 1.0, False), (-1.0, 0.0, False), (1e-9, 1.0, True), (-1.0, -1e-9, True)]
)
def test_an_interval_that_touches_zero_does_not_exclude_it(low, high, excludes):
    assert statistics.Interval(mean=(low + high) / 2, low=low, high=high).excludes_zero == excludes


UNKNOWN = np.array([[1.0, 2.0], [3.0, np.nan]])


@pytest.mark.parametrize(
    "call",
    [
        lambda: statistics.student_interval(UNKNOWN.ravel()),  # was NaN, NaN, NaN
        lambda: statistics.sign_flip_test(UNKNOWN.ravel()),  # was p = 0: no pattern is as large as NaN
        lambda: statistics.interquartile_mean(UNKNOWN),  # was 2.5: NaN was dropped as the largest
        lambda: statistics.stratified_bootstrap_iqm(UNKNOWN, resamples=2),
        lambda: statistics.probability_of_improvement(UNKNOWN, UNKNOWN * 0),  # was a loss
        lambda: statistics.improvement_interval(UNKNOWN * 0, UNKNOWN, resamples=2),
        lambda: skill(UNKNOWN.ravel(), np.ones(4), np.arange(4)),
        lambda: statistics.drawn_means(UNKNOWN.ravel(), np.arange(4), np.array([0, 0, 1, 1]), np.ones((2, 4), int)),
    ],
)
def test_no_statistic_takes_nan_for_a_number(call):
    with pytest.raises(ValueError, match=r"\[\d\] is nan: must be finite"):
        call()


@pytest.mark.parametrize("shape", [(0, 2), (2, 0)])
@pytest.mark.parametrize(
    "call",
    [
        statistics.interquartile_mean,
        statistics.stratified_bootstrap_iqm,
        lambda scores: statistics.probability_of_improvement(scores, scores),
        lambda scores: statistics.improvement_interval(scores, scores),
    ],
)
def test_no_statistic_of_nothing_is_nan(call, shape):
    with pytest.raises(ValueError, match=r"(scores|better) is empty: must hold one number at least"):
        call(np.zeros(shape))
