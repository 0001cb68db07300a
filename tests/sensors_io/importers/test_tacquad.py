"""TacQuad: the three sensors of a row are one contact; a missing one is named and the others stay."""

import shutil

import pytest

from sensors_io.importers.keep import ImportSourceError
from sensors_io.importers.tables import read_table
from sensors_io.importers.tacquad import list_tacquad
from tests.sensors_io.checks import refused
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
        file.write("gone,1,3,0,1,2,4\nshort,1\nodd,a,b,c,d,e,f\nfar,0,1,0,1,0,9999999\n")
    report, store = imported(list_tacquad(source, EVERYTHING), tmp_path / "out")
    assert report.contacts == 3
    assert set(store.contact(0)) == {"gelsight_mini", "duragel"}
    rows = {
        "contact_indoor.csv: short,1",
        "contact_indoor.csv: odd,a,b,c,d,e,f",
        "contact_indoor.csv: far,0,1,0,1,0,9999999",
        "data_indoor/gone",
        "indoor-gone",
    }
    assert {skip.name for skip in report.skipped} == {"paper box/digit", "paper box/duragel/3.png", *rows}


def test_a_part_without_its_table_is_named(source):
    table = source / "contact_indoor.csv"
    rows, _ = table.read_text(), table.write_text("")
    refused(ImportSourceError, "contact_indoor.csv is empty", list_tacquad, source, EVERYTHING)
    table.write_text("number,tactile\n")
    refused(ImportSourceError, "contact_indoor.csv is empty", read_table, table, ["number"])
    table.write_text(rows)
    (source / "contact_fine.csv").unlink()
    assert [skip.name for skip in list_tacquad(source, EVERYTHING).skipped] == ["data_fine"]


def test_a_byte_order_mark_is_no_part_of_the_first_item(source, tmp_path):
    table = source / "contact_indoor.csv"
    table.write_bytes(b"\xef\xbb\xbf" + table.read_bytes())
    report, _ = imported(list_tacquad(source, EVERYTHING), tmp_path / "out")
    assert (report.contacts, report.skipped) == (3, ())
