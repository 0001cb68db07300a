"""Records through Zarr, HDF5 and a LeRobotDataset and back: every array, time, label and card comes back equal."""

import dataclasses
import errno
import functools
import json
import pathlib
import shutil

import numpy as np
import pytest

from sensors_io.codec import encode_card, encode_sequence
from sensors_io.contents import put_rest_pictures, rest_pictures
from sensors_io.errors import UserError
from sensors_io.exporters import selection
from sensors_io.exporters.arrays import export_arrays
from sensors_io.exporters.exported import import_exported
from sensors_io.exporters.lerobot import export_lerobot
from sensors_io.exporters.selection import ExportError, Selected, published
from sensors_io.records import IncompleteRecordsError, MissingIndexError, RecordsExistError, RecordStore, RecordWriter
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused

SILENT = lambda done, total: None
NEEDS = {"zarr": "zarr", "hdf5": "h5py", "lerobot": "av"}


def export(kind: str, records: pathlib.Path, out: pathlib.Path, **changes) -> None:
    selected = Selected(store=RecordStore(records), **changes)
    if kind == "lerobot":
        export_lerobot(selected, out, 0, SILENT)
    else:
        export_arrays(selected, out, kind, SILENT)


def equal(a: RecordStore, b: RecordStore) -> None:
    assert rest_pictures(a.path) == rest_pictures(b.path)
    assert (a.contacts, a.meta) == (b.contacts, b.meta)
    assert [encode_card(card) for card in a.objects.values()] == [encode_card(card) for card in b.objects.values()]
    for i in range(len(a)):
        one, other = a.contact(i), b.contact(i)
        assert list(one) == list(other)
        for sensor, sequence in one.items():
            assert encode_sequence(sequence) == encode_sequence(other[sensor])


def rich(path: pathlib.Path) -> pathlib.Path:
    """Contacts with every array, wide forces, flags, labels and cards with a view and without."""
    with RecordWriter(path, meta=dataclasses.replace(fakes.META, config_hash="cafe", notes={"a": [1, None]})) as writer:
        for n in (1, 0):
            lies = {"visual_lies": n == 0, "truth": {"modulus_mpa": 0.1 + n / 3}}
            writer.write_object(fakes.card(n, **lies, **({"view": None, "view_depth_mm": None} if n else {})))
            for trial in range(2):
                rng = np.random.default_rng([n, trial])
                more = {
                    "shear_mm": rng.normal(0, 0.1, (12, 5, 6, 2)).astype(np.float32),
                    "moment_nmm": rng.normal(0, 300, (12, 3)).astype(np.float32),
                    "target_force_n": np.linspace(0, 20, 12, dtype=np.float32),
                    "device_time_ns": np.arange(12) * 39_999_999 + 2**60,
                    "force_time_ns": np.arange(12) * 40_000_001,
                    "flags": rng.integers(0, 2**14, 12).astype(np.uint32),
                    "contact_grid": rng.integers(0, 200, 12).astype(np.uint16),
                    "calibration": "c0ffee",
                }
                writer.write_contact([fakes.sequence(n, s, trial=trial, **more) for s in ("gelsight_mini", "tac3d")])
    put_rest_pictures(path, {"rest.png": b"a picture"})
    return path


@pytest.mark.long
@pytest.mark.parametrize("kind", NEEDS)
def test_every_array_and_time_comes_back_equal(tmp_path, kind):
    pytest.importorskip(NEEDS[kind])
    records, out, back = rich(tmp_path / "records"), tmp_path / f"out.{kind}", tmp_path / "back"
    export(kind, records, out)
    import_exported(out, back, SILENT)
    equal(RecordStore(records), RecordStore(back))
    import_exported(out, back, SILENT)  # once more changes nothing
    equal(RecordStore(records), RecordStore(back))
    refused(RecordsExistError, "already", import_exported, out, fakes.write(tmp_path / "other", 1), SILENT)


