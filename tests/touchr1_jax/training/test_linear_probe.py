"""Out-of-fold probes: they are out of fold, and they are the optimum."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.special

from touchr1_jax.training.linear_probe import ProbeConfig, cross_fit, probe_log_probs, sensor_evidence, stream_features

CONFIG = ProbeConfig()
K = 3


@pytest.fixture(scope="module")
def problem():
    """Sixty rows of twenty objects, four features on very different scales, labels that follow the first."""
    rng = np.random.default_rng(0)
    groups = np.repeat([f"object_{i}" for i in range(20)], 3)
    labels = np.repeat(rng.integers(0, K, 20), 3)
    features = rng.normal(size=(60, 4)) * [1, 100, 0.01, 1] + [0, 500, 0, -3]
    features[:, 0] += 1.5 * labels
    return features.astype(np.float32), labels, groups


@pytest.mark.long
def test_an_identity_leaks_nothing():
    """Features that are the object's one-hot name: in sample a perfect probe, out of fold no information at all."""
    rng = np.random.default_rng(0)
    objects, labels = np.repeat(np.arange(20), 3), np.repeat(rng.integers(0, K, 20), 3)
    one_hot = np.eye(20, dtype=np.float32)[objects]
    inside = probe_log_probs(one_hot, labels, np.ones((1, 60)), K, CONFIG)[0]
    assert (inside.argmax(-1) == labels).all()
    outside = cross_fit(one_hot, labels, objects, K, CONFIG)
    assert len(np.unique(outside.round(5), axis=0)) <= CONFIG.folds  # one constant answer per fold
    assert (outside.argmax(-1) == labels).mean() < 0.5


@pytest.mark.long
def test_a_row_is_read_by_a_probe_that_never_saw_its_object(problem):
    """Other labels for an object's rows change the predictions for the others, and not those for these rows."""
    features, labels, groups = problem
    before = cross_fit(features, labels, groups, K, CONFIG)
    mine = groups == "object_7"
    after = cross_fit(features, np.where(mine, (labels + 1) % K, labels), groups, K, CONFIG)
    np.testing.assert_allclose(after[mine], before[mine], atol=1e-6)
    assert np.abs(after[~mine] - before[~mine]).max() > 1e-3


def test_unlabelled_rows_are_read_but_not_learned_from(problem):
    features, labels, groups = problem
    hidden = groups == "object_3"
    without = cross_fit(features, np.where(hidden, -1, labels), groups, K, CONFIG)
    wrong = cross_fit(features + 100 * hidden[:, None], np.where(hidden, -1, labels), groups, K, CONFIG)
    np.testing.assert_allclose(wrong[~hidden], without[~hidden], atol=1e-6)
    assert np.isfinite(without).all()


@pytest.mark.long
def test_rows_that_are_only_read_change_no_other_and_are_read_by_a_probe_of_all_others(problem):
    features, labels, groups = problem[:3]
    n, read_only = len(labels), np.arange(len(labels)) // 3 % 4 == 0
    rows = features[:, None], np.ones((n, 1), bool), labels[:, None], groups, [3], CONFIG
    found = sensor_evidence(*rows, read_only=read_only)[:, 0, 0]
    kept = ~read_only
    alone = sensor_evidence(
        features[kept, None], np.ones((kept.sum(), 1), bool), labels[kept, None], groups[kept], [3], CONFIG
    )
    np.testing.assert_array_equal(found[kept], alone[:, 0, 0])
    whole = probe_log_probs(features, np.where(kept, labels, -1), kept[None], 3, CONFIG)[0]
    np.testing.assert_allclose(found[read_only], whole[read_only], atol=1e-4)


def scipy_log_probs(features, labels, weight, penalty):
    """The same objective in float64 by L-BFGS-B."""
    x = np.asarray(features, np.float64)
    centre = weight @ x / weight.sum()
    z = (x - centre) / np.sqrt(weight @ (x - centre) ** 2 / weight.sum())
    unpack = lambda v: (v[: z.shape[1] * K].reshape(-1, K), v[z.shape[1] * K :])

    def objective(v):
        matrix, bias = unpack(v)
        log_p = scipy.special.log_softmax(z @ matrix + bias, -1)
        cost = -(weight * log_p[np.arange(len(z)), labels]).sum() / weight.sum() + penalty / 2 * (matrix**2).sum()
        error = weight[:, None] * (np.exp(log_p) - np.eye(K)[labels]) / weight.sum()
        return cost, np.concatenate([(z.T @ error + penalty * matrix).ravel(), error.sum(0)])

    found = scipy.optimize.minimize(objective, np.zeros((z.shape[1] + 1) * K), jac=True, tol=1e-12)
    matrix, bias = unpack(found.x)
    return scipy.special.log_softmax(z @ matrix + bias, -1)


