"""What is asked: counts, balance, use of objects, pairs, and quotas that cannot be met."""

import collections
import dataclasses

import pytest

from experiments.bench.draw import Quota, QuotaError, draw
from experiments.bench.rules import true_answer
from tests.experiments.bench import made_up
from touchr1_jax.bench.comparison import ORDERS


def test_the_full_bench_has_4800_questions():
    assert Quota().total == 4800


def test_every_kind_has_its_quota(items, quota):
    counts = collections.Counter(item.ask.kind for item in items)
    assert counts == dataclasses.asdict(quota)


def test_answers_balance_to_one(items):
    for kind in ("identify", "scale", "conflict", "one_sensor"):
        cells = collections.defaultdict(collections.Counter)
        for item in items:
            if item.ask.kind == kind:
                cells[item.ask.attributes][item.ask.answer] += 1
        for attributes, counts in cells.items():
            step = len(made_up.SENSORS) if kind == "one_sensor" else 1
            assert max(counts.values()) - min(counts.values()) <= step, (kind, attributes, counts)


def test_composed_answers_balance_in_each_part(items):
    for part in range(2):
        counts = collections.Counter(
            item.ask.answer[part] for item in items if item.ask.attributes == ("hardness", "roughness")
        )
        assert max(counts.values()) - min(counts.values()) <= 1


def test_answers_are_those_of_the_labels(items, source):
    contacts = source.bench.by_touch()
    for item in items:
        assert true_answer(item.ask, [contacts[touch] for touch in item.ask.touches]) == item.ask.answer


def test_pairs_come_in_both_orders_and_lists_in_every_one(items):
    pairs = collections.defaultdict(list)
    for item in items:
        if item.ask.kind == "compare":
            pairs[item.ask.group].append(item.ask)
    assert all(
        [a.position for a in pair] == [0, 1]
        and pair[0].touches == pair[1].touches[::-1]
        and pair[0].answer[0] == 1 - pair[1].answer[0]
        for pair in pairs.values()
    )
    first = collections.Counter(pair[0].answer for pair in pairs.values())
    assert 0.3 < first[(0,)] / len(pairs) < 0.7  # the first order is drawn
    orders = collections.Counter(item.ask.answer[0] for item in items if item.ask.kind == "order")
    assert set(orders.values()) == {54 // len(ORDERS)}


def test_objects_are_used_alike(items):
    uses = collections.Counter(
        touch.object for item in items if item.ask.kind == "identify" for touch in item.ask.touches
    )
    assert len(uses) == 54
    assert max(uses.values()) - min(uses.values()) <= 2


def test_each_sensor_is_asked_alone(items):
    groups = collections.defaultdict(list)
    for item in items:
        if item.ask.kind == "one_sensor":
            groups[item.ask.group].append(item.ask)
    assert all([a.sensors for a in group] == [(s,) for s in made_up.SENSORS] for group in groups.values())
    assert all(len({(a.touches, a.phrasing) for a in group}) == 1 for group in groups.values())


def test_only_deceptive_objects_are_in_conflict(items):
    assert {item.ask.deceptive for item in items if item.ask.kind == "conflict"} == {True}


def test_another_seed_asks_other_questions(source, quota, items):
    again = draw(source.bench.contacts, source.sensors, quota, 0)
    other = draw(source.bench.contacts, source.sensors, quota, 1)
    assert again == tuple(item.ask for item in items)
    assert other != again


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"compare": 3}, "even"),
        ({"order": -1}, r"quota.order is -1"),
    ],
)
def test_impossible_quotas_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        Quota(**changes)


def test_quotas_that_the_contacts_do_not_allow_are_named(source, quota):
    few = [c for c in source.bench.contacts if c.touch.object == "test0"]
    only = lambda **counts: Quota(**dict.fromkeys(dataclasses.asdict(quota), 0) | counts)
    with pytest.raises(QuotaError, match=r"quota\.identify is too large: no contact is left to ask for hardness"):
        draw(few, made_up.SENSORS, only(identify=400), 0)
    with pytest.raises(QuotaError, match=r"quota\.compare is too large"):
        draw(few, made_up.SENSORS, only(compare=2), 0)
    with pytest.raises(QuotaError, match="multiple of the 2 sensors"):
        draw(few, made_up.SENSORS, only(one_sensor=3), 0)
    honest = [dataclasses.replace(c, deceptive=None) for c in few]
    with pytest.raises(QuotaError, match="no contact has a hardness to ask for"):
        draw(honest, made_up.SENSORS, only(conflict=4), 0)
