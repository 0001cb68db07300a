"""Bad input through the public command lines: error, place and way out are named, nothing is lost or half-written."""

import contextlib
from pathlib import Path

import pytest

from experiments.faults.bad_inputs import BadInput, cases, contents, provoke
from experiments.faults.fixtures import flipped, replaced, unfinished_run, write_records
from sensors_io.records import RecordStore

# Orbax gives up at the first array that it cannot read; what the others call back then finds its loop closed
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

NAMES = [case.name for case in cases(unfinished=Path())]

SLOW = {"recordings without a folder", "targets that are NaN from step 5 on", "a scale that there is not"}
"""Half of the time of all: programs are compiled or many modules imported for them."""


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unfinished")
    unfinished_run(folder)
    return folder


def test_there_are_at_least_25_kinds():
    assert len(set(NAMES)) == len(NAMES) >= 25


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in NAMES])
def test_bad_input_is_answered(unfinished, tmp_path, name):
    (case,) = (case for case in cases(unfinished) if case.name == name)
    found = provoke(case, tmp_path)
    assert not found.faults, found.output
    assert found.line


def test_good_input_is_a_fault_of_its_case(tmp_path):
    """A case whose input is not bad is noticed: the command succeeds and names no error."""
    command = "sensors_io check {folder}/records"
    case = BadInput("records", "good", command, "CorruptRecordsError", "records", "copy it again", write_records)
    found = provoke(case, tmp_path)
    assert found.faults[0] == "the exit code is 0"
    assert "the message names no error 'CorruptRecordsError'" in found.faults
    assert len(RecordStore(tmp_path / "records")) == 2


def test_lost_and_half_written_files_are_noticed(tmp_path):
    @contextlib.contextmanager
    def losing(folder):
        (folder / "lost").unlink()
        (folder / ".half.tmp").write_text("x")
        yield

    def prepare(folder):
        (folder / "kept").write_text("one")
        (folder / "lost").write_text("two")

    expected = ("There is no experiment", "'nothing'", "Did you mean")
    case = BadInput("run", "a loss", "trainings nothing", *expected, prepare, losing)
    assert provoke(case, tmp_path).faults == ("lost lost", "half-written .half.tmp")


def test_damage_changes_a_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(bytes(10) + b"abc" + bytes(10))
    flipped(path)
    assert path.read_bytes() == bytes(10) + b"a\x9dc" + bytes(10)
    path.write_text("abc")
    with pytest.raises(ValueError, match="must hold the text"):
        replaced(path, "z", "y")
    assert set(contents(tmp_path)) == {"file"}
