"""HDF5 files with links, label tables, enumerations and odd names: nothing is wrong or lost without a word."""

import h5py
import numpy as np
import pytest

from sensors_io.__main__ import main
from sensors_io.importers.hdf5 import HDF5Config, list_hdf5
from sensors_io.importers.hdf5_inspect import inspect
from sensors_io.importers.hdf5_map import read_map
from sensors_io.importers.keep import ImportSourceError
from tests.sensors_io.importers.test_hdf5 import RGB, WHOLE, imported, mapped, trial, write_map


def labelled(folder, layout):
    """Labels of the contacts by object, and what was left out."""
    catalogue = list_hdf5(folder, HDF5Config(map=write_map(folder, layout), **WHOLE))
    return {n: [*card.labels.values()] for n, card in catalogue.cards.items()}, [s.reason for s in catalogue.skipped]


def test_a_contact_behind_a_link_is_one_of_the_file_and_counts_once(tmp_path):
    (tmp_path / "b").mkdir()
    with h5py.File(tmp_path / "b" / "a.h5", "w") as file:
        trial(file.create_group("raw"))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        trial(file.create_group("all/1"))
        trial(file.create_group("trials/0"))
        file["trials/1"], file["trials/2"] = file["all/1"], h5py.SoftLink("/all/1")
        file["trials/3"], file["trials/4"] = h5py.ExternalLink("b/a.h5", "/raw"), h5py.SoftLink("/gone")
        file["trials/0/up"] = h5py.SoftLink("/trials")
    contacts, report = imported(tmp_path, mapped())
    assert len(contacts) == 3
    reasons = {skip.name: skip.reason for skip in report.skipped}
    assert "broken link" in reasons["a.h5/trials/4"]
    assert "no group fits" in reasons["b/a.h5"]
    assert main(["import", "hdf5", str(tmp_path / "a.h5"), "--inspect"]) == 0


def test_labels_that_differ_within_a_contact_are_refused_and_the_others_kept(tmp_path):
    said = {"0": [2, 0, 1], "1": [2, 2], "2": True, "3": h5py.Empty("i4"), "4": np.nan}
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, hardness in said.items():
            trial(group := file.create_group(f"trials/{name}"))
            group.attrs["hardness"] = hardness
    found, reasons = labelled(tmp_path, mapped(labels={"hardness": {"attribute": "hardness"}}))
    assert found == {"a.h5_trials_1": [2]}
    assert len(reasons) == 4
    assert "3 values that differ: must hold one" in reasons[0]


@pytest.mark.parametrize("labels", [[[0, 1], [2, 0]], [0, 1, 2], [0, 0, 2, 2, 2, 2]])
def test_a_table_of_labels_has_one_for_each_contact(tmp_path, labels):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["rgb"], file["rows"], file["hardness"] = RGB, [2, 4], labels
    frames = {"path": "/rgb", "rows": {"lengths": "/rows"}}
    layout = {"labels": {"hardness": {"path": "/hardness"}}}
    found, reasons = labelled(tmp_path, layout | {"sensors": {"mini": {"frames": frames, "rate_hz": 30}}})
    assert not found
    assert all("differ: must hold one or 2, one a row" in reason for reason in reasons)


def test_an_enumeration_is_read_by_its_words(tmp_path):
    kind = h5py.enum_dtype({"hard": 0, "soft": 2})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, number in (("0", 0), ("1", 2)):
            trial(group := file.create_group(f"trials/{name}"))
            group.create_dataset("hardness", data=number, dtype=kind)
            group.attrs.create("roughness", number, dtype=kind)
    labels = inspect([tmp_path / "a.h5"])[1]["labels"]
    assert labels["hardness"] == {"path": "hardness", "names": {"hard": "?", "soft": "?"}}
    assert labels["roughness"]["names"] == {"hard": "?", "soft": "?"}
    plain = {name: {key: of[key] for key in of if key != "names"} for name, of in labels.items()}
    assert "'hard': must be a whole number, or one of" in labelled(tmp_path, mapped(labels=plain))[1][0]
    named = {name: of | {"names": {"hard": 2, "soft": 0}} for name, of in labels.items()}
    assert [*labelled(tmp_path, mapped(labels=named))[0].values()] == [[2, 2], [0, 0]]


