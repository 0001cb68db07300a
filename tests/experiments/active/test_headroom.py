"""Plans of contacts: the exact optimum against a search over all plans, and what each kind of plan can use."""

import dataclasses
import itertools

import numpy as np
import pytest

from experiments.active.headroom import (
    BY_BELIEF,
    BY_QUESTION,
    EVERY,
    FIXED,
    RANDOM,
    Beliefs,
    Tree,
    belief_class,
    best_choices,
    best_sequence,
    best_tree,
    headroom,
    worth_of_tree,
)

SURELY, SLIGHTLY = np.log([0.9, 0.05, 0.05]), np.log([0.36, 0.32, 0.32])


def beliefs(shows, levels, objects=60, seed=0):
    """Beliefs of contacts of which `shows[c, a]` is true where choice c shows question a."""
    rng = np.random.default_rng(seed)
    label = rng.integers(levels, size=(objects, len(shows[0])))
    log_probs = np.empty((objects, len(shows), len(shows[0]), 3))
    for o, c, a in np.ndindex(log_probs.shape[:3]):
        log_probs[o, c, a] = np.roll(SURELY if shows[c][a] else SLIGHTLY, label[o, a] if shows[c][a] else 0)
    return Beliefs(log_probs, label)


TWO_QUESTIONS = beliefs([[True, False], [False, True], [False, False]], 3)


def test_one_contact_by_question_beats_any_contact_for_both():
    found = headroom(TWO_QUESTIONS, TWO_QUESTIONS, 2, 3)
    chance = [float((TWO_QUESTIONS.label[:, a] == 0).mean()) for a in (0, 1)]
    assert found[BY_QUESTION, 1].mean() == 1
    assert found[FIXED, 1].mean() == pytest.approx((1 + min(chance)) / 2, abs=abs(chance[0] - chance[1]))
    assert found[RANDOM, 1].mean() < found[FIXED, 1].mean() < 1
    assert found[FIXED, 2].mean() == found[EVERY, 0].mean() == 1  # the two contacts that show one question each


def test_look_ups_rank_choices():
    assert best_choices(TWO_QUESTIONS, [0], 1) == [0]
    assert best_choices(TWO_QUESTIONS, [1], 1) == [1]
    assert sorted(best_sequence(TWO_QUESTIONS, [0, 1], 2, 3)) == [0, 1]
    assert best_sequence(TWO_QUESTIONS, [1], 1, 3) == (1,)


def test_a_belief_is_classed_by_its_likeliest_level_and_by_how_sure_it_is():
    np.testing.assert_array_equal(belief_class(np.stack([SURELY, SLIGHTLY, np.roll(SURELY, 2)])), [1, 0, 5])
    np.testing.assert_array_equal(belief_class(np.stack([SURELY]) - 100), [1])


def gated(objects=90, seed=1):
    """One question: choice 0 shows which of choices 1 and 2 will show the level."""
    rng = np.random.default_rng(seed)
    label, side = rng.integers(3, size=objects), rng.integers(2, size=objects)
    log_probs = np.zeros((objects, 3, 1, 3))
    for o in range(objects):
        log_probs[o, 0, 0] = np.roll(SLIGHTLY, side[o])
        log_probs[o, 1 + side[o], 0] = np.roll(SURELY, label[o])
        log_probs[o, 2 - side[o], 0] = np.roll(SURELY, label[o] + 1)  # the wrong one misleads
    return Beliefs(log_probs, label[:, None])


def test_a_tree_uses_what_was_observed_and_no_sequence_can():
    both = gated()
    found = headroom(both, both, 2, 3)
    assert found[BY_BELIEF, 2].mean() == 1
    assert found[BY_QUESTION, 2].mean() < 0.7
    tree = best_tree(both, 0, [0, 1, 2], 2)
    assert tree.choice == 0
    assert (tree.after[0].choice, tree.after[2].choice) == (1, 2)


def test_a_tree_stops_where_a_contact_costs_more_than_it_is_worth():
    both = gated()
    free, dear = (dataclasses.replace(both, cost=np.full((90, 3), cost)) for cost in (0.1, 0.7))
    assert worth_of_tree(free, 0, best_tree(free, 0, [0, 1, 2], 2)).mean() == pytest.approx(0.8)
    tree = best_tree(dear, 0, [0, 1, 2], 2)
    assert not tree.after
    np.testing.assert_allclose(worth_of_tree(dear, 0, tree), dear.worth(0, (tree.choice,)))


@pytest.mark.long
def test_the_best_tree_is_the_best_of_all_trees():
    some = Beliefs(
        np.random.default_rng(5).normal(size=(20, 3, 1, 3)), np.random.default_rng(6).integers(3, size=(20, 1))
    )
    classes = range(6)
    every = (
        Tree(first, {k: Tree(c) for k, c in zip(classes, after, strict=True) if c is not None})
        for first in range(3)
        for after in itertools.product((None, 0, 1, 2), repeat=6)
    )
    best = max(worth_of_tree(some, 0, tree).sum() for tree in every)
    assert worth_of_tree(some, 0, best_tree(some, 0, [0, 1, 2], 2)).sum() == best
