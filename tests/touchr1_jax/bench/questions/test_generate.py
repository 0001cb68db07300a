"""Items worded by rule: thresholds, rationales, rules, planted errors, and the rules for any other author."""

import dataclasses

import numpy as np
import pytest

from tests.touchr1_jax.bench.questions.conftest import SENSORS
from touchr1_jax.bench.items import Ask, read_items, write_items
from touchr1_jax.bench.json_lines import LinesError
from touchr1_jax.bench.questions.generate import (
    author_requests,
    generate,
    read_candidates,
    rejected_rows,
    share_at_odds,
)
from touchr1_jax.bench.questions.rationales import compose_item
from touchr1_jax.bench.questions.rules import RULES, CandidateItem, apply_rules, broken_rule, count_found_errors
from touchr1_jax.bench.questions.thresholds import LevelThresholds, fit_thresholds
from touchr1_jax.bench.questions.wording import WORDINGS, answer_words, read_answer
from touchr1_jax.bench.scoring import score


@pytest.fixture(scope="module")
def contacts(source):
    return source.bench.by_touch()


@pytest.mark.parametrize(("rising", "levels"), [(True, [0, 1, 1, 2]), (False, [2, 1, 1, 0])])
def test_thresholds_by_hand(rising, levels):
    thresholds = LevelThresholds(quantity="stiffness", cuts=(3.0, 6.0), rising=rising, accuracy=1.0)
    assert [thresholds.read(v) for v in (2.9, 3.0, 5.9, 6.0)] == levels


def test_the_quantity_that_follows_the_level_is_found(source):
    wanted = {"hardness": "stiffness", "roughness": "fine texture", "protrusion": "relief"}
    for (_, attribute), thresholds in source.reader.thresholds.items():
        assert thresholds.quantity == wanted[attribute]
        assert thresholds.rising
        right = [source.reader.level(c, "xense", attribute) == c.labels[attribute] for c in source.train.contacts]
        assert np.mean(right) == pytest.approx(thresholds.accuracy)  # levels are equally common
        assert thresholds.accuracy > 0.9


def test_too_few_contacts_for_thresholds_are_named(source):
    with pytest.raises(ValueError, match="contacts holds 3"):
        fit_thresholds(source.train.contacts[:3])


def test_a_rationale_by_hand(contacts, items):
    item = next(i for i in items if i.ask.kind == "identify" and i.ask.attributes == ("hardness",))
    quantities = contacts[item.ask.touches[0]].measured["xense"].quantities
    assert f"xense stiffness {quantities['stiffness']:.3g} N/mm at {quantities['force']:.3g} N: " in item.rationale
    assert item.rationale.endswith(f"<conclude> {answer_words(item.ask)} </conclude>")
    cited = {(c.sensor, c.quantity, c.unit) for c in item.evidence}
    assert cited == {(sensor, *number) for sensor in SENSORS for number in (("stiffness", "N/mm"), ("force", "N"))}


def test_every_rationale_is_a_right_answer_in_the_language(items):
    answers = {}
    for item in items:
        reading, answers[item.ask.id] = read_answer(item.ask, item.rationale)
        assert reading.formatted
        assert answers[item.ask.id] == item.ask.answer
    table = {name: scores.mean() for name, scores in score([item.ask for item in items], answers).items()}
    assert table["omae"] == 0
    assert table["csc"] == table["sfd"] == table["l2_em"] == 100


def hardness_item(source, contact, quantities, reader):
    """An item about the hardness of a contact that measured other quantities."""
    measured = {s: dataclasses.replace(m, quantities=quantities(m.quantities)) for s, m in contact.measured.items()}
    ask = Ask(
        id="x", kind="identify", attributes=("hardness",), touches=(contact.touch,), sensors=("xense",), answer=(0,)
    )
    return compose_item(ask, {contact.touch: dataclasses.replace(contact, measured=measured)}, reader)


def test_the_force_response_is_cited_after_the_quantity_that_is_read(source):
    area = LevelThresholds(quantity="contact area", cuts=(5.0, 6.0), rising=True, accuracy=1.0)
    thresholds = {key: area if key[1] == "hardness" else old for key, old in source.reader.thresholds.items()}
    reader = dataclasses.replace(source.reader, thresholds=thresholds)
    item = hardness_item(source, source.bench.contacts[0], lambda known: known | {"contact area": 7.0}, reader)
    assert [c.quantity for c in item.evidence] == ["contact area", "stiffness", "force"]
    assert "xense contact area 7 %, stiffness " in item.rationale
    assert ": hard </perceive>" in item.rationale


def test_a_sensor_without_a_reading_is_cited_with_its_other_measurements(source):
    item = hardness_item(source, source.bench.contacts[0], lambda _: {"force": 1.5}, source.reader)
    wanted = "xense contact at 1.5 N: no reading of hardness </perceive> <compare> no reading </compare>"
    assert wanted in item.rationale
    assert [c.quantity for c in item.evidence] == ["force"]
    assert read_answer(item.ask, item.rationale)[1] == (0,)