def test_fit_is_the_optimum_that_scipy_finds(problem):
    features, labels, _ = problem
    weight = np.random.default_rng(1).uniform(0, 2, 60).round()
    ours = probe_log_probs(features, labels, weight[None], K, CONFIG)[0]
    np.testing.assert_allclose(ours, scipy_log_probs(features, labels, weight, CONFIG.penalty), atol=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("constant", [0.0, 5.3, -9.21034])
def test_a_feature_that_is_constant_in_training_says_nothing(problem, constant):
    """Its spread is rounding noise, which must not be scaled up: the held-out rows may hold another value."""
    features, labels, _ = problem
    train = np.arange(60) < 48
    column = np.where(train, np.float32(constant), np.float32(constant + 0.5))[:, None]
    widened = np.concatenate([features, column], 1)
    plain, ours = (probe_log_probs(x, labels, train[None], K, CONFIG)[0] for x in (features, widened))
    np.testing.assert_allclose(ours, plain, atol=2e-3)


def test_groups_must_fill_the_folds(problem):
    features, labels, _ = problem
    with pytest.raises(ValueError, match="groups has 4 members, fewer than folds = 5; lower folds"):
        cross_fit(features, labels, np.arange(60) % 4, K, CONFIG)
    assert dataclasses.replace(CONFIG, folds=4).folds == 4


def test_a_feature_that_is_not_finite_is_refused(problem):
    """It would be left out of all rows: one NaN in 60 rows took the right answers from 85 % to chance."""
    features, labels, objects = problem
    broken = np.array(features)
    broken[7, 0] = np.nan
    with pytest.raises(ValueError, match=r"features\[7, 0\] is nan: must be finite"):
        cross_fit(broken, labels, objects, K, CONFIG)


def test_summary_of_a_stream_by_hand():
    """A checkerboard of 1 px that turns from grey to full contrast: pixel gradients, none at four pixels."""
    board = np.indices((8, 8)).sum(0) % 2
    frames = np.stack([np.full((8, 8), 127), board * 254]).astype(np.uint8)[..., None].repeat(3, -1)
    force = jnp.array([[0.0, 0, 0], [0, 0, -10]])
    row = np.asarray(stream_features(jnp.asarray(frames), force)).reshape(2, -1)
    assert row.shape == (2, 7 * 3 + 5)
    mean, size, spread, fine, coarse, d_fine, d_coarse = row[1, :21].reshape(7, 3)
    np.testing.assert_allclose(mean, 0, atol=1e-6)
    np.testing.assert_allclose(size, np.log(127 / 255 + 1e-4), rtol=1e-4)
    np.testing.assert_allclose(spread, np.log(127 / 255 + 1e-4), rtol=1e-4)
    np.testing.assert_allclose(fine, np.log(2 * 254 / 255 + 1e-4), rtol=1e-4)
    np.testing.assert_allclose(coarse, np.log(1e-4), rtol=1e-3)
    np.testing.assert_allclose(d_fine, fine - np.log(1e-4), rtol=1e-4)
    np.testing.assert_allclose(d_coarse, 0, atol=1e-3)
    np.testing.assert_allclose(row[1, 21:], [0, 0, -1, np.log(101) - 2, 1], rtol=1e-5)


def test_summary_batches_over_streams_and_contacts():
    rng = np.random.default_rng(0)
    frames = jnp.asarray(rng.integers(0, 256, (2, 3, 2, 8, 8, 3), dtype=np.uint8))
    force = jnp.asarray(rng.normal(size=(2, 3, 2, 3)), jnp.float32)
    together = stream_features(frames, force)
    np.testing.assert_allclose(together[1, 2], stream_features(frames[1, 2], force[1, 2]), rtol=1e-4, atol=1e-5)
