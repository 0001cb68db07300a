"""Baselines without a policy, on contacts whose answers are known by hand."""

import dataclasses

import numpy as np
import pytest

from experiments.paper.baselines import Known, nearest, probed
from experiments.paper.features import Seen, other_objects
from touchr1_jax.training.evidence import ProbeConfig

LEVELS = (3,)


def seen(x, present=None) -> Seen:
    x = np.asarray(x, np.float32)
    return Seen(x=x, present=np.ones(x.shape[:2], bool) if present is None else np.asarray(present))


def two_streams(noise: float, seed: int = 0, n: int = 60) -> Known:
    """Stream 0 feels the level, stream 1 something else; both feel a constant too."""
    rng = np.random.default_rng(seed)
    label = np.arange(n)[:, None] % 3
    felt = np.stack([label[:, 0], np.arange(n) // 3 % 2], 1).astype(float)
    x = np.stack([felt, np.full((n, 2), 7.0)], 2)
    return Known(seen=seen(x + noise * rng.normal(size=x.shape)), label=label)


def test_the_nearest_contact_decides():
    known = Known(seen=seen([[[0.0]], [[1.0]], [[10.0]]]), label=np.array([[0], [1], [2]]))
    said = nearest(known, seen([[[0.2]], [[1.1]], [[7.0]]]), (3,), neighbours=1)
    assert said.together[:, 0].tolist() == [0, 1, 2]
    assert said.alone.shape == (3, 1, 1)


def test_neighbours_vote_by_one_over_their_distance():
    known = Known(seen=seen([[[0.0]], [[3.0]], [[3.0]]]), label=np.array([[0], [1], [1]]))
    at = lambda x: nearest(known, seen([[[x]]]), (2,), neighbours=3).together[0, 0]
    assert at(0.9) == 0  # 1/.9 against 2/2.1
    assert at(1.1) == 1  # 1/1.1 against 2/1.9


def test_a_feature_counts_by_its_spread_and_one_without_spread_does_not():
    x = [[[0.0, 0.0, 5.0]], [[1.0, 1000.0, 5.0]]]
    known = Known(seen=seen(x), label=np.array([[0], [1]]))
    assert nearest(known, seen([[[0.1, 600.0, 9.0]]]), (2,), neighbours=1).together[0, 0] == 0


def test_streams_that_are_not_shared_do_not_count():
    known = Known(
        seen=seen([[[0.0], [9.0]], [[1.0], [0.0]]], [[True, False], [True, True]]), label=np.array([[0], [1]])
    )
    asked = seen([[[0.1], [0.0]], [[0.0], [0.0]]], [[True, True], [False, False]])
    said = nearest(known, asked, (2,), neighbours=1)
    assert said.together[:, 0].tolist() == [0, -1]  # by the first stream alone; nothing was felt, nothing is said
    assert said.alone[:, :, 0].tolist() == [[0, 1], [-1, -1]]


def test_unannotated_contacts_do_not_vote():
    known = Known(seen=seen([[[0.0]], [[1.0]]]), label=np.array([[-1], [2]]))
    assert nearest(known, seen([[[0.0]]]), (3,)).together[0, 0] == 2
    with pytest.raises(ValueError, match=r"label\[:, 0\] is −1 throughout"):
        nearest(Known(seen=known.seen, label=np.full((2, 1), -1)), seen([[[0.0]]]), (3,))


def test_a_probe_reads_what_a_stream_says_and_nothing_of_one_that_is_not_there():
    known, asked = two_streams(noise=0.05), two_streams(noise=0.05, seed=1)
    felt = dataclasses.replace(known, seen=known.seen.only(0))
    present = np.arange(60)[:, None] > 0
    said = probed(felt, seen(asked.seen.only(0).x, present), LEVELS, ProbeConfig(iterations=20))
    assert np.array_equal(said.together[1:], asked.label[1:])
    assert np.array_equal(said.alone[:, 0], said.together)
    assert said.together[0, 0] == -1


def test_the_order_of_training_contacts_changes_nothing():
    known, asked = two_streams(noise=0.3), two_streams(noise=0.3, seed=1).seen
    order = np.random.default_rng(0).permutation(60)
    turned = Known(seen=known.seen.rows(order), label=known.label[order])
    assert np.array_equal(nearest(known, asked, LEVELS).together, nearest(turned, asked, LEVELS).together)


def test_strangers_are_of_another_object_and_all_come_up():
    objects = np.array(["a", "b", "a", "c", "b", "a"])
    drawn = np.stack([other_objects(objects, seed) for seed in range(200)])
    assert (objects[drawn] != objects).all()
    for i in range(6):
        assert set(drawn[:, i]) == set(np.flatnonzero(objects != objects[i]))
    with pytest.raises(ValueError, match="only"):
        other_objects(np.array(["a", "a"]), 0)


def test_the_touch_of_strangers_tells_nothing():
    known, asked = two_streams(noise=0.0, n=300), two_streams(noise=0.0, n=300, seed=1)
    objects = np.arange(300).astype(str)
    strange = Known(seen=known.seen.strangers(objects, 0), label=known.label)
    right = lambda k, a: (nearest(k, a, LEVELS).together == asked.label).mean()
    assert right(known, asked.seen) == 1
    assert right(strange, asked.seen.strangers(objects, 1)) < 0.45  # chance is a third
