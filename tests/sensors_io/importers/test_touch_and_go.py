"""Touch and Go: runs of frames are touches, classes are materials, sessions stay whole."""

import numpy as np
import pytest

from sensors_io.importers.touch_and_go import list_touch_and_go, touches
from sensors_io.schema import MATERIALS, UNKNOWN, Flag
from tests.sensors_io.importers.films import EVERYTHING, imported, picture

FIRST, SECOND = "20220318_021048", "20220318_022003"


def frames(root, session, numbers):
    for n in numbers:
        picture(root / "dataset" / session / "gelsight_frame" / f"{n:010d}.jpg", n % 200)
        picture(root / "dataset" / session / "video_frame" / f"{n:010d}.jpg", 7, shape=(12, 16))


def lines(session, numbers, kind):
    return [f"{session}/{n:010d}.jpg,{kind}" for n in numbers]


@pytest.fixture
def source(tmp_path):
    root = tmp_path / "touch_and_go"
    frames(root, FIRST, [5, 6, 7, 60, 61])
    frames(root, SECOND, [1, 2])
    listed = lines(FIRST, [7, 5, 6], 9) + lines(FIRST, [60, 61], 12) + lines(SECOND, [1, 2], 3)
    (root / "label.txt").write_text("\n".join(listed) + "\n")
    return root


def test_touches_become_records(source, tmp_path):
    report, store = imported(list_touch_and_go(source, EVERYTHING), tmp_path / "out")
    assert (report.contacts, report.skipped) == (3, ())
    assert [k.object_id for k in store.contacts] == [f"{FIRST}-natural_fabric", f"{FIRST}-tree", f"{SECOND}-wood"]
    materials = [MATERIALS[store.objects[k.object_id].labels["material"]] for k in store.contacts]
    assert materials == ["fabric", "other", "wood"]
    card = store.objects[f"{FIRST}-natural_fabric"]
    assert card.label_row().tolist()[:3] == [UNKNOWN] * 3
    assert card.view.shape == (240, 320, 3)
    assert card.view[-1, -1, 0] < 20
    sequence = store.contact(0)["gelsight"]
    np.testing.assert_allclose(sequence.host_time_ns, np.array([5, 6, 7]) / 30 * 1e9, atol=1)
    assert not sequence.flags.any()


def test_lines_and_frames_that_say_nothing_certain_are_skipped(source, tmp_path):
    bad = [f"{FIRST}/61.jpg,3", f"{FIRST}/0000000061.jpg,20", f"{FIRST}/0000000005.jpg,2", "nonsense"]
    (source / "train.txt").write_text("\n".join(bad))
    (source / "dataset" / FIRST / "gelsight_frame" / "0000000006.jpg").unlink()
    report, store = imported(list_touch_and_go(source, EVERYTHING), tmp_path / "out")
    left_out = {
        *(f"train.txt: {bad[n]}" for n in (0, 1, 3)),
        f"{FIRST}/0000000005.jpg",
        "gelsight_frame/0000000006.jpg",
    }
    assert {skip.name for skip in report.skipped} == left_out
    assert store.contact(0)["gelsight"].flags.tolist() == [int(Flag.TIME_GAP)]


def test_a_pause_a_class_or_a_session_ends_a_touch():
    classes = {("a", 1): 0, ("a", 2): 0, ("a", 17): 0, ("a", 33): 0, ("a", 34): 1, ("b", 35): 1}
    assert touches(classes) == [("a", 0, [1, 2, 17]), ("a", 0, [33]), ("a", 1, [34]), ("b", 1, [35])]


def test_recorded_times_are_used_where_they_are(source, tmp_path):
    np.save(source / "dataset" / FIRST / "time2.npy", 1647.0 + np.arange(62) ** 2 / 100)
    np.save(source / "dataset" / SECOND / "time2.npy", np.arange(2.0))
    report, store = imported(list_touch_and_go(source, EVERYTHING), tmp_path / "out")
    sequence = store.contact(0)["gelsight"]
    np.testing.assert_allclose(sequence.host_time_ns, [250_000_000, 360_000_000, 490_000_000], atol=100)
    assert sequence.camera["clock"] == "time2.npy"
    assert "time2.npy has 2 times and frame 2 is listed" in {skip.reason for skip in report.skipped}
    np.save(source / "dataset" / SECOND / "time2.npy", np.array([0.0, 0.1, np.nan]))
    report, _ = imported(list_touch_and_go(source, EVERYTHING), tmp_path / "again")
    assert "time2.npy has times that are not finite, or run backwards" in {skip.reason for skip in report.skipped}
