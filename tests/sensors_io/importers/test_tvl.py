"""TVL/HCT: pairs of a trajectory are one sequence, and swapped folders are turned round."""

import os

import pytest

from sensors_io.importers.keep import ImportSourceError
from sensors_io.importers.tables import read_rows
from sensors_io.importers.tvl import list_tvl
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import EVERYTHING, imported, picture

DIGIT, WEBCAM = (320, 240), (90, 160)
HEAD = "url,tactile,tactile_background,caption\n"


def pair(root, trajectory, name, level, swapped=False):
    """One pair of pictures and its row."""
    shapes = (WEBCAM, DIGIT) if swapped else (DIGIT, WEBCAM)
    picture(root / trajectory / "tactile" / name, level, shapes[0])
    picture(root / trajectory / "vision" / name, level, shapes[1])
    return f'{trajectory}/vision/{name},{trajectory}/tactile/{name},{trajectory}/tactile/0.png,"smooth, hard"\n'


@pytest.fixture
def source(tmp_path):
    root = tmp_path / "hct" / "data1"
    rows = [pair(root, "0-1702507215.6", f"{n}-0.02.png", n) for n in (10, 9, 11)]
    rows += [pair(root, "1-1702507300.1", f"{n}-0.02.png", n, swapped=True) for n in (3, 4)]
    (root / "train.csv").write_text(HEAD + "".join(rows[1:]))
    (root / "test.csv").write_text(HEAD + rows[0])
    return tmp_path / "hct"


def test_a_path_from_the_root_on_is_left_out(source):
    (source / "data1" / "test.csv").write_text(HEAD + "/vision/1-2.jpg,/tactile/1-2.jpg,,\n")
    catalogue = list_tvl(source, EVERYTHING)
    assert [skip.name for skip in catalogue.skipped] == ["data1/test.csv: /tactile/1-2.jpg"]


def test_trajectories_become_records(source, tmp_path):
    (source / "data1" / "test.csv").rename(source / "data1" / "Test.CSV")
    report, store = imported(list_tvl(source, EVERYTHING), tmp_path / "out")
    assert (report.contacts, report.skipped, len(report.unannotated)) == (2, (), 4)
    assert {k.object_id for k in store.contacts} == {"data1-0-1702507215.6", "data1-1-1702507300.1"}
    whole, swapped = sorted((store.contact(i)["digit"] for i in range(2)), key=lambda s: s.key.object_id)
    assert whole.frames[:, -1, -1, 0].tolist() == [9, 10, 11]
    assert whole.camera["captioned_by"] == ["GPT-4V", "people", "GPT-4V"]
    assert whole.camera["captions"] == ["smooth, hard"] * 3
    assert swapped.frames.shape == (2, *DIGIT, 3)
    assert (whole.camera["turned_round"], swapped.camera["turned_round"]) == (0, 2)
    for card in store.objects.values():
        assert card.view.shape == (240, 427, 3)


def test_a_pipe_in_the_place_of_a_table_is_named(tmp_path):
    """Who opens it waits, maybe for ever."""
    os.mkfifo(tmp_path / "train.csv")
    said = "train.csv cannot be read .it is a folder, a pipe or a device"
    refused(ImportSourceError, said, list_tvl, tmp_path, EVERYTHING)
    refused(ImportSourceError, said, read_rows, tmp_path / "train.csv")


@pytest.mark.parametrize("cut", [b",smooth", b'"smooth, har'], ids=["between columns", "in the caption"])
def test_a_table_that_ends_in_the_middle_of_a_row_is_refused(source, cut):
    """The rest of a copy that was interrupted: what it would name is gone without a word."""
    table = source / "data1" / "train.csv"
    whole = table.read_bytes()
    table.write_bytes(whole[:-1])  # an editor may leave out the last end of a line
    assert len(list_tvl(source, EVERYTHING).contacts) == 2
    table.write_bytes(whole[: whole.rindex(b',"smooth')] + (b"," + cut if cut.startswith(b'"') else b""))
    refused(ImportSourceError, "train.csv ends in the middle of row 4", list_tvl, source, EVERYTHING)


def test_a_table_of_zeros_is_refused_in_a_short_line(source):
    (source / "data1" / "train.csv").write_bytes(bytes(10_000))
    with pytest.raises(ImportSourceError, match="has the columns") as raised:
        list_tvl(source, EVERYTHING)
    assert len(str(raised.value).removeprefix(str(source))) < 400