def test_another_recording_of_the_same_sensors_is_not_mixed_in(tmp_path):
    """All recordings of a sensor have one hash of their config; objects, sites and trials begin anew in each."""
    pytest.importorskip("h5py")
    for name, at_rest, length in (("a", b"a", 3), ("b", b"a", 4), ("c", b"another", 3)):
        with RecordWriter(tmp_path / name, meta=fakes.META) as writer:
            writer.write_object(fakes.card(0))
            writer.write_contact([fakes.sequence(0, "xense", length=length)])
        put_rest_pictures(tmp_path / name, {"rest.png": at_rest})
        export("hdf5", tmp_path / name, tmp_path / f"{name}.h5")
    out = tmp_path / "out"
    import_exported(tmp_path / "a.h5", out, SILENT)
    said = "holds another {} than .*records of one name are of one recording; choose another one"
    refused(RecordsExistError, said.format("object_0.*xense"), import_exported, tmp_path / "b.h5", out, SILENT)
    refused(RecordsExistError, said.format("gel at rest rest.png"), import_exported, tmp_path / "c.h5", out, SILENT)
    import_exported(tmp_path / "a.h5", out, SILENT)
    equal(RecordStore(tmp_path / "a"), RecordStore(out))
    assert rest_pictures(out) == {"rest.png": b"a"}


@pytest.mark.parametrize("as_folder", [True, False])
def test_an_export_replaces_none_that_another_process_wrote_meanwhile(tmp_path, as_folder):
    def write(path, text):
        if as_folder:
            path.mkdir()
            path /= "file"
        path.write_text(text)

    def twice(out):
        with published(out) as mine:
            write(mine, "mine")
            write(out, "the other's")

    out = tmp_path / "out"
    refused(ExportError, "must not exist yet", twice, out)
    assert (out / "file" if as_folder else out).read_text() == "the other's"
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("kind", ["zarr", "hdf5"])
def test_trees_hold_contacts_of_any_shape(tmp_path, kind):
    """Sensors, arrays and sizes differ from contact to contact."""
    pytest.importorskip(NEEDS[kind])
    with RecordWriter(tmp_path / "records", meta=fakes.META) as writer:
        writer.write_object(fakes.card(0))
        writer.write_contact([fakes.sequence(0, "xense", length=3, force_n=None)])
        frames = np.zeros((5, 7, 9, 3), np.uint8)
        bare = {"deformation_mm": None, "depth_mm": None, "valid": None}
        writer.write_contact(
            [fakes.sequence(0, length=5, trial=1, frames=frames, **bare), fakes.sequence(0, "tac3d", trial=1)]
        )
    export(kind, tmp_path / "records", tmp_path / "out")
    import_exported(tmp_path / "out", tmp_path / "back", SILENT)
    equal(RecordStore(tmp_path / "records"), RecordStore(tmp_path / "back"))
    if kind == "zarr":
        pytest.importorskip("av")
        refused(ExportError, "differ in .*gelsight", export, "lerobot", tmp_path / "records", tmp_path / "l")
        refused(ExportError, "has 5 frames|one row", export, "lerobot", tmp_path / "records", tmp_path / "l", rows=(1,))
        assert not list(tmp_path.glob("*l*.tmp")) + list(tmp_path.glob("l"))


