"""Records on disk: what was written comes back, a killed writer loses no published contact, damage has a name."""

import dataclasses
import json
import os
import pathlib
import pickle
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from array_record.python.array_record_module import ArrayRecordReader, ArrayRecordWriter

from sensors_io import records, tables
from sensors_io.__main__ import main
from sensors_io.codec import CorruptRecordsError
from sensors_io.index import Index
from sensors_io.records import RecordsError, RecordStore, RecordWriter
from sensors_io.schema import SENSORS, SchemaError
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused


def shards(path):
    return sorted(path.glob("contacts-*.arrayrecord"))


def rewrite(shard, change):
    """Rewrite a shard with its list of entries changed, so that only the entries' own checks can notice."""
    reader = ArrayRecordReader(str(shard))
    entries = reader.read_all()
    reader.close()
    size = shard.stat().st_size
    writer = ArrayRecordWriter(str(shard), "group_size:1,uncompressed")
    for entry in change(entries):
        writer.write(entry)
    writer.close()
    index = Index.read(shard.parent)
    rows = np.array([(row["number"], row["entries"], shard.stat().st_size if row["bytes"] == size else row["bytes"])
                     for row in index.contact_shards], index.contact_shards.dtype)  # fmt: skip
    table = dataclasses.replace(index.tables["contact-shards"], size=0, crc32=0)
    index.tables["contact-shards"] = table.append(shard.parent, rows.tobytes())
    index.write(shard.parent)


@pytest.fixture
def path(tmp_path):
    return fakes.write(tmp_path / "r", 4, per_shard=2)


