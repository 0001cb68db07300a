"""TacQuad: the three sensors of a row are one contact; a missing one is named and the others stay."""

import shutil

import pytest

from sensors_io.importers.keep import Skip
from sensors_io.importers.tacquad import list_tacquad
from tests.sensors_io.importers.films import EVERYTHING, imported, picture


@pytest.fixture
def source(tmp_path):
    root = tmp_path / "tacquad"
    for part, item, third in (("data_indoor", "paper box", "duragel"), ("data_fine", "ball", "tirgel")):
        for sensor in ("gelsight", "digit", third):
            for t in range(5):
                picture(root / part / item / sensor / f"{t}.png", 10 * t)
        picture(root / part / item / "img_gelsight" / "0.png", 99)
    (root / "contact_indoor.csv").write_text("paper box,1,3,0,1,2,4\n")
    (root / "contact_fine.csv").write_text("ball,0,1,0,1,0,1\nball,2,4,2,4,2,4\n")
    return root


def test_rows_become_paired_records(source, tmp_path):
    report, store = imported(list_tacquad(source, EVERYTHING), tmp_path / "out")
    assert (report.contacts, report.skipped) == (3, ())
    assert [(k.object_id, k.motion, k.trial) for k in store.contacts] == [
        ("indoor-paper_box", "free", 0),
        ("fine-ball", "press", 0),
        ("fine-ball", "press", 1),
    ]
    contact = store.contact(0)
    assert {sensor: s.frames[:, -1, -1, 0].tolist() for sensor, s in contact.items()} == {
        "gelsight_mini": [10, 20, 30],
        "digit": [0, 10],
        "duragel": [20, 30, 40],
    }
    assert (store.objects["indoor-paper_box"].view[-1, -1] == 99).all()
    assert store.contact(2)["duragel"].frames[:, -1, -1, 0].tolist() == [20, 30, 40]


def test_a_sensor_that_is_missing_does_not_take_the_others_with_it(source, tmp_path):
    shutil.rmtree(source / "data_indoor" / "paper box" / "digit")
    (source / "data_indoor" / "paper box" / "duragel" / "3.png").unlink()
    with (source / "contact_indoor.csv").open("a") as file:
        file.write("gone,1,3,0,1,2,4\nshort,1\nodd,a,b,c,d,e,f\n")
    report, store = imported(list_tacquad(source, EVERYTHING), tmp_path / "out")
    assert report.contacts == 3
    assert set(store.contact(0)) == {"gelsight_mini", "duragel"}
    found = {skip.name: skip.reason for skip in report.skipped}
    assert found["paper box/digit"] == "has no folder"
    assert found["paper box/duragel/3.png"] == "is absent"
    assert found["contact_indoor.csv: short,1"] == "has 1 numbers after the item: expected 6"
    assert "invalid literal" in found["contact_indoor.csv: odd,a,b,c,d,e,f"]
    assert "gone/gelsight_mini has no folder" in found["data_indoor/gone"]
    assert Skip(name="indoor-gone", reason="object without a readable contact") in report.skipped
