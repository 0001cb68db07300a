"""Beliefs that a policy observes: no object is read by what learned from it, and tokens keep what is believed."""

import numpy as np

from experiments.active.encoder import belief_scale, belief_tokens
from experiments.active.world import PROBE, crossed

OBJECTS, CHOICES, LEVELS = 9, 2, 3


def test_no_object_is_read_by_a_reader_that_learned_from_it():
    learned_from = []

    def read(learned, number):
        learned_from.append(set(learned.tolist()))
        scores = np.full((OBJECTS, CHOICES, 1, LEVELS), float(number))
        scores[..., 0] = np.isin(np.arange(OBJECTS), learned)[:, None, None]  # a learned object shows in level 0
        return scores

    objects = np.array([0, 2, 3, 5, 6, 8])
    found = crossed(read, objects)
    assert len(learned_from) == PROBE.folds
    assert all(set(objects.tolist()) > part for part in learned_from)
    assert set.intersection(*learned_from) == set()
    assert (found[objects, ..., 0] == 0).all()
    others = np.setdiff1d(np.arange(OBJECTS), objects)
    np.testing.assert_allclose(np.exp(found[others]).sum(-1), 1, rtol=1e-6)  # the mean of all readers, normalised


def test_tokens_name_their_property_and_keep_differences_of_log_probabilities():
    log_probs = np.log(np.random.default_rng(0).dirichlet(np.ones(LEVELS), (4, CHOICES, 5)))
    tokens = belief_tokens(log_probs, belief_scale(log_probs))
    assert tokens.shape == (4, CHOICES, 5, 5 + LEVELS)
    np.testing.assert_array_equal(tokens[1, 0, :, :5], np.eye(5))
    ratio = np.diff(tokens[..., 5:]) / np.diff(log_probs)
    np.testing.assert_allclose(ratio, ratio.flat[0], rtol=1e-4)
