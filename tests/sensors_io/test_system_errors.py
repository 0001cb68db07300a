"""Files that cannot be read here and now are not called damaged: nobody deletes, or leaves out, what is whole."""

import errno
import fcntl
import pathlib

import numpy as np
import pytest

from sensors_io import arrays, index
from sensors_io.__main__ import main
from sensors_io.arrays import load_arrays
from sensors_io.importers import hdf5_read, video
from sensors_io.importers.keep import Keep
from sensors_io.locks import write_lock
from sensors_io.records import RecordsError, RecordStore
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import film


def fails(*args, **options):
    raise OSError(errno.EMFILE, "Too many open files")


@pytest.fixture
def records(tmp_path):
    return fakes.write(tmp_path / "r", 1)


def test_an_index_without_a_free_descriptor(records, monkeypatch):
    monkeypatch.setattr(index.GrowingFile, "read", fails)
    refused(OSError, "Too many open files", RecordStore, records)


def test_a_shard_without_a_free_descriptor(records, monkeypatch):
    store = RecordStore(records)

    def opened(files):
        raise RuntimeError("open() failed: Too many open files")

    monkeypatch.setattr("sensors_io.shards.ArrayRecordDataSource", opened)
    refused(RecordsError, "cannot be opened .*raise the limit of open files", store.contact, 0)


def test_arrays_videos_and_hdf5_files_without_a_free_descriptor(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", x=np.zeros(2))
    clip = film(tmp_path / "clip.avi")
    with monkeypatch.context() as limit:
        limit.setattr(arrays.zipfile, "ZipFile", fails)
        refused(OSError, "Too many open files", load_arrays, tmp_path / "a.npz")
    assert list(load_arrays(tmp_path / "a.npz")) == ["x"]
    with monkeypatch.context() as limit:
        limit.setattr(pathlib.Path, "open", fails)
        refused(OSError, "Too many open files", video.read_video, clip, Keep())
    h5py = pytest.importorskip("h5py")
    h5py.File(tmp_path / "a.h5", "w").close()
    monkeypatch.setattr(h5py, "File", fails)

    def read():
        with hdf5_read.opened(tmp_path / "a.h5"):
            pass

    refused(OSError, "Too many open files", read)


def test_a_file_system_without_locks_is_not_a_second_writer(tmp_path, monkeypatch):
    def unlocked(*args):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unlocked)
    refused(OSError, "No locks available", write_lock, tmp_path)


def test_links_in_a_circle_are_named(tmp_path, records, capsys):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    for out in (tmp_path / "a", tmp_path / "a" / "x"):
        assert main(["export", str(records), "--to", "zarr", "--out", str(out)]) == 2
        assert f"out is {out}: its symbolic links lead in a circle; correct them" in capsys.readouterr().err
