"""What people fill in: blank sheets, every way to fill them in wrong, agreement, adjudication, doubts, audits."""

import csv
import json
from unittest.mock import Mock

import pytest

from experiments.bench.__main__ import AnnotateSheets, main
from experiments.core.artifacts import read_json, write_json
from sensors_io.records import RecordStore
from touchr1_jax.bench.items import write_items
from touchr1_jax.bench.people import annotate, audit
from touchr1_jax.bench.people.sheets import SheetError, read_sheet, write_sheet

OBJECTS = ("cup", "ball", "leaf", "brick")
SAME = {"cup": (0, 0, 0, 1), "ball": (1, 1, 1, 0), "leaf": (2, 2, 2, 7), "brick": (2, 0, 1, 4)}


def labels(**changes):
    rows = {o: changes.get(o, levels) for o, levels in SAME.items()}
    return {o: dict(zip(annotate.LEVELS, levels, strict=True)) for o, levels in rows.items()}


def fill(path, change):
    """Rewrite a sheet with what `change` makes of each row."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    path.unlink()
    write_sheet(path, list(rows[0]), [row | change(row) for row in rows])


def in_words(given):
    return lambda row: {name: annotate.WORDS[name][level] for name, level in given[row["object"]].items()}


def test_blank_sheets_hold_the_same_objects_in_other_orders(tmp_path):
    names = [f"o{n}" for n in range(30)]
    annotate.write_blank([tmp_path / "a.csv", tmp_path / "b.csv"], names, 0)
    a, b = ((tmp_path / f).read_text().splitlines()[1:] for f in ("a.csv", "b.csv"))
    assert sorted(a) == sorted(b)
    assert a != b
    assert a[0].endswith(",,,,")
    with pytest.raises(SheetError, match="may be filled in"):
        annotate.write_blank([tmp_path / "a.csv"], names, 0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,x\ncup,yes\n", r"lacks the columns \['object'\]"),
        ("object,x\ncup,yes\n", "lacks 1 rows, the first 'ball'"),
        ("object,x\ncup,yes\ncup,yes\n", "line 3: object 'cup' occurs twice"),
        ("object,x\ncat,yes\n", "line 2: object 'cat' is not asked for"),
        ("object,x\ncup,perhaps\nball,no\n", "x is 'perhaps': must be one of yes, no"),
        ("object,x\ncup\nball,no\n", "x is None"),
        ('object,x\ncup,"yes\n' + "ball,no\n" * 20_000, r"cannot be read \(field larger"),
    ],
)
def test_what_is_wrong_in_a_sheet_is_named(tmp_path, text, message):
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(SheetError, match=message):
        read_sheet(tmp_path / "s.csv", "object", {"x": ("yes", "no")}, ("cup", "ball"))


def test_agreement_by_hand():
    other = labels(cup=(1, 0, 0, 1))
    rows = {row.attribute: row for row in annotate.agreement(labels(), other)}
    assert rows["roughness"].kappa == 1.0
    assert rows["hardness"].exact == 0.75
    # observed .75; expected by the margins (1, 1, 2) and (0, 2, 2) of 4: (0 + 2 + 4) / 16
    assert rows["hardness"].kappa == pytest.approx((0.75 - 0.375) / (1 - 0.375))
    assert rows["material"].weighted is None
    constant = {o: dict.fromkeys(annotate.LEVELS, 0) for o in OBJECTS}
    assert annotate.agreement(constant, constant)[0].kappa is None


def test_disagreements_are_decided_by_a_third(tmp_path):
    a, b = labels(), labels(cup=(1, 0, 2, 1))
    assert list(annotate.open_cases(a, b).values()) == [("cup", "hardness"), ("cup", "protrusion")]
    path = tmp_path / "open.csv"
    annotate.write_open(path, a, b)
    assert "firm or soft" in path.read_text()
    with pytest.raises(SheetError, match="decision is ''"):
        annotate.read_decisions(path, a, b)
    fill(path, lambda row: {"decision": "firm" if "hardness" in row["case"] else "rough"})
    with pytest.raises(SheetError, match="'rough': must be one of flat, bumpy, protruding"):
        annotate.read_decisions(path, a, b)
    fill(path, lambda row: {"decision": "firm" if "hardness" in row["case"] else "flat"})
    final = annotate.adjudicate(a, b, annotate.read_decisions(path, a, b))
    assert final == labels(cup=(1, 0, 0, 1))


def test_labels_that_force_and_deformation_contradict_are_doubted(source):
    contacts = source.bench.contacts
    given = {c.touch.object: dict(c.labels) for c in contacts}
    assert annotate.doubtful_labels(given, contacts) == ()
    hard = next(o for o, levels in given.items() if levels["hardness"] == 2)
    given[hard]["hardness"] = 0
    (doubt,) = annotate.doubtful_labels(given, contacts)
    assert (doubt.object, doubt.attribute, doubt.label) == (hard, "hardness", "soft")
    assert doubt.sensors == ("tac3d", "xense")
    rho = annotate.rank_correlations(given, contacts)
    assert set(rho) == {(a, s) for a in annotate.PHYSICAL for s in ("tac3d", "xense")}
    assert min(rho.values()) > 0.8


def test_a_sample_hides_where_its_items_come_from(items, source, tmp_path):
    key = audit.sample(items, 40, 0)
    assert list(key)[:2] == ["01", "02"]
    assert len(set(key.values())) == 40
    audit.write_blank(tmp_path / "s.csv", items, key, source.bench.by_touch())
    text = (tmp_path / "s.csv").read_text()
    assert not any(name in text for name in key.values())
    assert (
        text.splitlines()[0]
        == "number,question,labels,measured,rationale,answer,grounded,fits the labels,self-consistent"
    )
    with pytest.raises(ValueError, match="count is 0"):
        audit.sample(items, 0, 0)


def test_pass_rates_by_hand(items, source, tmp_path):
    key = audit.sample(items, 40, 0)
    audit.write_blank(tmp_path / "s.csv", items, key, source.bench.by_touch())
    faulty = {"01": "grounded", "02": "self-consistent"}
    fill(
        tmp_path / "s.csv",
        lambda row: {axis: "no" if faulty.get(row["number"]) == axis else "Yes" for axis in audit.AXES},
    )
    judged = audit.read_judgement(tmp_path / "s.csv", key)
    rows = {row.axis: row for row in audit.pass_rates(judged, key, items)}
    assert rows["grounded"].rate.mean == 39 / 40
    assert rows["fits the labels"].rate.mean == 1
    assert rows["fits the labels"].rate.low < 0.95  # forty do not prove all
    assert rows["all three"].rate.mean == 38 / 40
    assert rows["all three"].by_object.low <= 0.95 <= rows["all three"].by_object.high
    agree = audit.judge_agreement(judged, {n: row | {"grounded": True} for n, row in judged.items()})
    assert agree == {"grounded": pytest.approx(0), "fits the labels": None, "self-consistent": 1.0}


def test_ctrl_c_leaves_no_traceback(monkeypatch):
    monkeypatch.setattr(AnnotateSheets, "run", Mock(side_effect=KeyboardInterrupt))
    assert main(["annotate-sheets", "records", "--out", "labels"]) == 130
    assert main(["annotate-sheets", "records", "--out", "s3://bucket/labels"]) == 2  # no folder of that name is made
    assert main(["annotate-sheets", "records", "--out", "labels", "--seed", "-1"]) == 2
    assert main(["annotate-sheets", "x" * 300, "--out", "labels"]) == 1


@pytest.mark.long
def test_annotation_by_command(tmp_path, records, capsys):
    folder, objects = tmp_path / "labels", RecordStore(records).objects
    assert main(["annotate-sheets", str(records), "--out", str(folder)]) == 0
    truth = {o: dict(card.labels) for o, card in objects.items()}
    odd = sorted(objects)[0]
    other = truth | {odd: truth[odd] | {"hardness": (truth[odd]["hardness"] + 1) % 3}}
    fill(folder / "a.csv", in_words(truth))
    fill(folder / "b.csv", in_words(other))
    assert main(["annotate", str(records), str(folder)]) == 1
    assert "1 labels differ" in capsys.readouterr().out
    assert main(["annotate", str(records), str(folder)]) == 1  # still open: one line says so
    assert "decision is ''" in capsys.readouterr().err
    fill(folder / "open.csv", lambda row: {"decision": annotate.WORDS["hardness"][truth[odd]["hardness"]]})
    assert main(["annotate", str(records), str(folder)]) == 0
    assert read_json(folder / "labels.json") == truth


@pytest.mark.parametrize("content", [None, b"\xff\xfe", b"[]", b'{"1": 2}', b'{"1": "another"}'])
def test_a_file_that_is_none_of_ours_is_named(items, tmp_path, capsys, content):
    """A key, a sheet or answers that are absent, no text, or something else: one line each, and exit status 1."""
    write_items(tmp_path / "q.jsonl", items[:3])
    (tmp_path / "key.json").write_text(json.dumps({"1": items[0].ask.id}))
    wrong = tmp_path / "wrong"
    if content is not None:
        wrong.write_bytes(content)
    for command in (
        ["audit", "q.jsonl", "wrong", "a.csv"],
        ["audit", "q.jsonl", "key.json", "wrong"],
        ["score", "q.jsonl", "wrong"],
    ):
        arguments = [command[0], *(str(tmp_path / name) for name in command[1:])]
        assert main(arguments) == 1
        said = capsys.readouterr().err
        assert "Error: " in said
        assert str(wrong) in said
        assert len(said.splitlines()) == 1


def test_audits_by_command(items, source, tmp_path, capsys):
    path, sheet, key = tmp_path / "items.jsonl", tmp_path / "s.csv", tmp_path / "s.key.json"
    write_items(path, items)
    sample = audit.sample(items, 20, 1)
    audit.write_blank(sheet, items, sample, source.bench.by_touch())
    fill(sheet, lambda row: dict.fromkeys(audit.AXES, "yes"))
    write_json(key, sample)
    assert main(["audit", str(path), str(key), str(sheet), str(sheet)]) == 1
    assert "must be of two judges" in capsys.readouterr().err
    second = tmp_path / "other.csv"
    second.write_bytes(sheet.read_bytes())
    assert main(["audit", str(path), str(key), str(sheet), str(second)]) == 0
    shown = capsys.readouterr().out
    assert "100.0 %" in shown
    assert "undefined" in shown


def test_a_sample_of_one_object_has_no_interval_and_is_named(items, source, tmp_path, capsys):
    path, sheet, key = tmp_path / "items.jsonl", tmp_path / "s.csv", tmp_path / "s.key.json"
    write_items(path, items)
    sample = audit.sample(items, 1, 1)
    audit.write_blank(sheet, items, sample, source.bench.by_touch())
    fill(sheet, lambda row: dict.fromkeys(audit.AXES, "yes"))
    write_json(key, sample)
    assert main(["audit", str(path), str(key), str(sheet)]) == 1
    assert "the sample's 1 items are of one object: must be of two" in capsys.readouterr().err


def test_no_command_replaces_what_a_person_needs(items, tmp_path, capsys):
    """The key of a sheet that is with a judge; candidates in the file that removed ones go to."""
    key, candidates = tmp_path / "s.key.json", tmp_path / "bench.rejected.jsonl"
    for path in (key, candidates):
        path.write_text("{}")
    write_items(tmp_path / "q.jsonl", items[:3])
    assert main(["audit-sheet", str(tmp_path / "q.jsonl"), "records", "--out", str(tmp_path / "s.csv")]) == 1
    assert "s.key.json exists, and its sheet needs it" in capsys.readouterr().err
    assert main(["accept", "records", str(candidates), "--out", str(tmp_path / "bench.jsonl")]) == 1
    assert "would be replaced by those that are removed" in capsys.readouterr().err
