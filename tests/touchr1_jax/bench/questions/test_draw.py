"""Drawn questions: counts, balance, use of objects, pairs, and quotas that cannot be met."""

import collections
import dataclasses

import pytest

from tests.touchr1_jax.bench.questions.conftest import SENSORS
from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.questions.draw import Quota, QuotaError, draw
from touchr1_jax.bench.questions.rules import true_answer


def of_kind(items, kind):
    return [item.ask for item in items if item.ask.kind == kind]


def groups(items, kind):
    found = collections.defaultdict(list)
    for ask in of_kind(items, kind):
        found[ask.group].append(ask)
    return found.values()


def test_the_full_bench_has_4800_questions():
    assert Quota().total == 4800


def test_every_kind_has_its_quota(items, quota):
    assert collections.Counter(item.ask.kind for item in items) == dataclasses.asdict(quota)


@pytest.mark.parametrize(
    ("kind", "step"), [("identify", 1), ("scale", 1), ("conflict", 1), ("one_sensor", len(SENSORS))]
)
def test_answers_balance_to_one(items, kind, step):
    cells = collections.defaultdict(collections.Counter)
    for ask in of_kind(items, kind):
        cells[ask.attributes][ask.answer] += 1
    assert {max(counts.values()) - min(counts.values()) <= step for counts in cells.values()} == {True}


@pytest.mark.parametrize("part", [0, 1])
def test_composed_answers_balance_in_each_part(items, part):
    asks = [ask for ask in of_kind(items, "compose") if ask.attributes == ("hardness", "roughness")]
    counts = collections.Counter(ask.answer[part] for ask in asks)
    assert max(counts.values()) - min(counts.values()) <= 1


def test_answers_are_those_of_the_labels(items, source):
    contacts = source.bench.by_touch()
    for ask in (item.ask for item in items):
        assert true_answer(ask, [contacts[touch] for touch in ask.touches]) == ask.answer


def test_pairs_come_in_both_orders_and_lists_in_every_one(items):
    pairs = groups(items, "compare")
    for one, other in pairs:
        assert (one.position, other.position) == (0, 1)
        assert one.touches == other.touches[::-1]
        assert one.answer[0] == 1 - other.answer[0]
    first = collections.Counter(pair[0].answer for pair in pairs)
    assert 0.3 < first[(0,)] / len(pairs) < 0.7  # the first order is drawn
    orders = collections.Counter(ask.answer[0] for ask in of_kind(items, "order"))
    assert set(orders.values()) == {54 // len(ORDERS)}


def test_objects_are_used_alike(items):
    uses = collections.Counter(touch.object for ask in of_kind(items, "identify") for touch in ask.touches)
    assert len(uses) == 54
    assert max(uses.values()) - min(uses.values()) <= 2


def test_each_sensor_is_asked_alone(items):
    for asks in groups(items, "one_sensor"):
        assert [ask.sensors for ask in asks] == [(sensor,) for sensor in SENSORS]
        assert len({(ask.touches, ask.phrasing) for ask in asks}) == 1


def test_only_deceptive_objects_are_in_conflict(items):
    assert {ask.deceptive for ask in of_kind(items, "conflict")} == {True}


def test_another_seed_draws_other_questions(source, quota, items):
    drawn = [draw(source.bench.contacts, source.sensors, quota, seed) for seed in (0, 1)]
    assert drawn[0] == tuple(item.ask for item in items) != drawn[1]


@pytest.mark.parametrize(("changes", "message"), [({"compare": 3}, "even"), ({"order": -1}, r"quota.order is -1")])
def test_impossible_quotas_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        Quota(**changes)


@pytest.mark.parametrize(
    ("count", "deceptive", "message"),
    [
        ({"identify": 400}, True, r"quota\.identify is too large: no contact is left to ask for hardness"),
        ({"compare": 2}, True, r"quota\.compare is too large"),
        ({"one_sensor": 3}, True, "multiple of the 2 sensors"),
        ({"conflict": 4}, None, "no contact has a hardness to ask for"),
    ],
)
def test_quotas_that_the_contacts_do_not_allow_are_named(source, quota, count, deceptive, message):
    few = [c for c in source.bench.contacts if c.touch.object == "test0"]
    few = [dataclasses.replace(c, deceptive=deceptive) for c in few]
    with pytest.raises(QuotaError, match=message):
        draw(few, SENSORS, Quota(**dict.fromkeys(dataclasses.asdict(quota), 0) | count), 0)
