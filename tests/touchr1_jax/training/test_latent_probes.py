"""Probes, rank and the alarms of stage 1."""

import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.training.latent_probes import (
    BOUNDS,
    collapse_alarms,
    contact_features,
    probe_right,
    rank_me,
    told_apart,
)
from touchr1_jax.training.linear_probe import ProbeConfig

pytestmark = pytest.mark.long


def test_features_are_means_over_the_steps_that_exist():
    latent = np.arange(1 * 2 * 3 * 1 * 2, dtype=np.float32).reshape(1, 2, 3, 1, 2)
    exists = np.array([[[True, True, False], [False, False, False]]])
    np.testing.assert_array_equal(contact_features(latent, exists), [[1, 2, 0, 0]])


def test_a_probe_reads_what_is_there_and_cannot_read_what_is_not():
    rng = np.random.default_rng(0)
    label = np.stack([rng.integers(0, 3, 240), rng.integers(0, 3, 240)], 1)
    features = np.concatenate([np.eye(3)[label[:, 0]], rng.normal(size=(240, 4))], 1).astype(np.float32)
    train = np.arange(240) < 160
    label[200, 0] = label[0, 0] = -1  # neither fitted on nor right
    right = probe_right(features, label, train, ProbeConfig(iterations=20))
    assert right.shape == (80, 2)
    assert not right[40, 0]
    assert np.delete(right[:, 0], 40).all()
    assert right[:, 1].mean() < 0.6


def test_rank_of_known_shapes():
    rng = np.random.default_rng(0)
    line = np.outer(np.linspace(-1, 1, 50), rng.normal(size=6)).astype(np.float32)
    np.testing.assert_allclose(rank_me(jnp.asarray(line)), 1.0, atol=0.05)
    cross = np.concatenate([np.eye(6), -np.eye(6)]).astype(np.float32)
    np.testing.assert_allclose(rank_me(jnp.asarray(cross)), 6.0, rtol=1e-4)
    np.testing.assert_allclose(rank_me(jnp.asarray(cross + 100)), 6.0, rtol=1e-2)  # a common mean hides nothing
    np.testing.assert_allclose(rank_me(jnp.asarray(cross[:, :2])), 2.0, rtol=1e-4)
    assert rank_me(jnp.ones((5, 3))) == 1.0  # one point: the least that there is


def test_contacts_are_told_apart_by_their_share_of_the_latents_whatever_the_scale():
    """Two contacts at 3 and 5: they differ by 1 from their mean 4, so √(2 / 34)."""
    latent = np.array([3.0, 5.0], np.float32).reshape(2, 1, 1, 1, 1)
    exists = np.ones((2, 1, 1), bool)
    np.testing.assert_allclose(told_apart(latent, exists), np.sqrt(2 / 34), rtol=1e-6)
    np.testing.assert_allclose(told_apart(1e-3 * latent, exists), np.sqrt(2 / 34), rtol=1e-6)
    absent = np.concatenate([latent, np.full_like(latent, 99.0)], 2)
    np.testing.assert_allclose(told_apart(absent, np.array([[[True, False]]] * 2)), np.sqrt(2 / 34), rtol=1e-6)


@pytest.mark.parametrize(("name", "sick"), [("kept", 0.4), ("rank_share", 0.05), ("skill", -0.1), ("probe_lead", 0.0)])
def test_each_sign_of_collapse_raises_its_alarm_alone(name, sick):
    well = {"kept": 0.8, "rank_share": 0.5, "skill": 0.3, "probe_lead": 9.0, "loss": 1.0}
    assert collapse_alarms(well, well) == []
    (alarm,) = collapse_alarms({**well, name: sick}, {**well, name: sick})
    assert (alarm.code, alarm.value, alarm.bound) == ("F11", sick, BOUNDS[name][0])
    assert collapse_alarms({}, {}) == []


def test_what_comes_once_or_recovers_raises_no_alarm():
    assert collapse_alarms({"kept": 0.9}, {"kept": 0.3}) == []
    assert collapse_alarms({"kept": 0.3}, {"kept": 0.4}) == []
    assert len(collapse_alarms({"kept": 0.4}, {"kept": 0.3})) == 1
    for before in (0.4, np.nan):
        assert len(collapse_alarms({"kept": before}, {"kept": np.nan})) == 1
    assert collapse_alarms({"kept": np.nan}, {"kept": 0.9}) == collapse_alarms({"kept": 0.9}, {"kept": np.nan}) == []
