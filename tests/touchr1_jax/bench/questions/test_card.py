"""The data card: a sound bench passes, and each fault fails its own check."""

import dataclasses

import pytest

from touchr1_jax.bench.items import Item
from touchr1_jax.bench.questions import card


def failing(items, source, **changes) -> list[str]:
    made = dataclasses.replace(source, **changes)
    return [check.name for check in card.checks(items, made.bench, made.train) if not check.met]


def change(item: Item, **fields) -> Item:
    return dataclasses.replace(item, ask=dataclasses.replace(item.ask, **fields))


def test_a_sound_bench_passes(items, source):
    results = card.checks(items, source.bench, source.train)
    card.require(results)
    assert len(results) == 10


def test_a_training_object_in_the_bench_fails(items, source):
    leak = dataclasses.replace(source.train, contacts=source.train.contacts + source.bench.contacts[:1])
    assert failing(items, source, train=leak)[0] == "training objects in the bench"


def test_a_copy_under_another_name_fails(items, source):
    twin = dataclasses.replace(source.train.contacts[0], fingerprint=source.bench.contacts[0].fingerprint)
    leak = dataclasses.replace(source.train, contacts=(twin, *source.train.contacts[1:]))
    assert failing(items, source, train=leak) == ["contacts that equal a training contact"]


def test_an_object_of_nowhere_fails(items, source):
    gone = {item.ask.touches[0].object for item in items[:1]}
    less = dataclasses.replace(
        source.bench, contacts=tuple(c for c in source.bench.contacts if c.touch.object not in gone)
    )
    assert failing(items, source, bench=less) == ["objects that no label of the split knows"]


def test_a_question_asked_twice_fails(items, source):
    again = change(items[0], id="again")
    assert failing((*items, again), source) == ["questions asked twice"]


def test_a_pair_in_one_order_fails(items, source):
    lone = next(item for item in items if item.ask.kind == "compare")
    assert failing([item for item in items if item is not lone], source) == ["pairs not in both orders"]


def test_a_rationale_for_something_else_fails(items, source):
    odd = dataclasses.replace(items[0], rationale=items[-1].rationale)
    assert "rationales against the answer" in failing((odd, *items[1:]), source)


def test_objects_that_nobody_asks_about_fail(items, source):
    few = [i for i in items if all(t.object not in {f"test{n}" for n in range(6)} for t in i.ask.touches)]
    assert "objects never shown" in failing(few, source)


def test_a_common_answer_fails(items, source):
    """With the soft ones asked thrice, a constant beats chance and the training mode does too."""
    soft = [i for i in items if i.ask.kind == "scale" and i.ask.attributes == ("hardness",) and i.ask.answer == (0,)]
    more = [dataclasses.replace(change(i, id=f"{i.ask.id}-{n}"), question=f"{n}?") for i in soft for n in range(2)]
    failed = failing((*items, *more), source)
    assert "commonest answer over equal shares" in failed
    assert "training mode over chance" in failed


def test_a_wording_that_tells_fails(items, source):
    reworded = [change(item, phrasing=item.ask.answer[0]) if item.ask.kind == "scale" else item for item in items]
    assert failing(reworded, source) == ["best answer to each wording over chance"]


def test_every_failed_check_is_named(items, source):
    results = card.checks((*items, change(items[0], id="again")), source.bench, source.train)
    with pytest.raises(card.CardError, match="questions asked twice is 1 , must be ≤ 0"):
        card.require(results)
