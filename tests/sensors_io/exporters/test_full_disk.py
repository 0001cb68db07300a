"""Exports and records on a disk that fills: one error with a name, no crash, nothing half-written, nothing lost."""

import errno
import gc
import io
import sys

import pytest

from sensors_io.__main__ import main
from sensors_io.commands.console import FIXES
from sensors_io.exporters import kept_file
from sensors_io.exporters.kept_file import KeptFile
from sensors_io.exporters.rerun import MOST_WAITS
from sensors_io.exporters.selection import ExportError
from tests.sensors_io import fakes


class Disk:
    """The file of a disk that has room for some bytes."""

    def __init__(self, path, room):
        self._file, self._room = path.open("w+b", buffering=0), room

    def __getattr__(self, name):
        return getattr(self._file, name)

    def write(self, data):
        room = max(self._room - self._file.tell(), 0)
        if not room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(bytes(data)[:room])


def small_disk(monkeypatch, room):
    """Every file that an HDF5 export writes lies on one."""
    made = KeptFile.__init__

    def on_it(self, path):
        made(self, path)
        self._file.close()
        self._file = Disk(path, room)

    monkeypatch.setattr(kept_file.KeptFile, "__init__", on_it)


def test_what_finds_no_room_is_kept_until_it_is_asked_for(tmp_path, monkeypatch):
    small_disk(monkeypatch, 10)
    with KeptFile(tmp_path / "x") as file:
        assert file.write(b"0123456") == 7
        file.require_written()
        assert file.write(b"789abc") == 6
        file.seek(2)
        file.write(b"XY")
        file.seek(0)
        assert file.read(100) == b"01XY456789abc"
        assert (file.seek(-3, io.SEEK_END), file.read(2), file.seek(0, io.SEEK_CUR)) == (10, b"ab", 12)
        with pytest.raises(ExportError, match=r"x cannot be written \(No space left on device\): free some space"):
            file.require_written()


@pytest.mark.parametrize("room", [0, 4000, 20_000])
def test_hdf5_on_a_full_disk_ends_in_one_line(tmp_path, monkeypatch, capfd, room):
    """The library alone would print a traceback for each object that it cannot close, and crash."""
    pytest.importorskip("h5py")
    records = fakes.write(tmp_path / "r", 2)
    out = tmp_path / "out"
    out.mkdir()
    with monkeypatch.context() as disk:
        small_disk(disk, room)
        assert main(["export", str(records), "--to", "hdf5", "--out", str(out / "x.h5")]) == 1
    assert capfd.readouterr().err.count("\n") == 1
    assert not list(out.iterdir())
    assert main(["export", str(records), "--to", "hdf5", "--out", str(out / "x.h5")]) == 0
    assert main(["import", "exported", str(out / "x.h5"), "--out", str(tmp_path / "back")]) == 0


@pytest.mark.long
def test_a_shard_that_finds_no_room_is_named(tmp_path, monkeypatch, capsys):
    """The writer of shards raises a bare RuntimeError."""
    from array_record.python.array_record_module import ArrayRecordWriter

    records = fakes.write(tmp_path / "r", 2)
    assert main(["export", str(records), "--to", "zarr", "--out", str(tmp_path / "x")]) == 0
    again = ["import", "exported", str(tmp_path / "x"), "--out", str(tmp_path / "back")]

    def full(self):
        raise RuntimeError("write() failed: No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(ArrayRecordWriter, "close", full)
        assert main(again) == 1
    said = capsys.readouterr().err
    assert "objects-00000.arrayrecord cannot be written (write() failed: No space left on device): free some" in said
    assert main(again) == 0


def test_rerun_on_a_full_disk_is_named(tmp_path, monkeypatch, capsys):
    """Without a limit the library may wait for ever, deaf to Ctrl-C; as long as the file grows, it is waited for."""
    rr = pytest.importorskip("rerun")
    waited = []

    def full(self, *, timeout_sec):
        waited.append(timeout_sec)
        if len(waited) < 3:
            next(tmp_path.glob("*.tmp")).write_bytes(bytes(10_000 * len(waited)))
        raise RuntimeError("File-writer thread shut down prematurely")

    monkeypatch.setattr(rr.RecordingStream, "flush", full)
    records = fakes.write(tmp_path / "r", 1)
    assert main(["export", str(records), "--to", "rerun", "--out", str(tmp_path / "x.rrd")]) == 1
    assert "cannot be written (File-writer thread shut down prematurely); free some space" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["r"]
    assert len(waited) == 2 + MOST_WAITS
    assert max(waited) < 60


def test_lerobot_on_a_full_disk_ends_in_one_line(tmp_path, monkeypatch, capsys):
    """The writer of tables would be closed, and fail, once more when it is freed: a traceback that nobody catches."""
    tables, _ = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("av")
    ignored, close = [], tables.ParquetWriter.close

    def full(self):
        if self.is_open:
            raise OSError(errno.ENOSPC, "No space left on device")
        close(self)

    records = fakes.write(tmp_path / "r", 1)
    with monkeypatch.context() as disk:
        disk.setattr(tables.ParquetWriter, "close", full)
        disk.setattr(sys, "unraisablehook", lambda hook: ignored.append(repr(hook.exc_value)))
        assert main(["export", str(records), "--to", "lerobot", "--out", str(tmp_path / "x")]) == 1
        gc.collect()
    assert "No space left on device" in capsys.readouterr().err
    assert ignored == []


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EMFILE, errno.ELOOP])
def test_errors_of_the_system_get_a_fix(tmp_path, monkeypatch, capsys, number):
    def fails(*args, **options):
        raise OSError(number, "the system's words")

    monkeypatch.setattr("sensors_io.commands.list.RecordStore", fails)
    assert main(["list", str(tmp_path)]) == 1
    assert f"the system's words: {FIXES[number]}\n" in capsys.readouterr().err
