"""Bad input through the public command lines: named, placed, with a way out, nothing lost and nothing half-written."""

from pathlib import Path

import pytest

from experiments.faults.bad_input import BadInput, contents, provoke
from experiments.faults.bad_inputs import cases
from experiments.faults.fixtures import flipped, replaced, unfinished_run, write_records
from sensors_io.records import RecordStore

# Orbax gives up at the first array that it cannot read; what the others call back then finds its loop closed
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

NAMES = [case.name for case in cases(unfinished=Path())]


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unfinished")
    unfinished_run(folder)
    return folder


def test_there_are_at_least_25_kinds():
    assert len(set(NAMES)) == len(NAMES) >= 25


SLOW = {"recordings without a folder", "targets that are NaN from step 5 on", "a scale that there is not"}
"""Half of the time of all: programs are compiled or many modules imported for them."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in NAMES])
def test_bad_input_is_answered(unfinished, tmp_path, name):
    (case,) = (case for case in cases(unfinished) if case.name == name)
    found = provoke(case, tmp_path)
    assert not found.faults, found.said
    assert found.line


def test_good_input_is_a_fault_of_its_case(tmp_path):
    """A case that spoils nothing is noticed: the command succeeds and says nothing of an error."""
    case = BadInput(
        kind="records",
        name="good records",
        program="sensors_io",
        arguments=lambda folder: ["check", folder / "records"],
        prepare=write_records,
        error="CorruptRecordsError",
        where="records",
        fix="copy it again",
    )
    found = provoke(case, tmp_path)
    assert found.faults[0] == "the exit code is 0"
    assert "the message names no error 'CorruptRecordsError'" in found.faults
    assert len(RecordStore(tmp_path / "records")) == 2


def test_lost_and_half_written_files_are_seen(tmp_path):
    def lose(folder):
        (folder / "kept").write_text("one")
        (folder / "lost").write_text("two")

    def command(folder):
        (folder / "lost").unlink()
        (folder / ".half.tmp").write_text("x")
        return ["nothing"]

    case = BadInput(
        kind="run",
        name="a program that loses a file",
        program="faults",
        arguments=command,
        prepare=lose,
        error="There is no experiment",
        where="'nothing'",
        fix="experiments:",
    )
    found = provoke(case, tmp_path)
    assert found.faults == ("lost lost", "half-written .half.tmp")


def test_spoiling_spoils(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(bytes(10) + b"abc" + bytes(10))
    flipped(path)
    assert path.read_bytes() == bytes(10) + b"a\x9dc" + bytes(10)
    path.write_text("abc")
    with pytest.raises(ValueError, match="spoils nothing"):
        replaced(path, "z", "y")
    assert set(contents(tmp_path)) == {"file"}
