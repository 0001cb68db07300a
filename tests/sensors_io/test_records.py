"""Records on disk: what was written comes back, a killed writer loses no published contact, damage has a name."""

import dataclasses
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from array_record.python.array_record_module import ArrayRecordReader, ArrayRecordWriter

from sensors_io import records
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
    index = json.loads((shard.parent / "index.json").read_text())
    del index["crc32"]
    text = json.dumps(index).replace(f'"bytes": {size}', f'"bytes": {shard.stat().st_size}')
    (shard.parent / "index.json").write_text(text)


def test_a_data_set_comes_back(tmp_path):
    store = RecordStore(fakes.write(tmp_path / "r", 8))
    assert len(store) == 8
    assert store.complete
    assert store.meta == fakes.META
    assert store.frames == dict.fromkeys(SENSORS, 8 * 12)
    assert list(store.objects) == [f"object_{n}" for n in range(4)]
    for i in range(8):
        contact = store.contact(i)
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
    fakes.write(tmp_path / "r", 1)
    shutil.copytree(tmp_path / "r", moved, dirs_exist_ok=True)
    refused(RecordsError, "rename its folder", lambda: RecordStore(moved).contact(0))


def test_splits_are_by_object_and_cover_everything(tmp_path):
    store = RecordStore(fakes.write(tmp_path / "r", 8))
    np.testing.assert_array_equal(store.contacts_of_split("train"), [0, 1, 2, 3])
    np.testing.assert_array_equal(store.contacts_of_split("val"), [4, 5])
    np.testing.assert_array_equal(store.contacts_of_split("test"), [6, 7])
    assert store.contacts_of_split("unlabelled").shape == (0,)
    refused(SchemaError, "split is 'dev': must be one of train, val, test, unlabelled", store.contacts_of_split, "dev")


def test_a_store_can_be_sent_to_a_worker(tmp_path):
    store = RecordStore(fakes.write(tmp_path / "r", 2))
    store.contact(0)
    copy = pickle.loads(pickle.dumps(store))
    np.testing.assert_array_equal(copy.contact(1)["xense"].frames, store.contact(1)["xense"].frames)


def test_a_contact_may_lack_sensors_and_notes_reach_the_meta(tmp_path):
    store = RecordStore(fakes.write(tmp_path / "r", 2, sensors=("tac3d", "xense")))
    assert store.sensors_of(0) == tuple(store.contact(0)) == ("tac3d", "xense")
    with RecordWriter(tmp_path / "s", meta=fakes.META) as writer:
        writer.note(report={"skipped": 3})
    assert RecordStore(tmp_path / "s").meta.notes == {"report": {"skipped": 3}}


class TestBadInput:
    @pytest.fixture
    def writer(self, tmp_path):
        with RecordWriter(tmp_path / "r", meta=fakes.META) as writer:
            writer.write_object(fakes.card(0))
            writer.write_contact([fakes.sequence(0)])
            yield writer
        assert len(RecordStore(tmp_path / "r")) == 1

    @pytest.mark.parametrize(
        ("sequences", "message"),
        [
            ([], r"sequences is \[\]: a contact has at least one sequence"),
            ([fakes.sequence(0, trial=1), fakes.sequence(0, "xense", trial=2)], "share one key"),
            ([fakes.sequence(0, trial=1)] * 2, "each once"),
            ([fakes.sequence(0)], "stored already"),
            ([fakes.sequence(1)], "object 'object_1' has no card"),
            ([dataclasses.replace(fakes.sequence(0, trial=1), sensor="digit")], "each once, out of gelsight_mini"),
            ([fakes.sequence(0, trial=1, length=0)], "no frames"),
        ],
        ids=["empty", "keys", "twice", "stored", "card", "sensor", "length"],
    )
    def test_a_bad_contact_is_refused_before_anything_is_written(self, writer, sequences, message):
        refused(SchemaError, message, writer.write_contact, sequences)
        assert writer.contacts_done == 1

    def test_an_object_is_stored_once(self, writer):
        refused(SchemaError, "object_id is 'object_0'", lambda: writer.write_object(fakes.card(0)))
        with pytest.raises(SchemaError, match="object_9: its settings cannot be stored as JSON"):
            writer.write_object(fakes.card(9, truth={"modulus_mpa": float("nan")}))