def test_perceived_levels_are_those_of_the_thresholds(source, contacts, items):
    item = next(i for i in items if i.ask.kind == "compose")
    reading, _ = read_answer(item.ask, item.rationale)
    contact = contacts[item.ask.touches[0]]
    for sensor, name in enumerate(SENSORS, 1):  # their places in the language
        wanted = [
            source.reader.level(contact, name, a) if a in item.ask.attributes else -1
            for a in ("hardness", "roughness", "protrusion")
        ]
        assert [reading.perceive[sensor][a] for a in range(3)] == wanted


def test_numbers_that_do_not_give_the_answer_are_counted(items):
    assert 0 < share_at_odds(items) < 0.6
    assert share_at_odds([i for i in items if i.ask.kind == "compare"]) < 0.05  # levels lie far apart here


def test_no_word_depends_on_the_answer(items):
    questions = {}
    for item in items:
        key = (item.ask.kind, item.ask.attributes, item.ask.phrasing)
        assert questions.setdefault(key, item.question) == item.question
    assert {key[2] for key in questions} == set(range(WORDINGS))


@pytest.mark.long
def test_the_same_seed_gives_the_same_bytes(source, quota, found, tmp_path):
    for name, kept in (("a", found.kept), ("b", generate(source, quota, 0).kept)):
        write_items(tmp_path / name, kept)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert read_items(tmp_path / "a") == found.kept


def test_rules_remove_no_sound_item_and_all_planted_errors(contacts, found):
    assert found.counts == dict.fromkeys(RULES, 0)
    some = found.kept[::9]
    assert count_found_errors(some, contacts) == dict.fromkeys(RULES, len(some))


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"question": " "}, "missing answer"),
        ({"answer": "soft hard"}, "missing answer"),
        ({"rationale": "It is soft."}, "missing answer"),
        ({"evidence": ()}, "unmeasured"),
    ],
)
def test_a_missing_part_breaks_its_rule(contacts, items, change, rule):
    assert broken_rule(dataclasses.replace(CandidateItem.of(items[0]), **change), contacts) == rule


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"sensor": "dmtac_x"}, "outside contact"),
        ({"touch": 1}, "outside contact"),
        ({"touch": -1}, "outside contact"),
        ({"at": (0.71, 0.5)}, None),  # half a node outside the box
        ({"at": (0.75, 0.5)}, "outside contact"),
        ({"unit": "kg"}, "unmeasured"),
        ({"quantity": "warmth"}, "unmeasured"),
        ({"value": 1.005}, None),
        ({"value": 1.02}, "unmeasured"),
    ],
)
def test_evidence_must_be_of_the_shown_touches(contacts, items, change, rule):
    candidate = CandidateItem.of(items[0])
    cited = candidate.evidence[0]
    change = change | {"value": cited.value * change.get("value", 1)}
    changed = dataclasses.replace(candidate, evidence=(dataclasses.replace(cited, **change),))
    assert broken_rule(changed, contacts) == rule


def test_a_touch_that_the_records_lack_is_outside(items):
    assert broken_rule(CandidateItem.of(items[0]), {}) == "outside contact"


@pytest.mark.parametrize("labels", [lambda other: other, lambda other: {}], ids=["tie", "unlabelled"])
def test_changed_labels_conflict(contacts, items, labels):
    pair = next(i for i in items if i.ask.kind == "compare")
    one, other = pair.ask.touches
    changed = contacts | {one: dataclasses.replace(contacts[one], labels=labels(contacts[other].labels))}
    assert broken_rule(CandidateItem.of(pair), changed) == "label conflict"


def test_another_author_by_files(contacts, items):
    """Requests hold what is needed to write sound items; candidates come back in any number and order."""
    asks = [item.ask for item in items]
    sent = list(author_requests(asks, contacts))
    assert [r["id"] for r in sent] == [ask.id for ask in asks]
    assert sent[0]["touches"][0]["measured"]["xense"]["quantities"]["stiffness"]["unit"] == "N/mm"
    words = {r["id"]: r["answer"] for r in sent}
    rows = [
        {name: item.to_json()[name] for name in ("id", "rationale", "evidence")}
        | {"question": "Well?", "answer": words[item.ask.id]}
        for item in reversed(items[:40])
    ]
    rows[3]["answer"] = "no idea"
    back = apply_rules(read_candidates(enumerate(rows, 1), asks), contacts)
    assert len(back.kept) == 39
    assert back.counts["missing answer"] == 1
    (removed,) = rejected_rows(back.removed)
    assert (removed["id"], removed["rule"]) == (rows[3]["id"], "missing answer")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": "nobody"}, "line 1: id is 'nobody': must be that of an open request; use the records"),
        ({"extra": 1}, "line 1 has fields"),
        ({"evidence": [{"touch": 0}]}, "line 1"),
        ({"answer": 2}, "line 1"),
        ({}, "line 2.*answer each request once"),
    ],
)
def test_mistakes_of_another_author_are_named(items, change, message):
    row = {"id": items[0].ask.id, "question": "?", "answer": "x", "rationale": "y", "evidence": []} | change
    with pytest.raises(LinesError, match=message):
        list(read_candidates([(1, row), (2, row)], [item.ask for item in items]))
