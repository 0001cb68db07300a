"""The common import: everything listed is stored or reported, whatever stops it in between."""

import dataclasses
import functools
import os

import numpy as np
import pytest

from sensors_io.importers.catalogue import Catalogue, Listed, Taken, fingerprint, import_catalogue
from sensors_io.importers.estimate_modulus import list_estimate_modulus
from sensors_io.importers.feelanyforce import FeelAnyForceConfig, list_feelanyforce
from sensors_io.importers.keep import ImportConfig, ImportSourceError, Keep, Shares, Skip, UnreadableError
from sensors_io.importers.octopi import list_octopi
from sensors_io.importers.tac3d import list_tac3d
from sensors_io.importers.tacquad import list_tacquad
from sensors_io.importers.touch_and_go import list_touch_and_go
from sensors_io.importers.tvl import list_tvl
from sensors_io.importers.vtv150k import VTVConfig, list_vtv150k
from sensors_io.importers.ycb_slide import list_ycb_slide
from sensors_io.records import RecordsExistError, RecordStore
from sensors_io.schema import ATTRIBUTES, ContactKey
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import EVERYTHING, imported


def take(n, key):
    """Contact n; every third one loses a frame, every seventh cannot be read."""
    if n % 7 == 6:
        raise UnreadableError("is broken")
    lost = (Skip(name=f"frame of {n}", reason="is cut off"),) if n % 3 == 2 else ()
    sequence = fakes.sequence(0, key=key, frames=np.full((12, 16, 20, 3), n % 256, np.uint8))
    return Taken(sequences=(sequence,), left_out=lost)


