"""Somebody's own clips become records with the labels of their table; what does not fit is named by file and line."""

import os
import shutil

import pytest

from sensors_io.importers.catalogue import import_catalogue
from sensors_io.importers.keep import ImportSourceError
from sensors_io.importers.label_table import LabelsError
from sensors_io.importers.videos import VideosConfig, list_videos
from sensors_io.records import RecordsExistError
from sensors_io.schema import MATERIALS
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import film, imported, picture

TABLE = """clip,object_id,hardness,roughness,material,split
mug/1.avi,mug,2,0,glass,
mug/2,mug,2,0,glass,
sponge,sponge,0,,other,
towel_7.avi,towel,0,2,fabric,
cube.avi,,1,1,,train
"""


@pytest.fixture
def clips(tmp_path):
    """Five clips of four objects, and one that the table does not name."""
    root = tmp_path / "clips"
    (root / "mug").mkdir(parents=True)
    for name in ("mug/1.avi", "mug/2.avi", "towel_7.avi", "cube.avi", "other.avi"):
        film(root / name, frames=6)
    for n in (9, 10, 11):
        picture(root / "sponge" / f"frame_{n}.png", level=10 * n)
    (root / "notes.txt").write_text("no clip")
    (root / "mug" / "3.wmv").write_text("of a kind that is not read")
    (root / "gone.mp4").symlink_to(root / "absent.mp4")
    (root / "._cube.avi").write_text("what macOS writes next to cube.avi")
    return root


def listed(clips, table=TABLE, **options):
    labels = clips.parent / "labels.csv"
    labels.write_text(table)
    return list_videos(clips, VideosConfig(sensor="gelsight_mini", labels=labels, **options))


def test_clips_become_records_with_the_labels_of_their_table(clips, tmp_path):
    report, store = imported(listed(clips, annotator="me"), tmp_path / "records")
    assert {(k.object_id, k.trial) for k in store.contacts} == {
        ("mug", 0), ("mug", 1), ("sponge", 0), ("towel", 0), ("cube", 0),
    }  # fmt: skip
    assert store.objects["mug"].labels == {"hardness": 2, "roughness": 0, "material": MATERIALS.index("glass")}
    assert store.objects["sponge"].labels == {"hardness": 0, "material": MATERIALS.index("other")}
    assert (store.objects["cube"].split, store.objects["cube"].annotator) == ("train", "me")
    assert sorted(store.objects[name].split for name in ("mug", "sponge", "towel")) == ["test", "train", "val"]
    assert [skip.name for skip in report.skipped] == ["other.avi", "gone.mp4", "mug/3.wmv"]
    assert report.skipped[1].reason == "is a link to nothing"
    moved = clips.rename(clips.with_name("zoo"))  # the order of contacts does not depend on the name of the folder
    assert [one.key for one in listed(moved, annotator="me").contacts] == list(store.contacts)
    at = next(i for i, key in enumerate(store.contacts) if key.object_id == "sponge")
    frames = store.contact(at)["gelsight_mini"].frames
    assert [int(frame[-1, -1, 0]) for frame in frames] == [90, 100, 110]


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("clip\n", "has no row"),
        ("clip,hardness,hardness\nmug/1.avi,0,2\n", "each once"),
        ("clip;hardness\na;0\n", "separated by commas"),
        ("nowhere,x,1,,,", r"line 7: clip is 'nowhere': is no clip of .*give its path in the folder, such as"),
        ("other,x,,,stone,", r"line 7: material of 'x' is 'stone': must be one of plastic"),
        ("other,x,,,,dev", r"line 7: split of 'x' is 'dev': must be one of train"),
        ("other,mug,1,0,glass,", r"line 7: 'mug' has hardness 1, .*an earlier line hardness 2, .*correct one"),
        ("other,a b,1,,,", r"line 7: .*object_id"),
        ("other,x", r"line 7: must have 6 cells; complete it"),
        ("mug/1.avi,x,,,,", r"line 7: clip 'mug/1.avi' appears twice"),
        ("other,cube,,,,", r"line 6: clip 'cube.avi' has no object_id and would be 'cube'"),
        ('"\n\nother",x,3,,,', r"line 9: hardness"),
        ("\n,,,,,\n,,,,,\nother,x,3,,,", r"line 10: hardness"),
        ("mug/1,x,,,,", r"line 7: clip 'mug/1' is mug/1.avi, as in .*keep one line"),
    ],
)
def test_what_does_not_fit_is_named_by_file_and_line(clips, row, said):
    """A row under those of the table, or a table of its own."""
    with pytest.raises(LabelsError, match=rf"labels\.csv.*{said}"):
        listed(clips, row if row.startswith("clip") else f"{TABLE}{row}\n")


