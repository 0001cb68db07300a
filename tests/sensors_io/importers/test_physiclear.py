"""The PhysiCLeAR importer: what comes in, and a named error or a listed skip for everything that does not."""

import os
import pathlib

import numpy as np
import pytest

from sensors_io.importers.catalogue import import_catalogue
from sensors_io.importers.keep import ImportSourceError
from sensors_io.importers.physiclear import PhysiclearConfig, list_physiclear, read_labels
from sensors_io.records import RecordsExistError, RecordStore
from sensors_io.schema import ATTRIBUTES, MATERIALS, UNKNOWN
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import entry, film, folder, labels

KEEP = PhysiclearConfig(height=0, max_frames=0, test_share=0)


def test_videos_become_records(tmp_path):
    unknown = dict.fromkeys(("hardness", "roughness", "bumps", "material", "name"))
    cup = entry("cup", split="val", material="glass", videos=["cup_7.avi"])
    source = folder(tmp_path / "in", entry("ball"), cup, entry("fig", split="unlabelled", **unknown))
    seen = []
    report = import_catalogue(list_physiclear(source, KEEP), tmp_path / "out", progress=lambda *now: seen.append(now))
    assert report.contacts == 5
    assert report.skipped == report.unlabelled == ()
    assert dict(report.objects) == {"train": 1, "val": 1, "test": 0, "unlabelled": 1}
    assert seen == [(n, 5) for n in range(1, 6)]
    store = RecordStore(tmp_path / "out")
    assert store.meta.notes["report"]["contacts"] == 5
    assert store.meta.sensors == ("gelsight_mini",)
    trials = [("ball", 0), ("ball", 1), ("cup", 7), ("fig", 0), ("fig", 1)]
    assert [(k.object_id, k.trial) for k in store.contacts] == trials
    ball = store.objects["ball"]
    assert dict(ball.labels) == {"hardness": 1, "roughness": 0, "protrusion": 2, "material": MATERIALS.index("other")}
    assert store.objects["fig"].label_row().tolist() == [UNKNOWN] * 4
    sequence = store.contact(0)["gelsight_mini"]
    assert (sequence.key.motion, sequence.key.site) == ("free", 0)
    assert sequence.frames.shape == (12, 24, 32, 3)
    assert sequence.force_n is None
    np.testing.assert_array_equal(sequence.host_time_ns, np.arange(12) * 40_000_000)
    assert sequence.camera == {"file": "ball_0.avi", "rate_hz": 25.0, "size_px": [24, 32], "frames": 12}


def test_what_cannot_be_read_is_skipped_and_listed(tmp_path):
    listed = [entry("ball", videos=3), entry("cup", hardness=None), entry("jar", videos=1)]
    source = folder(tmp_path / "in", *listed, entry("lid", videos=["cover_0.avi"]))
    videos = source / "videos"
    (videos / "ball_0.avi").write_bytes(b"broken")
    (videos / "ball_2.avi").unlink()
    (videos / "jar_0.avi").write_bytes(b"")
    film(videos / "stray_0.avi")
    report = import_catalogue(list_physiclear(source, KEEP), tmp_path / "out")
    assert report.contacts == 3
    files = {f"{name}.avi" for name in ("ball_0", "ball_2", "jar_0", "cover_0", "stray_0")}
    assert {skip.name for skip in report.skipped} == {*files, "jar", "lid"}
    assert [skip.name for skip in report.unlabelled] == ["cup"]
    store = RecordStore(tmp_path / "out")
    assert set(store.objects) == {"ball", "cup"}
    assert len(store) == 3
    assert len(store.meta.notes["report"]["skipped"]) == 7
    os.utime(videos / "cup_0.avi", ns=(0, 1))  # replaced by another of its size
    refused(RecordsExistError, "when the source had other files", run, source)


def run(source):
    return import_catalogue(list_physiclear(source, KEEP), source.parent / "out")


BALL = entry("ball")


@pytest.mark.parametrize(
    ("items", "message"),
    [
        ([BALL | {"hardness": 3}], r"labels\[hardness\] is 3: must lie in 0..2"),
        ([BALL | {"material": "cheese"}], "material 'cheese' must be one of plastic"),
        ([BALL | {"split": "dev"}], "split is 'dev'"),
        ([BALL | {"object": "a ball"}], "object_id is 'a ball'"),
        ([BALL | {"videos": ["../ball_0.avi"]}], "must be a file name without a directory"),
        ([BALL | {"hardness": "soft"}], "invalid literal"),
        ([BALL | {"hardness": 1.7}], "ball: hardness is 1.7: must be a whole number or null"),
        ([BALL | {"bumps": True}], "ball: bumps is True: must be a whole number or null"),
        ([{key: value for key, value in BALL.items() if key != "bumps"}], "'bumps'"),
        ([BALL, entry("ball", videos=0)], "object 'ball' appears twice"),
        ([BALL, entry("cup") | {"videos": ["ball_0.avi"]}], "video 'ball_0.avi' appears twice; splits"),
        ("{", "correct the entry"),
        ('{"objects": [{"object": "ball", "object": "cup"}]}', "'object' stands there twice"),
    ],
)
def test_labels_that_cannot_be_used_are_named(tmp_path, items, message):
    (tmp_path / "labels.json").write_text(items) if isinstance(items, str) else labels(tmp_path, *items)
    refused(ImportSourceError, message, read_labels, tmp_path / "labels.json")


def test_labels_of_another_encoding_are_named_and_not_quoted(tmp_path):
    (tmp_path / "labels.json").write_text("{}" * 500, encoding="utf-16")
    with pytest.raises(
        ImportSourceError, match=r"labels\.json: UnicodeDecodeError: 'utf-8' codec can't decode"
    ) as found:
        read_labels(tmp_path / "labels.json")
    assert len(str(found.value)) < 300


@pytest.mark.skipif("TOUCHR1_PHYSICLEAR" not in os.environ, reason="TOUCHR1_PHYSICLEAR does not name the recordings")
def test_the_real_recordings(tmp_path):
    source = pathlib.Path(os.environ["TOUCHR1_PHYSICLEAR"])
    report = import_catalogue(list_physiclear(source, PhysiclearConfig(height=60, max_frames=8)), tmp_path / "out")
    assert report.contacts == 437
    assert report.skipped == report.unlabelled == ()
    store = RecordStore(tmp_path / "out")
    objects = {split: {k.object_id for k in map(store.contacts.__getitem__, store.contacts_of_split(split))}
               for split in ("train", "val", "test", "unlabelled")}  # fmt: skip
    assert {split: len(ids) for split, ids in objects.items()} == {"train": 48, "val": 7, "test": 12, "unlabelled": 13}
    assert len(set.union(*objects.values())) == 80
    for attribute in ATTRIBUTES[:3]:
        for split in ("train", "test"):
            assert {store.objects[name].labels[attribute] for name in objects[split]} == {0, 1, 2}
