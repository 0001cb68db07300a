"""VTV150K: flat videos of a sensor that the user names."""

from sensors_io.importers.catalogue import import_catalogue
from sensors_io.importers.keep import ImportSourceError, Skip
from sensors_io.importers.vtv150k import VTVConfig, list_vtv150k
from sensors_io.records import RecordStore
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import cut, film

KEEP = VTVConfig(height=0, max_frames=0, val_share=0, test_share=0, sensor="digit")


def video(path, frames=12):
    """A video under the name of an .mp4; OpenCV looks at the content."""
    film(path.with_suffix(".avi"), frames).rename(path)
    return path


def test_videos_become_records(tmp_path):
    source = tmp_path / "in"
    source.mkdir()
    for name in ("soft_ball_1", "soft_ball_2", "cup_10"):
        video(source / f"{name}.mp4")
    cut(video(source / "soft_ball_3.mp4", 40))
    video(source / "nameless.mp4")
    report = import_catalogue(list_vtv150k(source, KEEP), tmp_path / "out")
    assert report.contacts == 3
    assert report.skipped[0] == Skip(name="nameless.mp4", reason="is not named <object>_<n>")
    assert report.skipped[1].name == "soft_ball_3.mp4"
    assert len(report.skipped) == 2
    store = RecordStore(tmp_path / "out")
    assert [(k.object_id, k.trial) for k in store.contacts] == [("cup", 10), ("soft_ball", 1), ("soft_ball", 2)]
    assert store.contact(0)["digit"].frames.shape == (12, 24, 32, 3)
    assert store.objects["soft_ball"].name == "soft ball"
    assert store.meta.source == "VTV150K, digit"


def test_a_wrong_directory_says_what_was_expected(tmp_path):
    refused(ImportSourceError, r"holds none: expected <object>_<n>.mp4", list_vtv150k, tmp_path, KEEP)
