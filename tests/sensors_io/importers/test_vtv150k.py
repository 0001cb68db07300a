"""VTV150K: flat videos of a sensor that the user names."""

from sensors_io.importers.vtv150k import VTVConfig, list_vtv150k
from tests.sensors_io.importers.films import cut, film, imported

KEEP = VTVConfig(height=0, max_frames=0, val_share=0, test_share=0, sensor="digit")


def video(path, frames=12):
    """A video under the name of an .mp4; OpenCV looks at the content."""
    film(path.with_suffix(".avi"), frames).rename(path)
    return path


def test_videos_become_records(tmp_path):
    source = tmp_path / "in"
    source.mkdir()
    for name in ("soft_ball_1", "soft_ball_2", "cup_10", "nameless"):
        video(source / f"{name}.mp4")
    video(source / "soft_ball_02.mp4")
    video(source / "cup_20240101120000.MP4")
    cut(video(source / "soft_ball_3.mp4", 40))
    report, store = imported(list_vtv150k(source, KEEP), tmp_path / "out")
    assert report.contacts == 3
    reasons = {skip.name: skip.reason for skip in report.skipped[:2]}
    assert reasons == dict.fromkeys(("nameless.mp4", "cup_20240101120000.MP4"), "is not named <object>_<n>")
    twice, broken = report.skipped[2:]
    assert {twice.name, twice.reason.removeprefix("has the object, site and trial of ")} == {
        "soft_ball_2.mp4",
        "soft_ball_02.mp4",
    }
    assert broken.name == "soft_ball_3.mp4"
    assert [(k.object_id, k.trial) for k in store.contacts] == [("cup", 10), ("soft_ball", 1), ("soft_ball", 2)]
    assert store.contact(0)["digit"].frames.shape == (12, 24, 32, 3)
    assert store.objects["soft_ball"].name == "soft ball"
    assert store.meta.source == "VTV150K, digit"
