"""Items worded by rule: readings, rationales, rules, faults, and what any other author must keep to."""

import dataclasses

import numpy as np
import pytest

from experiments.bench.generate import author_requests, generate, read_candidates, rejected_rows, share_at_odds
from experiments.bench.rationales import compose_item
from experiments.bench.rules import RULES, CandidateItem, apply_rules, broken_rule, count_found_errors
from experiments.bench.thresholds import LevelThresholds, fit_thresholds
from experiments.bench.wording import WORDINGS, answer_words, read_answer
from tests.experiments.bench import made_up
from touchr1_jax.bench.items import Ask, read_items, write_items
from touchr1_jax.bench.json_lines import LinesError
from touchr1_jax.bench.scoring import score


def test_cuts_by_hand():
    scale = LevelThresholds(quantity="stiffness", cuts=(3.0, 6.0), rising=True, accuracy=1.0)
    assert [scale.read(v) for v in (2.9, 3.0, 5.9, 6.0)] == [0, 1, 1, 2]
    falling = dataclasses.replace(scale, rising=False)
    assert [falling.read(v) for v in (2.9, 4.0, 7.0)] == [2, 1, 0]


def test_the_quantity_that_follows_the_level_is_found(source):
    wanted = {"hardness": "stiffness", "roughness": "fine texture", "protrusion": "relief"}
    for (_, attribute), scale in source.reader.thresholds.items():
        assert scale.quantity == wanted[attribute]
        assert scale.rising
        right = [source.reader.level(c, "xense", attribute) == c.labels[attribute] for c in source.train.contacts]
        assert np.mean(right) == pytest.approx(scale.accuracy)  # levels are as many each
        assert scale.accuracy > 0.9


def test_too_few_contacts_to_read_by_are_named(source):
    with pytest.raises(ValueError, match="contacts holds 3"):
        fit_thresholds(source.train.contacts[:3])


def test_a_rationale_by_hand(source, items):
    item = next(i for i in items if i.ask.kind == "identify" and i.ask.attributes == ("hardness",))
    contact = source.bench.by_touch()[item.ask.touches[0]]
    value = contact.measured["xense"].quantities["stiffness"]
    word = answer_words(item.ask)
    assert (
        f"xense stiffness {value:.3g} N/mm at {contact.measured['xense'].quantities['force']:.3g} N: " in item.rationale
    )
    assert item.rationale.endswith(f"<conclude> {word} </conclude>")
    cited = {(c.sensor, c.quantity, c.unit) for c in item.evidence}
    wanted = {("stiffness", "N/mm"), ("force", "N")}
    assert cited == {(sensor, *number) for sensor in made_up.SENSORS for number in wanted}


def test_every_rationale_is_an_answer_in_the_language(items):
    for item in items:
        reading, concluded = read_answer(item.ask, item.rationale)
        assert reading.formatted
        assert concluded == item.ask.answer
    answers = {item.ask.id: read_answer(item.ask, item.rationale)[1] for item in items}
    table = {name: scores.mean() for name, scores in score([item.ask for item in items], answers).items()}
    assert table["omae"] == 0
    assert table["csc"] == table["sfd"] == table["l2_em"] == 100


def test_other_numbers_stand_beside_the_one_that_is_read(source):
    """Where another quantity tells more of hardness, the force response is cited all the same."""
    contact = source.bench.contacts[0]
    wide = {
        s: dataclasses.replace(m, quantities=m.quantities | {"contact area": 7.0}) for s, m in contact.measured.items()
    }
    seen = dataclasses.replace(contact, measured=wide)
    scale = LevelThresholds(quantity="contact area", cuts=(5.0, 6.0), rising=True, accuracy=1.0)
    scales = {key: scale if key[1] == "hardness" else known for key, known in source.reader.thresholds.items()}
    ask = Ask(
        id="x", kind="identify", attributes=("hardness",), touches=(contact.touch,), sensors=("xense",), answer=(0,)
    )
    item = compose_item(ask, {contact.touch: seen}, dataclasses.replace(source.reader, thresholds=scales))
    assert [c.quantity for c in item.evidence] == ["contact area", "stiffness", "force"]
    assert "xense contact area 7 %, stiffness " in item.rationale
    assert ": hard </perceive>" in item.rationale


def test_a_sensor_that_cannot_be_read_still_says_what_it_measured(source):
    contact = source.bench.contacts[0]
    blunt = {s: dataclasses.replace(m, quantities={"force": 1.5}) for s, m in contact.measured.items()}
    ask = Ask(
        id="x", kind="identify", attributes=("hardness",), touches=(contact.touch,), sensors=("xense",), answer=(0,)
    )
    item = compose_item(ask, {contact.touch: dataclasses.replace(contact, measured=blunt)}, source.reader)
    assert (
        "xense contact at 1.5 N: no reading of hardness </perceive> <compare> no reading </compare>" in item.rationale
    )
    assert [c.quantity for c in item.evidence] == ["force"]
    assert read_answer(ask, item.rationale)[1] == (0,)


def test_perceived_levels_are_those_of_the_readings(source, items):
    item = next(i for i in items if i.ask.kind == "compose")
    reading, _ = read_answer(item.ask, item.rationale)
    contact = source.bench.by_touch()[item.ask.touches[0]]
    for sensor in (1, 2):  # xense and tac3d in the language
        said = [reading.perceive[sensor][a] for a in range(3)]
        name = ("", "xense", "tac3d")[sensor]
        wanted = [
            source.reader.level(contact, name, a) if a in item.ask.attributes else -1
            for a in ("hardness", "roughness", "protrusion")
        ]
        assert said == wanted