class TestInterrupted:
    def contacts(self, start=0):
        return [[fakes.sequence(0, s, trial=i) for s in ("gelsight_mini", "tac3d")] for i in range(start, 7)]

    def test_an_exception_publishes_what_is_written_and_marks_it_incomplete(self, tmp_path):
        def stop_after_two():
            with RecordWriter(tmp_path, meta=fakes.META) as writer:
                writer.write_object(fakes.card(0))
                for contact in self.contacts()[:2]:
                    writer.write_contact(contact)
                raise RuntimeError("stop")

        refused(RuntimeError, "stop", stop_after_two)
        refused(records.IncompleteRecordsError, "2 contacts and its writing has not ended", RecordStore, tmp_path)
        assert len(RecordStore(tmp_path, allow_incomplete=True)) == 2

    def test_resumed_equals_uninterrupted(self, tmp_path):
        with RecordWriter(tmp_path / "whole", meta=fakes.META, contacts_per_shard=2) as writer:
            writer.write_object(fakes.card(0))
            for contact in self.contacts():
                writer.write_contact(contact)
        for stop in (1, 2, 5, 7):
            with RecordWriter(tmp_path / "parts", meta=fakes.META, contacts_per_shard=2, resume=True) as writer:
                if not writer.objects_done:
                    writer.write_object(fakes.card(0))
                for contact in self.contacts(writer.contacts_done)[: stop - writer.contacts_done]:
                    assert contact[0].key not in writer
                    writer.write_contact(contact)
        whole, parts = RecordStore(tmp_path / "whole"), RecordStore(tmp_path / "parts")
        assert whole.contacts == parts.contacts
        assert whole.frames == parts.frames
        for i in range(7):
            for sensor, sequence in whole.contact(i).items():
                np.testing.assert_array_equal(sequence.depth_mm, parts.contact(i)[sensor].depth_mm)

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
        assert [p.name for p in tmp_path.glob(".contacts*.tmp")] == [".contacts-00002.arrayrecord.tmp"]
        assert len(RecordStore(tmp_path, allow_incomplete=True)) == 4
        with RecordWriter(tmp_path, meta=fakes.META, resume=True) as writer:
            assert writer.contacts_done == 4
            assert writer.objects_done == {"object_0"}
            assert not list(tmp_path.glob(".contacts*.tmp"))
            writer.write_contact([fakes.sequence(0, trial=4)])
        assert [key.trial for key in RecordStore(tmp_path).contacts] == [0, 1, 2, 3, 4]

    def test_remains_of_a_killed_writer_are_removed(self, tmp_path):
        fakes.write(tmp_path, 4, per_shard=2)
        (tmp_path / ".contacts-00002.arrayrecord.tmp").write_bytes(shards(tmp_path)[0].read_bytes()[:1000])
        (tmp_path / "contacts-00002.arrayrecord").write_bytes(b"published, never listed")
        with RecordWriter(tmp_path, meta=fakes.META, resume=True) as writer:
            assert writer.contacts_done == 4
        assert len(shards(tmp_path)) == 2
        assert len(RecordStore(tmp_path)) == 4

    def test_records_are_not_overwritten_mixed_or_shared(self, tmp_path):
        fakes.write(tmp_path, 2)
        with pytest.raises(
            records.RecordsExistError, match=r"holds 2 contacts of \d objects already .*choose another path, or resume"
        ):
            RecordWriter(tmp_path, meta=fakes.META)
        other = records.RecordsMeta(source="fake", licence="none", config_hash="beef", sensors=SENSORS)
        with pytest.raises(
            records.RecordsExistError, match=r"contacts of .*complete, last written .*config 'c0ffee', not 'beef'"
        ):
            RecordWriter(tmp_path, meta=other, resume=True)
        with (
            RecordWriter(tmp_path, meta=fakes.META, resume=True),
            pytest.raises(records.RecordsExistError, match="is being written by another process"),
        ):
            RecordWriter(tmp_path, meta=fakes.META, resume=True)

    def test_a_shard_that_did_not_reach_the_disk_is_not_published(self, tmp_path, monkeypatch):
        monkeypatch.setattr(ArrayRecordWriter, "write", lambda self, data: None)
        with pytest.raises(records.RecordsError, match="0 of 1 entries reached the disk; check its free space"):
            fakes.write(tmp_path / "r", 1)
        assert not (tmp_path / "r" / "index.json").exists()