def test_a_data_set_comes_back_and_can_be_sent_to_a_worker(tmp_path):
    store = RecordStore(fakes.write(tmp_path / "r", 8))
    assert (len(store), store.complete, store.meta) == (8, True, fakes.META)
    assert store.frames == dict.fromkeys(SENSORS, 8 * 12)
    assert list(store.objects) == [f"object_{n}" for n in range(4)]
    for i in range(8):
        contact = pickle.loads(pickle.dumps(store)).contact(i)
        assert tuple(contact) == SENSORS == store.sensors_of(i)
        for sensor, got in contact.items():
            want = fakes.sequence(i // 2, sensor, trial=i % 2)
            assert got.key == want.key == store.contacts[i]
            np.testing.assert_array_equal(got.valid, want.valid)
            np.testing.assert_allclose(got.deformation_mm, want.deformation_mm, rtol=0, atol=5e-4)
            if want.frames is not None:
                np.testing.assert_array_equal(got.frames, want.frames)
    np.testing.assert_array_equal(store.objects["object_2"].view, fakes.card(2).view)


@pytest.mark.parametrize("name", ["two\nlines", os.fsdecode(b"latin-\xe9")], ids=["lines", "letters"])
def test_a_folder_that_the_format_cannot_name_is_named(tmp_path, name):
    """ArrayRecord would end reading with a TypeError."""
    moved = tmp_path / name
    refused(RecordsError, "is no path that records can have", fakes.write, moved, 1)
    assert not moved.exists()  # nothing is recorded that could not be stored
    fakes.write(tmp_path / "r", 1)
    shutil.copytree(tmp_path / "r", moved, dirs_exist_ok=True)
    refused(RecordsError, "rename its folder", lambda: RecordStore(moved).contact(0))


def test_splits_are_by_object_and_cover_everything(tmp_path):
    store = RecordStore(fakes.write(tmp_path / "r", 8))
    splits = {"train": [0, 1, 2, 3], "val": [4, 5], "test": [6, 7], "unlabelled": []}
    assert {name: store.contacts_of_split(name).tolist() for name in splits} == splits
    refused(SchemaError, "split is 'dev': must be one of train, val, test, unlabelled", store.contacts_of_split, "dev")


def test_a_contact_may_lack_sensors_and_notes_reach_the_meta(tmp_path):
    store = RecordStore(fakes.write(tmp_path / "r", 2, sensors=("tac3d", "xense")))
    assert store.sensors_of(0) == tuple(store.contact(0)) == ("tac3d", "xense")
    with RecordWriter(tmp_path / "s", meta=fakes.META) as writer:
        writer.note(report={"skipped": 3})
    assert RecordStore(tmp_path / "s").meta.notes == {"report": {"skipped": 3}}


def test_bad_input_is_refused_before_anything_is_written(tmp_path):
    digit = dataclasses.replace(fakes.sequence(0, trial=1), sensor="digit")
    with RecordWriter(tmp_path / "r", meta=fakes.META) as writer:
        writer.write_object(fakes.card(0))
        writer.write_contact([fakes.sequence(0)])
        for sequences, said in (
            ([], r"sequences is \[\]: a contact has at least one sequence"),
            ([fakes.sequence(0, trial=1), fakes.sequence(0, "xense", trial=2)], "share one key"),
            ([fakes.sequence(0, trial=1)] * 2, "each once"),
            ([fakes.sequence(0)], "stored already"),
            ([fakes.sequence(1)], "object 'object_1' has no card"),
            ([digit], "each once, out of gelsight_mini"),
            ([fakes.sequence(0, trial=1, length=0)], "no frames"),
        ):
            refused(SchemaError, said, writer.write_contact, sequences)
        refused(SchemaError, "object_id is 'object_0'", writer.write_object, fakes.card(0))
        said = "object_9: its settings cannot be stored as JSON"
        refused(SchemaError, said, writer.write_object, fakes.card(9, truth={"modulus_mpa": float("nan")}))
    assert len(RecordStore(tmp_path / "r")) == 1


class TestInterrupted:
    def test_an_exception_publishes_what_is_written_and_marks_it_incomplete(self, tmp_path, monkeypatch):
        def stop():
            with RecordWriter(tmp_path, meta=fakes.META) as writer:
                writer.write_object(fakes.card(0))
                writer.write_contact([fakes.sequence(0)])
                raise RuntimeError("stop")

        refused(RuntimeError, "stop", stop)
        refused(records.IncompleteRecordsError, "1 contacts and its writing has not ended", RecordStore, tmp_path)
        assert len(RecordStore(tmp_path, allow_incomplete=True)) == 1
        monkeypatch.setattr(ArrayRecordWriter, "write", lambda self, data: None)
        refused(records.RecordsError, "0 of 1 entries reached the disk", fakes.write, tmp_path / "full", 1)
        assert len(RecordStore(tmp_path / "full", allow_incomplete=True)) == 0
        assert not list((tmp_path / "full").glob(".objects-*.tmp"))

    def test_a_killed_writer_keeps_every_published_contact(self, tmp_path):
        code = f"""
import os, signal
from sensors_io.records import RecordWriter
from tests.sensors_io import fakes
writer = RecordWriter({str(tmp_path)!r}, meta=fakes.META, contacts_per_shard=2)
writer.write_object(fakes.card(0))
for i in range(5):
    writer.write_contact([fakes.sequence(0, trial=i)])
os.kill(os.getpid(), signal.SIGKILL)
"""
        done = subprocess.run([sys.executable, "-c", code], check=False, cwd=os.getcwd())
        assert done.returncode == -signal.SIGKILL
        [left] = tmp_path.glob(".contacts*.tmp")
        assert left.name.startswith(".contacts-00002.arrayrecord.")
        refused(records.IncompleteRecordsError, "4 contacts", RecordStore, tmp_path)
        (tmp_path / "contacts-00002.arrayrecord").write_bytes(b"published, never listed")
        with RecordWriter(tmp_path, meta=fakes.META, resume=True) as writer:
            assert (writer.contacts_done, writer.objects_done) == (4, {"object_0"})
            assert fakes.sequence(0, trial=3).key in writer
            assert fakes.sequence(0, trial=4).key not in writer
            assert (len(shards(tmp_path)), list(tmp_path.glob(".contacts*.tmp"))) == (2, [])
            writer.write_contact([fakes.sequence(0, trial=4)])
        assert [key.trial for key in RecordStore(tmp_path).contacts] == [0, 1, 2, 3, 4]

    def test_records_are_not_overwritten_mixed_or_shared(self, path):
        again = lambda **options: RecordWriter(path, **{"meta": fakes.META} | options)
        refused(records.RecordsExistError, r"holds 4 contacts of \d objects already .*or resume", again)
        other = dataclasses.replace(fakes.META, config_hash="beef")
        refused(records.RecordsExistError, "config 'c0ffee', not 'beef'", again, meta=other, resume=True)
        with again(resume=True):
            refused(records.RecordsExistError, "is being written by another process", again, resume=True)


def flipped(data, at=-5):
    """The same bytes, one of them with another lowest bit."""
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 or None :]