def test_numbers_that_do_not_say_the_answer_stay_and_are_counted(source, items):
    odd = share_at_odds(items)
    assert 0 < odd < 0.6
    assert share_at_odds(tuple(i for i in items if i.ask.kind == "compare")) < 0.05  # levels lie far apart here


def test_no_word_tells_the_answer(items):
    questions = {}
    for item in items:
        key = (item.ask.kind, item.ask.attributes, item.ask.phrasing)
        assert questions.setdefault(key, item.question) == item.question
    assert {key[2] for key in questions} == set(range(WORDINGS))


def test_the_same_seed_gives_the_same_bytes(source, quota, found, tmp_path):
    for name, kept in (("a", found.kept), ("b", generate(made_up.source(), quota, 0).kept)):
        write_items(tmp_path / name, kept)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert read_items(tmp_path / "a") == found.kept


def test_rules_remove_nothing_that_is_sound_and_all_planted_faults(source, found):
    assert not found.removed
    assert found.counts == dict.fromkeys(RULES, 0)
    some = found.kept[::9]
    assert count_found_errors(some, source.bench.by_touch()) == dict.fromkeys(RULES, len(some))


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"question": " "}, "missing answer"),
        ({"answer": "soft hard"}, "missing answer"),
        ({"rationale": "It is soft."}, "missing answer"),
        ({"evidence": ()}, "unmeasured"),
    ],
)
def test_what_is_missing_is_named(source, items, change, rule):
    candidate = dataclasses.replace(CandidateItem.of(items[0]), **change)
    assert broken_rule(candidate, source.bench.by_touch()) == rule


def test_evidence_must_be_of_what_is_shown(source, items):
    contacts, candidate = source.bench.by_touch(), CandidateItem.of(items[0])
    cited = candidate.evidence[0]
    for change, rule in (
        ({"sensor": "dmtac_x"}, "outside contact"),
        ({"touch": 1}, "outside contact"),
        ({"touch": -1}, "outside contact"),
        ({"at": (0.71, 0.5)}, None),  # half a node beside the box
        ({"at": (0.75, 0.5)}, "outside contact"),
        ({"unit": "kg"}, "unmeasured"),
        ({"quantity": "warmth"}, "unmeasured"),
        ({"value": cited.value * 1.005}, None),
    ):
        changed = dataclasses.replace(candidate, evidence=(dataclasses.replace(cited, **change),))
        assert broken_rule(changed, contacts) == rule, change
    assert broken_rule(candidate, {}) == "outside contact"  # a touch that the records do not hold


def test_labels_that_changed_or_tie_conflict(source, items):
    contacts = source.bench.by_touch()
    pair = next(i for i in items if i.ask.kind == "compare")
    name, (one, other) = pair.ask.attributes[0], pair.ask.touches
    tied = contacts | {one: dataclasses.replace(contacts[one], labels=contacts[other].labels)}
    assert broken_rule(CandidateItem.of(pair), tied) == "label conflict"
    unlabelled = contacts | {one: dataclasses.replace(contacts[one], labels={})}
    assert broken_rule(CandidateItem.of(pair), unlabelled) == "label conflict"
    assert name in contacts[one].labels


def test_another_author_by_files(source, items):
    """Requests hold what is needed to write sound items; candidates come back in any number and order."""
    asks, contacts = [item.ask for item in items], source.bench.by_touch()
    sent = list(author_requests(asks, contacts))
    assert [r["id"] for r in sent] == [ask.id for ask in asks]
    first = sent[0]["touches"][0]["measured"]["xense"]
    assert first["quantities"]["stiffness"]["unit"] == "N/mm"
    rows = [
        (
            n,
            {
                "id": i.ask.id,
                "question": "Well?",
                "answer": answer_words(i.ask),
                "rationale": i.rationale,
                "evidence": i.to_json()["evidence"],
            },
        )
        for n, i in enumerate(reversed(items[:40]), 1)
    ]
    rows[3][1]["answer"] = "no idea"
    back = apply_rules(read_candidates(rows, asks), contacts)
    assert len(back.kept) == 39
    assert back.counts["missing answer"] == 1
    (removed,) = rejected_rows(back.removed)
    assert (removed["id"], removed["rule"]) == (rows[3][1]["id"], "missing answer")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": "nobody"}, "line 1: id is 'nobody': must be that of an open request; use the records"),
        ({"extra": 1}, "line 1 has fields"),
        ({"evidence": [{"touch": 0}]}, "line 1"),
        ({"answer": 2}, "line 1"),
    ],
)
def test_what_another_author_gets_wrong_is_named(items, change, message):
    row = {"id": items[0].ask.id, "question": "?", "answer": "x", "rationale": "y", "evidence": []} | change
    with pytest.raises(LinesError, match=message):
        list(read_candidates([(1, row)], [item.ask for item in items]))


def test_a_request_is_answered_once(items):
    row = {"id": items[0].ask.id, "question": "?", "answer": "x", "rationale": "y", "evidence": []}
    with pytest.raises(LinesError, match="answer each request once"):
        list(read_candidates([(1, row), (2, row)], [items[0].ask]))