def test_objects_of_different_names_or_folders_stay_different(tmp_path):
    said = ("杯", "碗", "a b", "a_b", np.bytes_(b"\xfe"), np.bytes_(b"\xff"), "杯")
    (tmp_path / "b").mkdir()
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for n, name in enumerate(said):
            trial(group := file.create_group(f"trials/{n}"))
            group.attrs["object"] = name
    found, _ = labelled(tmp_path, mapped(object_id={"attribute": "object"}))
    assert [*found] == ["object", "object_2", "a_b_2", "a_b", "xfe", "xff"]
    (tmp_path / "b" / "a.h5").write_bytes((tmp_path / "a.h5").read_bytes())
    assert len(labelled(tmp_path, mapped())[0]) == 2 * len(said)


def test_a_mapping_that_says_something_twice_or_names_by_a_list_is_refused(tmp_path):
    path = write_map(tmp_path, mapped(labels={"hardness": {"attribute": "x", "names": {"soft": 0, "hard": 2}}}))
    path.write_text(path.read_text().replace('"hard"', '"soft"'))
    with pytest.raises(ImportSourceError, match="'soft' stands there twice in one object: keep one"):
        read_map(path)
    for value in (None, [1, 2], {}):
        with pytest.raises(ImportSourceError, match=r"object_id: value is .*: must be a text or a number"):
            read_map(write_map(tmp_path, mapped(object_id={"value": value})))


@pytest.mark.parametrize("unit", ["μm", "µm", ["mm"], [b"mm", b"mm"], "inch", "N", "nm"])
def test_a_stated_unit_is_understood_in_a_list_in_other_spellings_and_of_another_quantity(tmp_path, unit):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        trial(file)
        file["mini/depth"].attrs["unit"] = unit
    with pytest.raises(ImportSourceError, match=r"states the unit '.+', the mapping 'm' for depth_mm"):
        imported(tmp_path, mapped() | {"contact": "/"})


def test_listing_and_proposal_bear_odd_files(tmp_path, capsys):
    with h5py.File(tmp_path / "b.dat", "w") as file:
        trial(file.create_group("raw"))
        file["raw/hardness"] = 2
    with h5py.File(tmp_path / "a.h5", "w") as file:
        trial(file.create_group("trials/0"))
        file["trials/1"], file["trials/0/self"] = h5py.ExternalLink("b.dat", "/raw"), file["trials/0"]
        file["none"], file["trials/0/hardness"] = h5py.Empty("f4"), 1
        file.create_group("meta/hardness")
        file.attrs["none"], file.attrs["red"] = h5py.Empty("S1"), "a\nb\x1b[31m"
    assert main(["import", "hdf5", str(tmp_path), "--inspect"]) == 0
    said = capsys.readouterr().out
    assert "none  float32 without a value" in said
    assert "self/  (a link to /trials/0)" in said
    assert "@red = a b [31m" in said
    assert '"contact": "/trials/*"' in said


def test_rows_that_a_file_of_kilobytes_states_and_no_memory_holds_are_refused(tmp_path):
    """Chunks that nobody wrote take no place in a file."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        trial(group := file.create_group("trials/0"))
        del group["mini/rgb"], group["mini/time"]
        group.create_dataset("mini/rgb", shape=(2 * 10**7, 4, 4, 3), dtype="u1", chunks=(1, 4, 4, 3))
        group.create_dataset("mini/time", shape=(2 * 10**7,), dtype="f8", chunks=(1024,))
    assert (tmp_path / "a.h5").stat().st_size < 50_000
    with pytest.raises(ImportSourceError, match="has 20000000 rows: must have ≤ 10000000; cut the recording"):
        imported(tmp_path, mapped(mini={"depth_mm": None}))
