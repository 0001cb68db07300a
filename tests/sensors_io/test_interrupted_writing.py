"""Writers that a signal, a full disk or a lost index interrupts: nothing is lost, counted twice or left crooked."""

import pytest

from sensors_io import index, records, tables
from sensors_io.index import Part
from sensors_io.records import RecordsExistError, RecordStore, RecordWriter
from sensors_io.schema import SchemaError
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused

SENSORS = ("gelsight_mini", "tac3d")


def contact(trial):
    return [fakes.sequence(0, sensor, trial=trial) for sensor in SENSORS]


def interrupted(monkeypatch, table):
    """The first append to a table fails, as on a full disk or at a signal; later ones succeed."""
    append = tables.GrowingFile.append

    def fail_once(self, root, data):
        if self.file == f"index.{table}":
            monkeypatch.setattr(tables.GrowingFile, "append", append)
            raise OSError("no space left")
        return append(self, root, data)

    monkeypatch.setattr(tables.GrowingFile, "append", fail_once)


@pytest.mark.parametrize("table", index.TABLES)
def test_a_failed_publication_is_made_up_for_and_leaves_no_table_ahead_of_another(tmp_path, monkeypatch, table):
    def write():
        with RecordWriter(tmp_path, meta=fakes.META) as writer:
            writer.write_object(fakes.card(0))
            writer.write_contact(contact(0))
            interrupted(monkeypatch, table)
            writer.publish()

    refused(OSError, "no space", write)
    store = RecordStore(tmp_path, allow_incomplete=True)
    assert (len(store), list(store.objects)) == (1, [fakes.card(0).object_id])
    with RecordWriter(tmp_path, meta=fakes.META, resume=True) as writer:
        writer.write_contact(contact(1))
    assert [store.contact(i)["tac3d"].key.trial for store in [RecordStore(tmp_path)] for i in range(2)] == [0, 1]


def test_a_writer_that_goes_on_after_a_failed_publication_overwrites_no_shard(tmp_path, monkeypatch):
    with RecordWriter(tmp_path, meta=fakes.META) as writer:
        writer.write_object(fakes.card(0))
        writer.write_contact(contact(0))
        interrupted(monkeypatch, "contacts")
        with pytest.raises(OSError, match="no space"):
            writer.publish()
        writer.write_contact(contact(1))
    store = RecordStore(tmp_path)
    assert [store.contact(i)["tac3d"].key.trial for i in range(len(store))] == [0, 1]


def test_shards_whose_index_was_lost_are_not_taken_for_remains(tmp_path):
    fakes.write(tmp_path / "r", 2)
    (tmp_path / "r" / "index.json").unlink()
    before = {path.name: path.read_bytes() for path in (tmp_path / "r").iterdir()}
    for resume in (False, True):
        with pytest.raises(RecordsExistError, match=r"but no index.json, which is written first: copy it back"):
            RecordWriter(tmp_path / "r", meta=fakes.META, resume=resume)
    assert {path.name: path.read_bytes() for path in (tmp_path / "r").iterdir()} == before


def test_a_writer_killed_before_its_first_root_states_the_shard_goes_on(tmp_path, monkeypatch):
    writer = RecordWriter(tmp_path, meta=fakes.META)
    writer.write_object(fakes.card(0))
    writer.write_contact(contact(0))
    monkeypatch.setattr(index.Index, "add_part", lambda *a: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        writer.publish()
    monkeypatch.undo()
    writer._lock.close()  # the process is gone
    assert not RecordStore(tmp_path, allow_incomplete=True).complete
    with RecordWriter(tmp_path, meta=fakes.META, resume=True) as writer:
        assert (writer.contacts_done, writer.objects_done) == (0, frozenset())
        writer.write_object(fakes.card(0))
        writer.write_contact(contact(0))
    assert len(RecordStore(tmp_path)) == 1


@pytest.mark.parametrize("twice", [False, True])
def test_a_part_that_is_refused_leaves_none_of_its_contacts_known(tmp_path, twice):
    name = fakes.card(0).object_id
    good, bad = (name, 0, 0, "press", ("tac3d",)), (name if twice else "nobody", 0, 0, "press", ("tac3d",))
    with RecordWriter(tmp_path, meta=fakes.META) as writer:
        writer.write_object(fakes.card(0))
        with pytest.raises(SchemaError, match="stored already" if twice else "has no card"):
            writer.adopt(Part(shard=(0, 2, 9), contacts=(good, bad), frames={}))
        assert writer.contacts_done == 0
        assert records.ContactKey(object_id=name, site=0, motion="press", trial=0) not in writer
