"""YCB-Slide: slides are cut into pieces that carry their recorded times."""

import numpy as np

from sensors_io.importers.keep import ImportConfig
from sensors_io.importers.ycb_slide import list_ycb_slide
from sensors_io.schema import Flag
from tests.sensors_io.importers.films import cut, imported, picture

KEEP = ImportConfig(height=0, max_frames=4, val_share=0, test_share=0)
DRILL = "035_power_drill"


def slide(root, k, count, times=None):
    folder = root / DRILL / f"dataset_{k}"
    for n in range(count):
        picture(folder / "frames" / f"frame_{n:07d}.jpg", 20 * n)
    if times is not None:
        np.save(folder / "digit_data.npy", {"timestamps": list(times), "digit_frames": []}, allow_pickle=True)
    return folder


def test_slides_become_pieces(tmp_path):
    slide(tmp_path / "real", 0, 6, times=np.arange(6) * 0.05)
    report, store = imported(list_ycb_slide(tmp_path, KEEP), tmp_path / "out")
    assert (report.contacts, report.skipped) == (2, ())
    assert [(k.object_id, k.site, k.trial) for k in store.contacts] == [(DRILL, 0, 0), (DRILL, 0, 1)]
    first, second = (store.contact(i)["digit"] for i in range(2))
    assert first.host_time_ns.tolist() == [0, 50_000_000, 100_000_000, 150_000_000]
    assert second.host_time_ns.tolist() == [200_000_000, 250_000_000]
    np.testing.assert_allclose(second.frames[:, -1, -1, 0], [80, 100], atol=1)
    assert store.objects[DRILL].name == "035 power drill"
    assert store.meta.licence == "CC BY-SA 4.0"


def test_damage_is_left_out_by_name(tmp_path):
    source = tmp_path / "in"
    cut(slide(source, 0, 3, times=range(3)) / "frames" / "frame_0000001.jpg")
    slide(source, 1, 3, times=range(9))
    (source / DRILL / "dataset_2").mkdir()
    slide(source, 3, 3, times=(0.0, np.nan, 0.2))
    slide(source, 4, 2, times=("a", "b"))
    slide(source, 5, 2, times=(0.0, 1.7e12))  # ms in place of seconds
    report, store = imported(list_ycb_slide(source, KEEP), tmp_path / "out")
    names = {skip.name.removeprefix(f"{DRILL}/") for skip in report.skipped}
    assert names == {
        "dataset_0/frames/frame_0000001.jpg",
        "dataset_1 0",
        "dataset_2",
        *(f"dataset_{n} 0" for n in (3, 4, 5)),
    }
    assert store.contact(0)["digit"].flags.tolist() == [0, int(Flag.TIME_GAP)]