class TestDamage:
    @pytest.fixture
    def path(self, tmp_path):
        return fakes.write(tmp_path / "r", 4, per_shard=2)

    def test_no_index(self, tmp_path):
        refused(records.MissingIndexError, f"{tmp_path} has no index.json: give the directory", RecordStore, tmp_path)

    @pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"format": "touchr1-records", "version": 1}'])
    def test_a_damaged_index(self, path, text):
        (path / "index.json").write_text(text)
        refused(records.CorruptRecordsError, r"index.json is damaged", RecordStore, path)

    def test_another_version(self, path):
        text = (path / "index.json").read_text().replace('"version":2', '"version":3')
        (path / "index.json").write_text(text)
        refused(records.RecordsVersionError, "version 3, this code reads 'touchr1-records' versions", RecordStore, path)

    def test_a_missing_shard(self, path):
        shards(path)[1].unlink()
        refused(records.CorruptRecordsError, r"contacts-00001.arrayrecord is missing: copy it again", RecordStore, path)

    @pytest.mark.parametrize("keep", [0, 100, -1])
    def test_a_truncated_shard(self, path, keep):
        shard = shards(path)[1]
        shard.write_bytes(shard.read_bytes()[:keep])
        refused(records.CorruptRecordsError, r"contacts-00001.arrayrecord has \d+ bytes where \d+", RecordStore, path)

    def test_bytes_flipped_on_disk(self, path):
        shard = shards(path)[0]
        data = bytearray(shard.read_bytes())
        data[len(data) // 4] ^= 255
        shard.write_bytes(data)
        store = RecordStore(path)
        with pytest.raises(records.CorruptRecordsError, match=r"contacts-00000.arrayrecord, entry .* copy the file"):
            [store.contact(i) for i in range(2)]
        store.contact(2)  # the other shard is untouched

    def test_an_entry_whose_checksum_does_not_hold(self, path):
        rewrite(shards(path)[0], lambda entries: [e[:-5] + bytes([e[-5] ^ 1]) + e[-4:] for e in entries])
        with pytest.raises(records.CorruptRecordsError, match="entry 0: the entry's checksum does not hold"):
            RecordStore(path).contact(0)

    def test_an_entry_that_belongs_elsewhere(self, path):
        rewrite(shards(path)[0], lambda entries: entries[::-1])
        with pytest.raises(records.CorruptRecordsError, match=r"entry 0 is object_0/0/press/1/dmtac_x, the index says"):
            RecordStore(path).contact(0)


def test_every_flipped_bit_of_the_index_is_found(tmp_path):
    fakes.write(tmp_path, 1)
    path = tmp_path / "index.json"
    whole = path.read_bytes()
    end = whole.index(b', "crc32"')
    for i in range(end):
        for bit in (0, 4, 7):
            path.write_bytes(whole[:i] + bytes([whole[i] ^ (1 << bit)]) + whole[i + 1 :])
            with pytest.raises(records.RecordsError):
                records.RecordStore(tmp_path)
