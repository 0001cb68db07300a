"""HDF5 files of four layouts become records whose arrays equal those that h5py reads."""

import json
import time

import cv2
import h5py
import numpy as np
import pytest

from sensors_io.__main__ import main
from sensors_io.importers.catalogue import import_catalogue
from sensors_io.importers.hdf5 import HDF5Config, list_hdf5
from sensors_io.importers.hdf5_inspect import inspect
from sensors_io.importers.hdf5_map import read_map
from sensors_io.importers.keep import ImportSourceError
from sensors_io.records import RecordStore
from sensors_io.schema import MATERIALS, Flag

RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (6, 8, 10, 3), np.uint8)
DEPTH_M = RNG.uniform(0, 2e-3, (6, 5, 4))
FORCE = RNG.normal(0, 4, (12, 3))
TIME_S, FORCE_TIME_S = 100 + np.arange(6) / 30, 100 + np.arange(12) / 60
WHOLE = {"height": 0, "max_frames": 0, "val_share": 0.0, "test_share": 0.0}


def trial(group, *, at=0.0):
    """A contact as most laboratories write it: a group of a camera and one of a force sensor twice as fast."""
    group["mini/rgb"] = RGB
    group["mini/time"] = TIME_S + at
    group["mini/depth"] = DEPTH_M
    group["mini/depth"].attrs["unit"] = "m"
    group["ft/force"] = FORCE
    group["ft/time"] = FORCE_TIME_S + at


def mapped(**changes):
    """The mapping of `trial` in /trials; an array of `changes` that is `None` is left out."""
    mini = {
        "frames": {"path": "mini/rgb"},
        "host_time_ns": {"path": "mini/time", "unit": "s"},
        "depth_mm": {"path": "mini/depth", "unit": "m"},
        "force_n": {"path": "ft/force", "unit": "N", "time": {"path": "ft/time", "unit": "s"}},
    } | changes.pop("mini", {})
    mini = {name: array for name, array in mini.items() if array is not None}
    return {"contact": "/trials/*", "sensors": {"gelsight_mini": mini}, **changes}


def write_map(folder, layout):
    path = folder / "map.json"
    path.write_text(json.dumps(layout))
    return path


def imported(folder, layout, out="records"):
    """Sequences and report of an import."""
    report = import_catalogue(list_hdf5(folder, HDF5Config(map=write_map(folder, layout), **WHOLE)), folder / out)
    store = RecordStore(folder / out)
    return [tuple(store.contact(i).values()) for i in range(len(store))], report


