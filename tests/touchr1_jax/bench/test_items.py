"""The format of items: round trip, and every way to break it named."""

import json

import pytest

from tests.touchr1_jax.bench.sample_items import A, B, item, items
from touchr1_jax.bench.items import FORMAT, KINDS, Item, ItemError, read_items, write_items
from touchr1_jax.bench.json_lines import LinesError, read_lines, write_lines


def test_items_come_back_as_they_were(tmp_path):
    path = tmp_path / "items.jsonl"
    write_items(path, items())
    assert read_items(path) == items()
    assert {i.ask.kind for i in items()} == set(KINDS)
    first = path.read_bytes()
    write_items(path, read_items(path))
    assert path.read_bytes() == first
    assert [p.name for p in tmp_path.iterdir()] == ["items.jsonl"]


def test_a_line_says_what_it_is():
    tree = items()[0].to_json()
    assert (tree["format"], tree["tier"], tree["view"]) == (FORMAT, 1, True)
    assert tree["touches"] == [{"object": "a", "site": 0, "motion": "press", "trial": 0}]


@pytest.mark.parametrize(
    ("kind", "answer", "fields", "message"),
    [
        ("riddle", (0,), {}, "kind is 'riddle'"),
        ("compare", (0,), {}, "touches is 1: must be 2"),
        ("compare", (2,), {"touches": (A, B)}, "1 numbers ≥ 0 below 2"),
        ("identify", (0, 1), {}, r"answer is \[0, 1\]"),
        ("identify", (-1,), {}, r"answer is \[-1\]"),
        ("identify", (0,), {"sensors": ()}, "sensors"),
        ("identify", (0,), {"id": ""}, "id"),
    ],
)
def test_what_cannot_be_asked_is_named(kind, answer, fields, message):
    with pytest.raises(ItemError, match=message):
        item(kind, answer, **fields)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other/1"}, "format is 'other/1'"),
        ({"tier": 4}, "h: tier is 4"),
        ({"colour": 1}, r"fields is \['colour'\]"),
        ({"touches": [{"object": "a"}]}, "missing"),
        ({"evidence": [{"touch": 0}]}, "missing"),
        ({"question": " "}, "question"),
    ],
)
def test_a_broken_line_is_named(tmp_path, change, message):
    path = tmp_path / "items.jsonl"
    write_lines(path, [items()[1].to_json(), items()[0].to_json() | change])
    with pytest.raises(ItemError, match=message) as error:
        read_items(path)
    assert "line 2" in str(error.value)


def test_a_missing_field_is_named():
    tree = items()[0].to_json()
    del tree["phrasing"]
    with pytest.raises(ItemError, match="phrasing"):
        Item.from_json(tree)


def test_a_file_without_items_is_named(tmp_path):
    """Their scores would be shares of nothing."""
    (tmp_path / "i.jsonl").write_text("")
    with pytest.raises(ItemError, match=r"number of items is 0: must be ≥ 1 in .*jsonl; write them first"):
        read_items(tmp_path / "i.jsonl")


def test_ids_are_unique(tmp_path):
    write_items(tmp_path / "i.jsonl", [items()[0], items()[0]])
    with pytest.raises(ItemError, match="id is 'h': must be unique"):
        read_items(tmp_path / "i.jsonl")


@pytest.mark.parametrize("line", ["{", "[1]"])
def test_a_line_that_is_no_object_is_named(tmp_path, line):
    (tmp_path / "x.jsonl").write_text(json.dumps({}) + "\n\n" + line)
    with pytest.raises(LinesError, match="line 3"):
        read_lines(tmp_path / "x.jsonl")
