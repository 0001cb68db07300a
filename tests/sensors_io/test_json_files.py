"""JSON files are whole, whoever else writes them."""

import os

import pytest

from sensors_io import json_files
from touchr1_jax.bench import json_lines


@pytest.mark.parametrize(
    ("write", "first", "second"),
    [
        (json_files.write_json, {"a": "long" * 9}, {"b": 1}),
        (json_lines.write_text, "long" * 9, "b"),
    ],
)
def test_two_processes_that_write_one_file_leave_that_of_the_later(tmp_path, monkeypatch, write, first, second):
    path, pid, sync = tmp_path / "x.json", os.getpid(), os.fsync

    def meanwhile(descriptor):
        sync(descriptor)
        if os.getpid() == pid:
            with monkeypatch.context() as other:
                other.setattr(os, "getpid", lambda: pid + 1)
                write(path, second)

    monkeypatch.setattr(os, "fsync", meanwhile)
    write(path, first)
    monkeypatch.undo()
    content = path.read_bytes()
    write(path, first)
    assert path.read_bytes() == content
    assert [found.name for found in tmp_path.iterdir()] == ["x.json"]