def catalogue(count=9, view=None):
    contacts = []
    for n in range(count):
        key = ContactKey(object_id=f"object_{n // 3}", site=0, motion="free", trial=n % 3)
        contacts.append(Listed(key=key, name=f"contact {n}", read=functools.partial(take, n, key), view=view))
    cards = {f"object_{n}": fakes.card(n, view=None, view_depth_mm=None) for n in range(-(-count // 3))}
    return Catalogue(
        source="fake",
        licence="none",
        sensors=("gelsight_mini",),
        annotated=ATTRIBUTES[:1],
        cards=cards,
        contacts=tuple(contacts),
        skipped=(Skip(name="stray", reason="is not listed"),),
        config={},
        identity="c0ffee",
    )


def test_what_is_left_out_is_reported(tmp_path):
    report, store = imported(catalogue(), tmp_path / "nine")
    assert report.contacts == len(store) == 8
    assert dict(report.objects) == {"train": 2, "val": 1, "test": 0, "unlabelled": 0}
    assert [skip.name for skip in report.skipped] == ["stray", "contact 6", "frame of 2", "frame of 5", "frame of 8"]
    assert report.unannotated == ATTRIBUTES[1:]
    assert store.meta.notes["report"]["skipped"] == [dataclasses.asdict(skip) for skip in report.skipped]
    report, store = imported(catalogue(7), tmp_path / "seven")  # contact 6 is the only one of object_2
    assert Skip(name="object_2", reason="object without a readable contact") in report.skipped
    assert set(store.objects) == {"object_0", "object_1"}


@pytest.mark.parametrize(
    ("name", "value", "most"), [("depth_mm", 40, "31.999"), ("force_n", 1e30, "1e+06"), ("moment_nmm", -1e30, "1e+09")]
)
def test_a_contact_that_no_record_can_hold_costs_no_other(tmp_path, name, value, most):
    def read():
        shape = (12, 5, 6) if name == "depth_mm" else (12, 3)
        return Taken(sequences=(fakes.sequence(0, **{name: np.full(shape, value, np.float32)}),))

    key = ContactKey(object_id="object_3", site=0, motion="free", trial=0)
    listing = catalogue()
    broken = Listed(key=key, name="deep", read=read)
    cards = {**listing.cards, "object_3": fakes.card(3)}
    report, store = imported(dataclasses.replace(listing, cards=cards, contacts=(broken, *listing.contacts)), tmp_path)
    assert (report.contacts, set(store.objects)) == (8, {"object_0", "object_1", "object_2"})
    reason = {s.name: s.reason for s in report.skipped}["deep"]
    assert f"{name} reaches {abs(value):g}: records hold at most {most}; check the unit" in reason


@pytest.mark.parametrize("stop", [1, 2, 5, 6, 7, 9])
def test_an_interrupted_import_reports_as_if_it_had_not_been(tmp_path, stop):
    def interrupt(done, total):
        if done == stop:
            raise KeyboardInterrupt

    whole = import_catalogue(catalogue(), tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        import_catalogue(catalogue(), tmp_path / "parts", progress=interrupt)
    assert import_catalogue(catalogue(), tmp_path / "parts") == whole
    assert import_catalogue(catalogue(), tmp_path / "parts") == whole  # a finished one is kept
    assert RecordStore(tmp_path / "parts").contacts == RecordStore(tmp_path / "whole").contacts


def test_nothing_readable_is_an_error_and_leaves_nothing(tmp_path):
    listing = catalogue(7)
    broken = dataclasses.replace(listing, contacts=listing.contacts[6:], skipped=())
    said = r"fake: no contact can be read; the first: .*contact 6.*is broken"
    refused(ImportSourceError, said, import_catalogue, broken, tmp_path)
    assert not (tmp_path / "index.json").exists()
    import_catalogue(catalogue(), tmp_path)
    other = dataclasses.replace(catalogue(), identity="abcd", config={"height": 8})
    refused(RecordsExistError, "made by config 'c0ffee', not 'abcd'", import_catalogue, other, tmp_path)


def test_the_fingerprint_is_of_config_names_sizes_times_and_listings(tmp_path):
    def now(config=Keep()):  # noqa: B008
        return fingerprint(tmp_path, [tmp_path / "a", tmp_path / "gone"], config, [tmp_path / "list"])

    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "list").write_bytes(b"x")
    first = now()
    assert now() == first
    assert now(Keep(height=0)) != first
    assert now(ImportConfig()) != first
    (tmp_path / "list").write_bytes(b"y")
    second = now()
    (tmp_path / "a").write_bytes(b"22")
    third = now()
    (tmp_path / "gone").write_bytes(b"")
    fourth = now()
    os.utime(tmp_path / "a", ns=(0, 1))
    assert len({first, second, third, fourth, now()}) == 5


def test_bad_options_are_named():
    refused(ImportSourceError, "val_share is -0.1: must lie in 0", ImportConfig, val_share=-0.1)
    refused(ImportSourceError, "test_share is 1.0: must lie in 0", ImportConfig, test_share=1.0)
    refused(ImportSourceError, "must be < 1; keep some for training", ImportConfig, val_share=0.5, test_share=0.5)
    refused(ImportSourceError, "stride is 0: must be ≥ 1; raise it", ImportConfig, stride=0)
    refused(ImportSourceError, "height is -1: must be ≥ 0", ImportConfig, height=-1)
    refused(ImportSourceError, "max_frames is -1", ImportConfig, max_frames=-1)


@pytest.mark.parametrize(
    ("listing", "config", "expected"),
    [
        (list_estimate_modulus, EVERYTHING, r"<object>_<n>.avi with <object>_<n>_forces.pkl"),
        (list_feelanyforce, FeelAnyForceConfig(), r"<table>.csv with the columns tactile, depth, FT"),
        (list_octopi, Keep(), r"<sample>/data.json and <sample>/tactile"),
        (list_tac3d, Shares(), r"<name>_<serial>.npz"),
        (list_tacquad, EVERYTHING, r"one of contact_indoor.csv, .* with its data_indoor"),
        (list_touch_and_go, EVERYTHING, r"one of label.txt, .* and dataset/<session>/gelsight_frame"),
        (list_tvl, EVERYTHING, r"train.csv or test.csv, in it or in data1"),
        (list_vtv150k, VTVConfig(sensor="digit"), r"<object>_<n>.mp4"),
        (list_ycb_slide, EVERYTHING, r"<object>/dataset_<k>/frames/frame_<7 digits>.jpg"),
    ],
)
def test_a_wrong_directory_says_what_was_expected(tmp_path, listing, config, expected):
    refused(ImportSourceError, f"expected {expected}", listing, tmp_path, config)