def test_rows_by_unsigned_lengths_share_one_value_and_pictures_in_0_to_1_need_no_stated_unit(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["rgb"], file["rows"], file["hardness"] = RGB / 255.0, np.array([2, 4], np.uint32), 1.5
        file.attrs["object"] = "mug"
    frames = {"path": "/rgb", "unit": "1", "rows": {"lengths": "/rows"}}
    layout = {"object_id": {"attribute": "object"}, "sensors": {"gelsight_mini": {"frames": frames, "rate_hz": 30}}}
    contacts, report = imported(tmp_path, layout)
    assert [(skip.name, skip.reason) for skip in report.skipped] == [("hardness", "not in the mapping")]
    np.testing.assert_array_equal(np.concatenate([sequence.frames for (sequence,) in contacts]), RGB)
    labelled = layout | {"labels": {"hardness": {"path": "/hardness"}}}
    skips = list_hdf5(tmp_path, HDF5Config(map=write_map(tmp_path, labelled))).skipped
    assert [skip.name for skip in skips] == ["a.h5", "a.h5, row 1"]
    assert all("hardness is " in skip.reason for skip in skips)  # 1.5 is no level


def test_groups_by_trial_with_force_of_another_rate(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for n, name in enumerate(("mug", "cup", "mug")):
            trial(file.create_group(f"trials/trial_{n}"), at=float(n))
            file[f"trials/trial_{n}"].attrs["object"] = name
            file[f"trials/trial_{n}"].attrs["hardness"] = 2
    values = {"object_id": {"attribute": "object"}, "labels": {"hardness": {"attribute": "hardness"}}}
    contacts, report = imported(tmp_path, mapped(**values))
    assert (report.contacts, report.objects["train"], report.skipped) == (3, 2, ())
    for contact in contacts:
        (sequence,) = contact
        np.testing.assert_array_equal(sequence.frames, RGB)
        np.testing.assert_allclose(sequence.depth_mm, 1e3 * DEPTH_M, atol=5e-4)  # the records' scale
        np.testing.assert_allclose(sequence.force_n, FORCE[::2], atol=1e-3)
        assert (np.diff(sequence.host_time_ns) - 1e9 / 30 < 300).all()  # float64 seconds have steps of some ns here
        assert not sequence.flags.any()
    assert {contact[0].key.object_id for contact in contacts} == {"mug", "cup"}


def test_labels_in_words_are_named_by_the_mapping(tmp_path):
    said = (("soft", "steel", 1.0), ("rigid", "wood", 2.0), ("?", "steel", 3.0))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for n, (hardness, material, roughness) in enumerate(said):
            trial(group := file.create_group(f"trials/{n}"))
            group.attrs["hardness class"], group.attrs["material"], group["info/roughness"] = (
                hardness,
                material,
                roughness,
            )
    labels = inspect([tmp_path / "a.h5"])[1]["labels"]
    assert labels == {
        "hardness": {"attribute": "hardness class", "names": {"?": "?", "rigid": "?", "soft": "?"}},
        "roughness": {"path": "info/roughness", "names": {"1": "?", "2": "?", "3": "?"}},
        "material": {"attribute": "material", "names": {"steel": "?", "wood": "?"}},
    }
    with pytest.raises(ImportSourceError, match=r"hardness: names: '\?' is '\?': must be one of -1, 0, 1, 2; correct"):
        read_map(write_map(tmp_path, mapped(labels=labels)))
    labels["hardness"]["names"] = {"?": -1, "rigid": 2, "soft": 0}
    labels["roughness"]["names"] = {"1": 0, "2": 1, "3": 2}
    labels["material"]["names"] = {"steel": "metal", "wood": "wood"}
    catalogue = list_hdf5(tmp_path, HDF5Config(map=write_map(tmp_path, mapped(labels=labels)), **WHOLE))
    metal, wood = MATERIALS.index("metal"), MATERIALS.index("wood")
    assert [[*card.labels.values()] for card in catalogue.cards.values()] == [
        [0, 0, metal],
        [2, 1, wood],
        [-1, 2, metal],
    ]
    del labels["material"]["names"]["wood"]
    (skip,) = list_hdf5(tmp_path, HDF5Config(map=write_map(tmp_path, mapped(labels=labels)))).skipped
    assert "material is 'wood': the names of the mapping lack it" in skip.reason


def test_ragged_rows_of_compressed_arrays(tmp_path):
    lengths = [2, 3, 1]
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.create_dataset("rgb", data=RGB.transpose(0, 3, 1, 2), compression="gzip", chunks=(1, 3, 8, 10))
        file.create_dataset("depth", data=1e6 * DEPTH_M.transpose(1, 2, 0), compression="lzf")
        file["lengths"], file["name"] = lengths, [b"mug", b"cup", b"jar"]
    rows = {"rows": {"lengths": "/lengths"}}
    arrays = {
        "frames": {"path": "rgb", "axes": "NCHW", "components": ["b", "g", "r"], **rows},
        "depth_mm": {"path": "depth", "unit": "um", "axes": "HWN", **rows},
        "rate_hz": 50,
    }
    layout = {"sensors": {"digit": arrays}, "object_id": {"path": "name"}}
    contacts, report = imported(tmp_path, layout)
    assert report.contacts == 3
    first = 0
    for (sequence,), length, name in zip(contacts, lengths, ("mug", "cup", "jar"), strict=True):
        assert sequence.key.object_id == name
        np.testing.assert_array_equal(sequence.frames, RGB[first : first + length, ..., ::-1])
        np.testing.assert_allclose(sequence.depth_mm, 1e3 * DEPTH_M[first : first + length], atol=5e-4)
        np.testing.assert_array_equal(sequence.host_time_ns, 20_000_000 * np.arange(length))
        first += length
    layout["sensors"]["digit"]["frames"]["rows"] = {"offsets": "/offsets"}
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["offsets"] = [0, 2, 5, 7]
    assert "7 are stated" in " ".join(skip.reason for skip in imported(tmp_path, layout, "again")[1].skipped)


def test_a_file_for_each_contact_and_pictures_as_png(tmp_path):
    for n in range(2):
        with h5py.File(tmp_path / f"press_{n}.h5", "w") as file:
            rows = file.create_dataset("left/image", (6,), h5py.vlen_dtype(np.uint8))
            for i, frame in enumerate(RGB):
                rows[i] = cv2.imencode(".png", frame[..., ::-1])[1].ravel()
            file["wrench"] = np.concatenate([FORCE[::2], 7 + FORCE[::2]], -1)
    components = ["x", "-y", "z", None, None, None]
    arrays = {
        "frames": {"path": "left/image", "encoded": True},
        "force_n": {"path": "wrench", "unit": "N", "components": components},
        "rate_hz": 30.0,
    }
    contacts, _ = imported(tmp_path, {"motion": {"value": "press"}, "sensors": {"xense": arrays}})
    assert [contact[0].key.object_id for contact in contacts] == ["press_0.h5", "press_1.h5"]
    np.testing.assert_array_equal(contacts[1][0].frames, RGB)
    np.testing.assert_allclose(contacts[1][0].force_n, FORCE[::2] * (1, -1, 1), atol=1e-3)


def test_several_sensors_of_different_rates(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("trials/0")
        trial(group)
        group["tac3d/disp"] = np.full((30, 4, 4, 2), 0.25)
        group["tac3d/stamp"] = (1e6 * (100 + np.arange(30) / 100)).astype(np.int64)
    layout = mapped()
    layout["sensors"]["tac3d"] = {
        "deformation_mm": {"path": "tac3d/disp", "unit": "mm"},
        "host_time_ns": {"path": "tac3d/stamp", "unit": "us"},
        "force_n": {"path": "ft/force", "unit": "N", "time": {"path": "ft/time", "unit": "s"}},
    }
    ((mini, tac3d),), _ = imported(tmp_path, layout)
    assert (len(mini), len(tac3d)) == (6, 30)
    np.testing.assert_array_equal(np.diff(tac3d.host_time_ns), 10_000_000)
    after = (tac3d.host_time_ns - tac3d.host_time_ns[0]) / 1e9 > 11 / 60 + 1e-6  # the force sensor had stopped
    np.testing.assert_array_equal(tac3d.flags != 0, after)
    assert set(tac3d.flags[after].tolist()) == {int(Flag.INCOMPLETE)}
    expected = [np.interp(np.arange(30) / 100, np.arange(12) / 60, FORCE[:, c]) for c in range(3)]
    np.testing.assert_allclose(tac3d.force_n, np.transpose(expected), atol=2e-3)


@pytest.mark.parametrize(
    ("name", "entry", "good", "bad", "said"),
    [
        ("shear_mm", {"unit": "mm"}, np.ones((6, 5, 4, 2)), np.full((6, 5, 4, 2), 2e3), "reaches 2e+03 as shear_mm"),
        ("shear_mm", {"unit": "m"}, np.full((6, 5, 4, 2), 1e-3), np.ones((6, 5, 4, 2)), "a sensor gives at most 20"),
        ("depth_mm", {"unit": "mm"}, np.ones((6, 5, 4)), 1e-6 * DEPTH_M, "a sensor gives at least 0.001"),
        ("depth_mm", {"unit": "mm"}, np.ones((6, 5, 4)), np.full((6, 5, 4), np.nan), "no frame of finite values"),
        ("force_n", {"unit": "N"}, FORCE[:6], None, "lacks x, which the mapping names for force_n"),
        ("force_n", {"unit": "N"}, FORCE[:6], FORCE, "force_n has 12"),
        ("force_n", {"unit": "N"}, FORCE[:6], FORCE[:6, :2], "has 2 components: must have x, y, z"),
        ("frames", {}, RGB, RGB[..., 0], "has shape (6, 8, 10): must have axes NHWC"),
        ("frames", {}, RGB, RGB.astype(np.float32), "holds float32: must hold uint8"),
        ("shear_mm", {"unit": "mm"}, np.ones((6, 5, 4, 2)), np.ones((6, 3, 3, 2)), "dimension h must be"),
        ("host_time_ns", {"unit": "s"}, TIME_S, TIME_S[::-1], "runs backwards"),
        ("host_time_ns", {"unit": "s"}, TIME_S, np.full(6, np.inf), "times that are not finite"),
    ],
)
def test_a_contact_that_does_not_fit_is_left_out_by_name(tmp_path, name, entry, good, bad, said):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for n, array in enumerate((good, bad)):
            trial(file.create_group(f"trials/{n}"))
            if array is not None:
                file[f"trials/{n}/x"] = array
    contacts, report = imported(tmp_path, mapped(mini={name: {"path": "x", **entry}}))
    assert len(contacts) == 1
    assert any(skip.name == "a.h5/trials/1" and said in skip.reason for skip in report.skipped), report.skipped


def test_a_unit_that_the_file_contradicts_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        trial(file.create_group("trials/0"))
    with pytest.raises(ImportSourceError, match=r"states the unit 'm', the mapping 'mm' for depth_mm"):
        imported(tmp_path, mapped(mini={"depth_mm": {"path": "mini/depth", "unit": "mm"}}))
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["trials/0/ft/force"].attrs["unit"] = "counts"
    _, report = imported(tmp_path, mapped())
    assert [skip.reason for skip in report.skipped] == [
        "ft/force states the unit 'counts', which is not known: taken for 'N'"
    ]


def test_an_optional_array_may_be_missing_and_a_cut_file_is_named(tmp_path):
    for name in ("a.h5", "cut.h5"):
        with h5py.File(tmp_path / name, "w") as file:
            trial(file.create_group("trials/0"))
            del file["trials/0/ft"]
    data = (tmp_path / "cut.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(data[: len(data) // 2])
    force = {"path": "ft/force", "unit": "N", "time": {"path": "ft/time", "unit": "s"}, "optional": True}
    (((sequence,),), report) = imported(tmp_path, mapped(mini={"force_n": force}))
    assert sequence.force_n is None
    reasons = {skip.name: skip.reason for skip in report.skipped}
    assert "cannot be read" in reasons["cut.h5"]
    assert reasons["a.h5/trials/0, gelsight_mini"] == "lacks force_n"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"sensors": {}}, "sensors is empty"),
        ({"colour": 1}, "'colour' must be one of source"),
        ({"mini": {"depth_mm": {"path": "d", "unit": "inch"}}}, "unit is 'inch': must be one of 'm', 'cm'"),
        ({"mini": {"depth_mm": {"path": "d", "unit": "m", "axes": "NCHW"}}}, "axes is 'NCHW': must be NHW"),
        ({"mini": {"force_n": {"path": "f", "unit": "N", "components": ["x", "x", "z"]}}}, "must name x, y, z once"),
        ({"mini": {"frames": {"path": "f", "components": ["-r", "g", "b"]}}}, "colours have no sign"),
        ({"mini": {"host_time_ns": None}}, "rate_hz is None"),
        ({"mini": {"host_time_ns": {"path": "t", "unit": "s", "optional": True}}}, "leave `optional` and `time` out"),
        ({"mini": {"frames": None, "depth_mm": None}}, "needs one of them"),
        ({"object_id": {"attribute": "a", "path": "b"}}, "must hold one of attribute, path, value"),
        ({"mini": {"frames": {"path": 3}}}, "path is 3: must be a text"),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused_by_name(tmp_path, change, said):
    with pytest.raises(ImportSourceError, match=said.replace("(", r"\(")):
        read_map(write_map(tmp_path, mapped(**change)))


def test_a_proposal_needs_units_and_then_imports(tmp_path, capsys):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for n in range(3):
            trial(file.create_group(f"trials/{n}"))
    assert main(["import", "hdf5", str(tmp_path), "--inspect"]) == 0
    shown = capsys.readouterr().out
    assert "rgb  uint8[6, 8, 10, 3]" in shown
    assert "… with the arrays of 0: 1, 2\n" in shown
    layout = inspect([tmp_path / "a.h5"])[1]
    assert layout["contact"] == "/trials/*"
    wrong = HDF5Config(map=write_map(tmp_path, mapped(contact="/x/*")))
    assert [s.reason for s in list_hdf5(tmp_path, wrong).skipped] == ["no group fits contact '/x/*'; see `--inspect`"]
    assert layout["sensors"]["? mini"]["depth_mm"] == {"path": "mini/depth", "unit": "m"}  # stated by the file
    with pytest.raises(ImportSourceError, match=r"'\? mini': must be one of gelsight_mini"):
        read_map(write_map(tmp_path, layout))
    layout["sensors"] = {"gelsight_mini": layout["sensors"]["? mini"]}
    mini = layout["sensors"]["gelsight_mini"]
    for said, entry, name, value in (
        (r"licence is '\?'", layout, "licence", "CC BY 4.0"),
        (r"motion is '\?'", layout["motion"], "value", "press"),
        (r"force_n: unit is '\?'", mini["force_n"], "unit", "N"),
        (r"time: unit is '\?'", mini["force_n"]["time"], "unit", "s"),
        (r"components is \['\?', '\?', '\?'\]", mini["force_n"], "components", ["x", "y", "z"]),
        (r"host_time_ns: unit is '\?'", mini["host_time_ns"], "unit", "s"),
    ):
        with pytest.raises(ImportSourceError, match=said):
            read_map(write_map(tmp_path, layout))
        entry[name] = value
    path = write_map(tmp_path, layout)
    assert main(["import", "hdf5", str(tmp_path), "--map", str(path), "--out", str(tmp_path / "records")]) == 0
    assert len(RecordStore(tmp_path / "records")) == 3


def test_a_draft_is_of_all_files_and_a_force_that_pulls_is_refused(tmp_path, capsys):
    for name, hardness in (("a", "soft"), ("b", "hard")):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            for n in range(2):
                trial(group := file.create_group(f"{name}/{n}"))
                group.attrs["hardness"] = hardness
                del group["ft/force"]
                group["ft/force"] = np.abs(FORCE)
    assert main(["import", "hdf5", str(tmp_path), "--inspect"]) == 0
    assert "b.h5: the arrays of a.h5\n" in capsys.readouterr().out
    draft = inspect(sorted(tmp_path.glob("*.h5")))[1]
    assert (draft["contact"], draft["labels"]["hardness"]["names"]) == ("/*/*", {"hard": "?", "soft": "?"})
    with pytest.raises(ImportSourceError, match=r"Fz = \+.* N, which pulls at the gel"):
        imported(tmp_path, mapped(contact="/*/*"))
    force = mapped()["sensors"]["gelsight_mini"]["force_n"] | {"components": ["x", "y", "-z"]}
    contacts, _ = imported(tmp_path, mapped(contact="/*/*", mini={"force_n": force}))
    assert len(contacts) == 4
    assert main(["check", str(tmp_path / "records")]) == 0
    assert f"{-np.abs(FORCE[::2, 2]).max():.3g}" in capsys.readouterr().out  # the least Fz of the table


@pytest.mark.long
def test_contacts_of_one_object_without_numbers_are_numbered_in_linear_time(tmp_path):
    count = 1_000
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for n in range(count):
            file.create_group(f"trials/{n}").attrs["object"] = "mug"
    config = HDF5Config(map=write_map(tmp_path, mapped(object_id={"attribute": "object"})), **WHOLE)
    began = time.process_time()
    catalogue = list_hdf5(tmp_path, config)
    assert [listed.key.trial for listed in catalogue.contacts] == list(range(count))
    assert time.process_time() - began < 2.0


def test_absurd_values_and_sizes_are_left_out_by_name(tmp_path):
    """Numbers that are cut to whole ones, times beyond 64 bits, a picture beyond memory, pictures of two sizes."""
    small, large = (cv2.imencode(".png", RGB[0, :rows])[1] for rows in (4, 8))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        trial(file.create_group("trials/t"))
        file["huge"] = 2**62 + np.arange(6)
        file["late"] = np.arange(6) * 1e300
        file.create_dataset("wide", (6, 10**6, 10**6, 3), np.uint8, chunks=(1, 100, 100, 3))
        file["rows"] = [2**62, 2**62]
        jpg = file.create_dataset("pictures", (6,), h5py.vlen_dtype(np.uint8))
        for i in range(6):
            jpg[i] = small if i % 2 else large
    second = {"unit": "s", "path": "/huge"}
    for changes, reason in (
        ({"labels": {"hardness": {"value": 1.7}}}, "hardness is 1.7: must be a whole number"),
        ({"site": {"value": 2**32}}, "site is 4294967296: must lie in 0"),
        ({"mini": {"host_time_ns": second}}, "beyond 64 bits of nanoseconds"),
        ({"mini": {"host_time_ns": second | {"path": "/late"}}}, "beyond 64 bits of nanoseconds; is the unit"),
        ({"mini": {"frames": {"path": "/wide"}, "depth_mm": None}}, "cannot be read: Unable to allocate"),
        ({"mini": {"frames": {"path": "/pictures", "encoded": True}}}, "pictures of different sizes"),
        ({"mini": {"frames": {"path": "mini/rgb", "rows": {"lengths": "/rows"}}}}, "/rows must hold the lengths"),
        ({"mini": {"frames": {"path": "\ud800"}}}, "cannot be read: .*surrogates not allowed"),
    ):
        with pytest.raises(ImportSourceError, match=f"no contact can be read.*{reason}"):
            imported(tmp_path, mapped(**changes))
    with pytest.raises(ImportSourceError, match="host_time_ns: 'time' must be one of"):
        imported(tmp_path, mapped(mini={"host_time_ns": second | {"time": second}}))