def test_a_folder_of_pictures_alone_is_a_clip(tmp_path):
    for n in range(3):
        picture(tmp_path / "press" / f"{n}.png")
    _, store = imported(list_videos(tmp_path / "press", VideosConfig(sensor="digit")), tmp_path / "records")
    assert [key.object_id for key in store.contacts] == ["press"]


def test_a_name_that_is_no_utf_8_is_named(tmp_path):
    """OpenCV crashed on it; the other clip is imported."""
    film(tmp_path / "a.avi")
    shutil.copy(tmp_path / "a.avi", os.fsencode(tmp_path) + b"/\xff.avi")
    report, store = imported(list_videos(tmp_path, VideosConfig(sensor="digit")), tmp_path / "records")
    assert len(store) == 1
    assert any("not UTF-8" in skip.reason for skip in report.skipped)


@pytest.mark.parametrize("changed", [{"rate_hz": 1e-320}, {"rate_hz": 1e14}, {"height": 100_000}, {"height": 2**31}])
def test_rates_and_heights_that_no_clip_has_are_refused(changed):
    with pytest.raises(ImportSourceError, match=next(iter(changed))):
        VideosConfig(sensor="digit", **changed)


def test_a_table_in_another_encoding_is_named(clips):
    (clips.parent / "labels.csv").write_bytes(b"clip,name\na,\xfc\n")
    with pytest.raises(LabelsError, match="write one in UTF-8"):
        list_videos(clips, VideosConfig(sensor="digit", labels=clips.parent / "labels.csv"))


def test_a_clip_that_changed_at_the_same_size_is_not_mixed_in(clips, tmp_path):
    """Neither while an interrupted import goes on nor afterwards."""

    def interrupt(done, total):
        if done == 2:
            raise KeyboardInterrupt

    out, changed = tmp_path / "records", clips / "sponge" / "frame_9.png"
    listing = lambda: list_videos(clips, VideosConfig(sensor="gelsight_mini"))
    with pytest.raises(KeyboardInterrupt):
        import_catalogue(listing(), out, progress=interrupt)
    before = changed.stat()
    changed.write_bytes(changed.read_bytes()[::-1])
    said = "imported with these options when the source had other files, or by an earlier version, .*time of change"
    refused(RecordsExistError, said, import_catalogue, listing(), out)
    changed.write_bytes(changed.read_bytes()[::-1])
    os.utime(changed, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert import_catalogue(listing(), out).contacts == 6
    changed.touch()
    refused(RecordsExistError, said, import_catalogue, listing(), out)


def test_clips_whose_names_no_key_can_have_are_different_objects(tmp_path):
    for name in ("杯", "碗", "mug 2", "mug_2", "mü"):
        (tmp_path / f"{name}.mp4").touch()
    found = [listed.key.object_id for listed in list_videos(tmp_path, VideosConfig(sensor="mini")).contacts]
    assert sorted(found) == ["clip", "clip_2", "m", "mug_2", "mug_2_2"]
    table = "clip,hardness,split\nmu\u0308,2,unlabelled\n"  # an accent of its own, as macOS writes it
    (found,) = listed(tmp_path, table).cards.values()
    assert (found.object_id, found.split) == ("m", "unlabelled")


def test_a_folder_is_read_before_the_next(tmp_path):
    """Also where folders in them have the same name."""
    places = ["cup/1/a.avi", "cup/1/b.avi", "mug/1/a.avi", "mug/2/a.avi", "mug/10/a.avi"]
    for place in reversed(places):
        (tmp_path / "clips" / place).parent.mkdir(parents=True, exist_ok=True)
        film(tmp_path / "clips" / place, frames=3)
    found = listed(tmp_path / "clips", "\n".join(["clip", *places]))
    assert [contact.name for contact in found.contacts] == places
