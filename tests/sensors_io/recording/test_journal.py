"""A journal cut off anywhere is readable up to there; one damaged inside is refused."""

import errno
import mmap
import os
import tracemalloc

import numpy as np
import pytest

from sensors_io.recording.journal import JournalError, JournalWriter, read_journal
from tests.sensors_io.checks import refused


@pytest.fixture
def journal(tmp_path):
    path = tmp_path / "a.journal"
    with JournalWriter(path) as writer:
        for n in range(4):
            writer.append("frame", {"n": n}, frame=np.full((2, 3), n, np.uint8), empty=np.zeros((0, 3)))
    return path


def test_entries_come_back(journal):
    entries = read_journal(journal)
    assert [e.plain["n"] for e in entries] == [0, 1, 2, 3]
    assert entries[2].arrays["frame"].tolist() == [[2] * 3] * 2
    assert entries[2].arrays["empty"].shape == (0, 3)


def test_a_journal_is_read_where_files_cannot_be_mapped(journal, monkeypatch):
    def no_map(*args, **kwargs):
        raise OSError(errno.ENODEV, "No such device")

    monkeypatch.setattr(mmap, "mmap", no_map)
    test_entries_come_back(journal)


def test_a_long_journal_is_not_held_in_memory(tmp_path):
    with JournalWriter(tmp_path / "a.journal") as writer:
        for _ in range(40):
            writer.append("frame", {}, frame=np.zeros((200, 200, 3), np.uint8))
    tracemalloc.start()
    entries = read_journal(tmp_path / "a.journal")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(entries) == 40
    assert peak < 1e6


def test_every_cut_keeps_all_whole_entries(journal):
    data = journal.read_bytes()
    each = len(data) // 4
    for size in range(len(data)):
        journal.write_bytes(data[:size])
        assert len(read_journal(journal)) == size // each


@pytest.mark.parametrize(("entry", "byte"), [(0, 0), (0, 30), (0, 7), (2, 7), (3, 7)])
def test_damage_inside_is_refused(journal, entry, byte):
    """Also of the size, by which the rest of the file would seem to be one entry that was cut off."""
    data = bytearray(journal.read_bytes())
    start = entry * len(data) // 4
    data[start + byte] ^= 64
    journal.write_bytes(data)
    refused(JournalError, f"damaged at byte {start}:", read_journal, journal)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_a_pipe_or_a_folder_in_the_place_of_a_journal_is_refused(tmp_path, make):
    make(tmp_path / "a.journal")  # who opened the pipe would wait for ever
    refused(JournalError, "a.journal is no journal .*move it away", read_journal, tmp_path / "a.journal")


def test_a_journal_is_never_overwritten(journal):
    with pytest.raises(FileExistsError), JournalWriter(journal):
        pass
