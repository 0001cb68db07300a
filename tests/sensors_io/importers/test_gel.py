"""Pitch and gel at rest of an imported source: kept with the records, and what `check` and `extract` make of them."""

import pathlib
import re
import shutil

import numpy as np
import pytest

from sensors_io import __main__ as main
from sensors_io.importers.catalogue import import_catalogue
from sensors_io.importers.gel import SourceGel
from sensors_io.importers.keep import ImportSourceError
from sensors_io.importers.pictures import read_picture
from sensors_io.importers.videos import VideosConfig, list_videos
from sensors_io.records import RecordsExistError, RecordStore
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused

GELSLAM = pathlib.Path(__file__).resolve().parents[2] / "data" / "gelslam"
CONFIG = VideosConfig(sensor="gelsight_mini", height=40)


@pytest.fixture
def presses(tmp_path) -> pathlib.Path:
    """A clip of three pictures: the gel at rest and two presses of a Mini."""
    folder = tmp_path / "clips" / "ball"
    folder.mkdir(parents=True)
    for n, name in enumerate(("background", "press_12", "press_14")):
        shutil.copy(GELSLAM / f"{name}.png", folder / f"{n}.png")
    return folder.parent


def test_an_import_keeps_the_pitch_of_what_it_stores_and_the_gel_at_rest(tmp_path, presses):
    gel = SourceGel(mm_per_px=0.0634, background=GELSLAM / "background.png")
    import_catalogue(list_videos(presses, CONFIG), tmp_path / "r", gel=gel)
    sequence = RecordStore(tmp_path / "r").contact(0)["gelsight_mini"]
    rows = read_picture(GELSLAM / "background.png").shape[0]
    assert sequence.frames.shape[1] == 40
    assert sequence.mm_per_px == pytest.approx(0.0634 * rows / 40)
    rest = read_picture(tmp_path / "r" / sequence.camera["recording"]["background"])
    np.testing.assert_array_equal(rest, read_picture(GELSLAM / "background.png"))
    refused(RecordsExistError, "another|made by", import_catalogue, list_videos(presses, CONFIG), tmp_path / "r")


def test_a_gel_that_cannot_be_is_one_line(tmp_path, presses):
    refused(ImportSourceError, "mm_per_px is 3", SourceGel, mm_per_px=3.0)
    two = SourceGel(mm_per_px=0.1)
    refused(ImportSourceError, "of one gel, the source has a, b", two.require_one_sensor, ("a", "b"))
    gone = SourceGel(background=tmp_path / "gone.png")
    refused(ImportSourceError, "gone.png is absent", import_catalogue, list_videos(presses, CONFIG), tmp_path, gel=gone)


def test_check_and_extract_read_what_an_import_kept_or_is_given(tmp_path, presses, capsys):
    def run(*args: object) -> str:
        assert main.main([str(arg) for arg in args]) == 0
        return capsys.readouterr().out

    plain, kept, rest = tmp_path / "plain", tmp_path / "kept", GELSLAM / "background.png"
    videos = ["import", "videos", presses, "--sensor", "gelsight_mini", "--height", 120]
    run(*videos, "--out", plain)
    run(*videos, "--out", kept, "--mm-per-px", 0.0634, "--background", rest)
    assert "not looked at: 1 sequences, no gel at rest" in run("check", plain, "--pictures", "--mm-per-px", 0.1268)
    assert "their mm per px are unknown" in run("check", plain, "--pictures", "--rest-frames", 1)
    skin = fakes.write(tmp_path / "skin", 1, sensors=("tac3d",))
    assert "not looked at: 1 sequences, they hold no pictures" in run("check", skin, "--pictures")
    looked = [
        run("check", kept, "--pictures"),
        run("check", plain, "--pictures", "--background", rest, "--mm-per-px", 0.1268),
        run("check", plain, "--pictures", "--rest-frames", 1, "--mm-per-px", 0.1268),
    ]
    for out in looked:
        assert re.search(r"no_contact\W+1 ", out[out.index("flags by the pictures") :])
    assert main.main(["extract", str(kept), "--out", str(tmp_path / "fields")]) == 1
    assert "carries no field: depth_mm: without a calibration" in capsys.readouterr().err
    assert main.main(["extract", str(rest), "--out", str(tmp_path / "fields")]) == 1
    assert "must end in .npz unless the input is one directory of records" in capsys.readouterr().err
    assert main.main(["extract", str(rest), "--out", str(tmp_path / "fields.npz")]) == 1
    assert "--background is not given" in capsys.readouterr().err