def test_a_lerobot_dataset_has_the_files_of_version_3(tmp_path):
    """Episodes lie in shared tables and videos; their rows say where; the clock of the timestamps is nominal."""
    pytest.importorskip("av")
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "out"
    export("lerobot", fakes.write(tmp_path / "records", 3), out, sensors=("gelsight_mini",))
    info = json.loads((out / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"], info["total_frames"]) == ("v3.0", 25, 3, 36)
    picture = info["features"]["observation.images.gelsight_mini"]
    assert (picture["dtype"], picture["shape"]) == ("video", [16, 20, 3])
    assert info["features"]["observation.tactile.gelsight_mini.depth_mm"]["shape"] == [5, 6]
    data = parquet.read_table(out / info["data_path"].format(chunk_index=0, file_index=0))
    assert data["index"].to_pylist() == list(range(36))
    np.testing.assert_allclose(data["timestamp"].to_pylist()[12:15], [0, 0.04, 0.08], rtol=1e-6)
    kind = {b"ARROW:extension:name": b"datasets.features.features.Array2DExtensionType"}
    assert kind.items() <= data.schema.field("observation.tactile.gelsight_mini.depth_mm").metadata.items()
    episodes = parquet.read_table(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert [row["dataset_from_index"] for row in episodes] == [0, 12, 24]
    starts = [row["videos/observation.images.gelsight_mini/from_timestamp"] for row in episodes]
    np.testing.assert_allclose(starts, [0, 0.48, 0.96])
    tasks = parquet.read_table(out / "meta" / "tasks.parquet").to_pylist()
    assert tasks == [{"task_index": 0, "task": "press: object_0"}, {"task_index": 1, "task": "press: object_1"}]
    stats = json.loads((out / "meta" / "stats.json").read_text())
    assert stats["observation.tactile.gelsight_mini.force_n"]["min"][2] == pytest.approx(-20)
    assert np.shape(stats["observation.images.gelsight_mini"]["mean"]) == (3, 1, 1)


def test_what_cannot_be_exported_or_read_is_one_line(tmp_path, monkeypatch):
    records = fakes.write(tmp_path / "records", 1)
    store = RecordStore(records)
    refused(ExportError, "sensors is digit: must be of gelsight_mini", Selected, store=store, sensors=("digit",))
    refused(ExportError, r"contacts is \[3\]: must lie in 0..0", Selected, store=store, rows=(3,))
    refused(ExportError, r"contacts is \[0, 0\]: must name each contact once", Selected, store=store, rows=(0, 0))
    read = functools.partial(import_exported, out=tmp_path / "back", progress=SILENT)
    refused(ExportError, "does not exist", read, tmp_path / "gone")
    for out in (records, records / "inside"):
        refused(ExportError, "is the export itself, or lies in it", import_exported, records, out, SILENT)
    pytest.importorskip("h5py")
    export("hdf5", records, tmp_path / "a.h5")
    refused(ExportError, "must not exist yet", export, "hdf5", records, tmp_path / "a.h5")
    (tmp_path / "cut.h5").write_bytes((tmp_path / "a.h5").read_bytes()[:2000])
    refused(ExportError, "is no export of records, or damaged", read, tmp_path / "cut.h5")
    monkeypatch.setattr(selection, "FORMAT", "something")
    refused(ExportError, "this code reads 'something'", read, tmp_path / "a.h5")
    (tmp_path / "l" / "meta" / "touchr1").mkdir(parents=True)
    refused(ExportError, "is no export of records, or damaged", read, tmp_path / "l")
    refused(ExportError, r"pip install 'touchr1-jax\[x\]'", selection.library, "no_such_package", "x")


def damaged(path: pathlib.Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def halved(path: pathlib.Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def emptied(contacts: pathlib.Path) -> None:
    """Leave a contact without sequences."""
    shutil.rmtree(contacts / "000001" / "tac3d")


ARRAY = "contacts/000001/tac3d/force_n"


@pytest.mark.parametrize(
    ("kind", "part", "damage"),
    [
        ("zarr", f"{ARRAY}/c/0/0", damaged),
        ("zarr", f"{ARRAY}/c/0/0", pathlib.Path.unlink),  # Zarr reads what is missing as zeros
        ("zarr", ARRAY, shutil.rmtree),
        ("zarr", "contacts/000001", shutil.rmtree),
        ("zarr", "objects/000000/view_depth_mm/c/0/0", pathlib.Path.unlink),
        ("zarr", "backgrounds/rest.png", shutil.rmtree),
        ("zarr", "contacts", emptied),
        ("lerobot", "videos/observation.images.gelsight_mini/chunk-000/file-000.mp4", halved),
        ("lerobot", "videos/observation.images.gelsight_mini/chunk-000/file-000.mp4", damaged),
        ("lerobot", "data/chunk-000/file-000.parquet", damaged),
        ("lerobot", "meta/touchr1/sequences.parquet", halved),
    ],
)
def test_a_damaged_or_missing_part_of_an_export_is_named(tmp_path, kind, part, damage):
    pytest.importorskip(NEEDS[kind])
    out = tmp_path / "out"
    if kind == "zarr":
        put_rest_pictures(fakes.write(tmp_path / "records", 2, sensors=("tac3d",)), {"rest.png": b"a picture"})
    else:
        fakes.write(tmp_path / "records", 2, sensors=("gelsight_mini",))
    export(kind, tmp_path / "records", out)
    damage(out / part)
    refused(UserError, "export", import_exported, out, tmp_path / "back", SILENT)
    refused((IncompleteRecordsError, MissingIndexError), "back", RecordStore, tmp_path / "back")


def test_a_full_disk_is_no_damage_of_the_export(tmp_path, monkeypatch):
    pytest.importorskip("h5py")
    export("hdf5", fakes.write(tmp_path / "records", 2), tmp_path / "out")
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(RecordWriter, "write_contact", lambda self, contact: (_ for _ in ()).throw(full))
    refused(OSError, "No space left", import_exported, tmp_path / "out", tmp_path / "back", SILENT)


def test_an_export_that_fails_leaves_nothing(tmp_path, monkeypatch):
    pytest.importorskip("h5py")
    records = fakes.write(tmp_path / "records", 2)
    monkeypatch.setattr("sensors_io.exporters.arrays.sequence_text", lambda sequence: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        export("hdf5", records, tmp_path / "out.h5")
    assert [path.name for path in tmp_path.iterdir()] == ["records"]
