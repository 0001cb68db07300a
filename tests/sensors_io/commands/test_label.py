"""Recorded objects get their labels from a table: what it says and nothing else, all of it or nothing."""

import dataclasses
import pickle

import numpy as np
import pytest

from sensors_io import cards, index
from sensors_io.__main__ import main
from sensors_io.cards import replace_cards
from sensors_io.commands import label as labelling
from sensors_io.records import RecordsError, RecordStore
from sensors_io.schema import SchemaError
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused


def label(root, table, *more):
    (root.parent / "labels.csv").write_text(table)
    return main(["label", str(root), "--labels", str(root.parent / "labels.csv"), "--annotator", "me", *more])


def bare(card):
    """What `record` stores of an object."""
    return type(card)(object_id=card.object_id, split="unlabelled", labels={}, annotator="nobody yet", view=card.view)


@pytest.fixture
def root(tmp_path):
    """Four objects with two contacts each, as they are after a recording."""
    path = fakes.write(tmp_path / "r", 8)
    replace_cards(path, map(bare, RecordStore(path).objects.values()))
    return path


def test_labels_come_from_the_table_and_everything_else_stays(root):
    before = RecordStore(root)
    digest = before.digest
    table = "object_id,hardness,material,split,name\nobject_0,2,wood,test,a block\nobject_2,,,train,\n"
    assert label(root, table) == 0
    after = RecordStore(root)
    block = after.objects["object_0"]
    assert (block.labels, block.split, block.name) == ({"hardness": 2, "material": 7}, "test", "a block")
    assert block.annotator == "me"
    np.testing.assert_array_equal(block.view, before.objects["object_0"].view)
    assert (after.objects["object_2"].labels, after.objects["object_2"].split) == ({}, "train")
    assert after.objects["object_1"].split == "unlabelled"
    assert label(root, "object_id,roughness,split\nobject_0,1,\nobject_1,1,unlabelled\n") == 0
    again = RecordStore(root).objects
    assert again["object_0"].labels == {"hardness": 2, "material": 7, "roughness": 1}
    assert again["object_1"].split == "unlabelled"
    assert list(after.objects) == list(before.objects)
    assert after.contacts == before.contacts
    assert after.digest != digest  # or what was trained on the old labels would be found again
    assert len(list(root.glob("objects-*"))) == 1
    np.testing.assert_array_equal(after.contact(3)["xense"].force_n, before.contact(3)["xense"].force_n)


def test_new_labels_are_dealt_out_and_old_splits_stay(root):
    ids = [f"object_{n}" for n in range(4)]
    table = "object_id,hardness\n" + "".join(f"{name},{n % 3}\n" for n, name in enumerate(ids))
    assert label(root, table, "--val-share", "0.25", "--test-share", "0.25") == 0
    splits = {name: card.split for name, card in RecordStore(root).objects.items()}
    assert sorted(splits.values()) == ["test", "train", "train", "val"]
    assert label(root, table.replace(",0", ",1"), "--val-share", "0", "--test-share", "0") == 0
    assert {name: card.split for name, card in RecordStore(root).objects.items()} == splits


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("object_id,hardness\ncup,1\n", "object_id is 'cup': must be an object of"),
        ("object_id,hardness\nobject_0,3\n", "hardness of 'object_0' is '3': must be one of 0, 1, 2 (from soft"),
        ("object_id,hardnes\nobject_0,1\n", "columns are ('object_id', 'hardnes'): must be object_id and any of"),
        ("object_id,hardness\nobject_0\n", "line 2: must have 2 cells"),
        ("object_id\nobject_0\nobject_0\n", "line 3: object_id 'object_0' appears twice"),
        ("", "columns are (): must be object_id"),
    ],
)
def test_a_bad_table_is_answered_and_changes_nothing(root, capsys, table, message):
    before = RecordStore(root).digest
    assert label(root, table) == 1
    assert message in capsys.readouterr().err
    assert RecordStore(root).digest == before


def test_a_kill_before_the_index_leaves_the_old_cards(root, monkeypatch):
    def killed(self, path):
        raise KeyboardInterrupt

    monkeypatch.setattr(cards.Index, "write", killed)
    with pytest.raises(KeyboardInterrupt):
        replace_cards(root, [fakes.card(0)])
    monkeypatch.undo()
    assert RecordStore(root).objects["object_0"].split == "unlabelled"
    assert label(root, "object_id,hardness\nobject_0,1\n") == 0
    assert RecordStore(root).objects["object_0"].labels == {"hardness": 1}
    said = r"object_id is 'object_7': .* holds object_0, object_1"
    refused(SchemaError, said, replace_cards, root, [fakes.card(7)])


def labelled_while_read(root, monkeypatch):
    """Have the objects labelled once, between reading the root of the index and what it names."""
    read, left = index.read_root, [1]

    def slow(path):
        found = read(path)
        if left:
            left.pop()
            replace_cards(root, [fakes.card(0, labels={"hardness": 2})])
        return found

    monkeypatch.setattr(index, "read_root", slow)


def test_records_that_are_labelled_while_they_are_opened_are_not_called_damaged(root, monkeypatch):
    labelled_while_read(root, monkeypatch)
    assert RecordStore(root).objects["object_0"].labels == {"hardness": 2}
    labelled_while_read(root, monkeypatch)
    assert index.Index.read(root).objects == [f"object_{n}" for n in range(4)]


def test_a_worker_that_opens_records_as_they_were_before_labels_says_so(root):
    store = pickle.dumps(RecordStore(root))
    replace_cards(root, [fakes.card(0)])
    refused(RecordsError, "its objects got other labels after it was opened; start again", pickle.loads, store)
    store = pickle.dumps(RecordStore(root))
    next(root.glob("objects-*")).unlink()
    refused(RecordsError, "is missing: copy it again from its source", pickle.loads, store)


def test_of_two_who_label_one_object_at_once_neither_loses_split_and_name(root, monkeypatch):
    read = labelling.read_labels

    def slow(*args):
        replace_cards(root, [dataclasses.replace(bare(fakes.card(0)), split="test", name="a block")])
        return read(*args)

    monkeypatch.setattr(labelling, "read_labels", slow)
    assert label(root, "object_id,roughness\nobject_0,1\n") == 0
    card = RecordStore(root).objects["object_0"]
    assert (card.labels, card.split, card.name) == ({"roughness": 1}, "test", "a block")