def index(text):
    return lambda path: (path / "index.json").write_text(text)


def shard(change):
    """Change the bytes of the first shard."""
    return lambda path: shards(path)[0].write_bytes(change(shards(path)[0].read_bytes()))


def swap_cards(path):
    """Let the two shards of cards, which are of one size, take each other's place."""
    first, second = sorted(path.glob("objects-*.arrayrecord"))
    (held := path / "held").write_bytes(first.read_bytes())
    second.replace(first)
    held.replace(second)


def root_of_table(file):
    """Let the root name a table elsewhere, which a writer that goes on would overwrite."""

    def change(path):
        root = json.loads((path / "index.json").read_text())
        del root["crc32"]
        root["tables"]["contacts"]["file"] = file
        (path / "index.json").write_text(json.dumps(root))

    return change


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        *((index(text), "index.json is damaged") for text in ("", "{", "[]", '{"format": "touchr1-records"}')),
        (index('{"format": "touchr1-records", "version": 4}'), "version 4, this code reads 'touchr1-records' versions"),
        *((shard(lambda data, n=n: data[:n]), r"00000.arrayrecord has \d+ bytes where \d+") for n in (0, 100, -1)),
        (shard(lambda data: flipped(data, len(data) // 4)), "00000.arrayrecord, entry .* copy the file"),
        (lambda path: rewrite(shards(path)[0], lambda es: map(flipped, es)), "entry 0: the entry's checksum does not"),
        (lambda path: rewrite(shards(path)[0], reversed), "entry 0 is object_0/0/press/1/dmtac_x, the index says"),
        (swap_cards, "the card is of object_1, the index says object_0"),
        *((root_of_table(file), "must be a name in its folder") for file in ("../index.contacts", "/index.contacts")),
    ],
)
def test_damage_is_named(path, damage, said):
    damage(path)
    refused(records.RecordsError, said, lambda: [RecordStore(path).contact(i) for i in range(2)])


def test_contacts_of_objects_that_no_table_names_are_not_left_out(tmp_path):
    found = Index.read(fakes.write(tmp_path / "data", 2))
    for objects, motions in (([], found.meta.sensors), (found.objects, ())):
        table = tables.ContactTable(found.contacts.rows, objects, found.meta.sensors, motions)
        refused(CorruptRecordsError, "contact 0 is of object 0 of", list, table)


def test_every_flipped_bit_of_the_index_is_found(tmp_path):
    fakes.write(tmp_path, 1)
    for path in sorted(tmp_path.glob("index.*")):
        whole = path.read_bytes()
        end = whole.index(b', "crc32"') if path.suffix == ".json" else len(whole)
        for i in range(end):
            for bit in (0, 7) if path.suffix == ".json" else (i % 8,):
                path.write_bytes(whole[:i] + bytes([whole[i] ^ (1 << bit)]) + whole[i + 1 :])
                with pytest.raises(records.RecordsError):
                    records.RecordStore(tmp_path)
        path.write_bytes(whole)
    assert len(records.RecordStore(tmp_path)) == 1


OLD = json.loads((pathlib.Path(__file__).parent / "index_of_version_2.json").read_text())
"""Written by the code before version 3 for the five contacts below."""


class TestOlderIndex:
    @pytest.fixture
    def old(self, tmp_path):
        """Records of version 2, as their writer left them."""
        fakes.write(tmp_path, 5)
        for table in tmp_path.glob("index.*"):
            table.unlink()
        shutil.copy(pathlib.Path(__file__).parent / "index_of_version_2.json", tmp_path / "index.json")
        return tmp_path

    def check(self, store):
        assert [(key.object_id, key.trial) for key in store.contacts] == [(f"object_{i // 2}", i % 2) for i in range(5)]
        assert store.frames == dict.fromkeys(SENSORS, 5 * 12)
        np.testing.assert_array_equal(store.contacts_of_split("val"), [4])
        for i in range(5):
            assert store.contacts.entries(i) == OLD["contacts"][i][4]
            got, want = store.contact(i)["xense"], fakes.sequence(i // 2, "xense", trial=i % 2)
            np.testing.assert_array_equal(got.frames, want.frames)

    def test_is_read_as_it_is_and_converted_by_one_command(self, old):
        before = {path: path.read_bytes() for path in old.iterdir()}
        self.check(RecordStore(old))
        assert {path: path.read_bytes() for path in old.iterdir()} == before
        for _ in range(2):  # the second time there is nothing to do
            assert main(["reindex", str(old)]) == 0
        assert json.loads((old / "index.json").read_text())["version"] == 3
        self.check(RecordStore(old))
        assert all(path.read_bytes() == data for path, data in before.items() if path.suffix == ".arrayrecord")

    def test_goes_on(self, old):
        """From version 1, without a checksum."""
        first = {name: x for name, x in OLD.items() if name != "crc32"} | {"version": 1}
        (old / "index.json").write_text(json.dumps(first))
        with RecordWriter(old, meta=fakes.META, resume=True) as writer:
            assert writer.contacts_done == 5
            writer.write_contact([fakes.sequence(2, sensor, trial=1) for sensor in SENSORS])
        store = RecordStore(old)
        assert len(store) == 6
        assert store.contact(5)["xense"].key == store.contacts[5]


class TestTables:
    @pytest.mark.parametrize("one_hash", [False, True])
    def test_a_contact_is_found_by_its_key(self, tmp_path, monkeypatch, one_hash):
        if one_hash:
            same = lambda *fields: fields[0] * np.uint64(0) + np.uint64(1 << 40)
            monkeypatch.setattr(tables, "_hashed", same)
        store = RecordStore(fakes.write(tmp_path, 8))
        assert [store.contacts.find(key) for key in store.contacts] == list(range(8))
        key = store.contacts[0]
        for other in ({"trial": 7}, {"site": 1}, {"motion": "slide_x"}, {"object_id": "object_9"}):
            assert store.contacts.find(dataclasses.replace(key, **other)) is None

    def test_what_was_appended_and_never_published_is_not_read(self, tmp_path):
        fakes.write(tmp_path, 4)
        before = (tmp_path / "index.contacts").read_bytes()
        (tmp_path / "index.contacts").write_bytes(before + b"torn")
        assert len(RecordStore(tmp_path)) == 4
        with RecordWriter(tmp_path, meta=fakes.META, resume=True) as writer:
            writer.write_object(fakes.card(9))
            writer.write_contact([fakes.sequence(9)])
        assert (tmp_path / "index.contacts").read_bytes()[: len(before)] == before
        assert RecordStore(tmp_path).contacts[4].object_id == "object_9"

    def test_more_shards_than_files_that_stay_open(self, tmp_path, monkeypatch):
        monkeypatch.setattr("sensors_io.shards._OPEN", 2)
        store = RecordStore(fakes.write(tmp_path, 6, per_shard=1))
        for i in [*range(6), *range(6)]:
            assert store.contact(i)["xense"].key == store.contacts[i]
        assert len(store._entries._open) == 2

    def test_a_pickled_store_keeps_its_contacts(self, tmp_path):
        fakes.write(tmp_path, 4)
        store = RecordStore(tmp_path)
        sent, digest = pickle.dumps(store), store.digest
        assert len(sent) < 4000
        with RecordWriter(tmp_path, meta=fakes.META, resume=True) as writer:
            writer.write_object(fakes.card(9))
            writer.write_contact([fakes.sequence(9)])
        assert len(pickle.loads(sent)) == 4
        assert pickle.loads(sent).digest == store.digest == digest != RecordStore(tmp_path).digest
