"""The held-out split: by object, independent of order, balanced, and never the last of a level."""

import collections

import hypothesis
import numpy as np
from hypothesis import strategies as st

from sensors_io.importers.holdout import hold_out, split_by_name
from sensors_io.schema import ATTRIBUTES, LEVELS
from tests.sensors_io.fakes import card


def cards(count, seed=0, split="train"):
    rng = np.random.default_rng(seed)
    return [
        card(
            n, split=split, labels={a: int(rng.integers(LEVELS[a])) for a in ATTRIBUTES}, view=None, view_depth_mm=None
        )
        for n in range(count)
    ]


def levels(cards, split):
    return collections.Counter((a, c.labels[a]) for c in cards if c.split == split for a in ATTRIBUTES)


@hypothesis.given(st.integers(0, 40), st.integers(0, 99), st.floats(0, 0.99))
def test_every_level_stays_in_train_and_nothing_else_moves(count, seed, share):
    before = [*cards(count, seed), card(90, split="val"), card(91, split="unlabelled", labels={})]
    after = hold_out(before, share)
    assert [c.object_id for c in after] == [c.object_id for c in before]
    assert [c.split for c in after[-2:]] == ["val", "unlabelled"]
    assert set(levels(after, "train")) == set(levels(before, "train"))
    assert sum(c.split == "test" for c in after) <= round(share * count)


def test_the_choice_does_not_depend_on_the_order_and_needs_all_labels():
    before = cards(40)
    chosen = [{c.object_id for c in hold_out(order, 0.2) if c.split == "test"} for order in (before, before[::-1])]
    assert chosen[0] == chosen[1]
    assert len(chosen[0]) == 8
    partly = [card(n, labels={"hardness": 1}) for n in range(9)]
    assert [c.split for c in hold_out(partly, 0.5)] == [c.split for c in partly]


def test_names_are_split_by_their_digest_alone():
    names = [f"session_{n}" for n in range(20)]
    splits = split_by_name(names, val_share=0.1, test_share=0.2)
    assert sorted(splits.values()) == ["test"] * 4 + ["train"] * 14 + ["val"] * 2
    assert split_by_name([*reversed(names), names[3]], val_share=0.1, test_share=0.2) == splits
    assert set(split_by_name(names[:2], val_share=0.1, test_share=0.2).values()) == {"train"}
