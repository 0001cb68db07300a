"""Octopi-1.5 samples: ratings become thirds, numbers become times, everything else is refused by name."""

import json
import os

import numpy as np
import pytest

from sensors_io.importers.octopi import level_of, list_octopi
from sensors_io.schema import UNKNOWN
from tests.sensors_io.importers.films import EVERYTHING, imported, picture

POTATO = {
    "object_id": "physiclear_potato",
    "object": "an unpeeled, raw potato",
    "properties": {"hardness": 7.67, "roughness": 6.33},
    "exploratory_procedure": "pressing",
    "split": "train",
}


def sample(root, name, data, numbers=(3, 4, 7)):
    for n in numbers:
        picture(root / name / "tactile" / f"{n:010d}.jpg", 20 * n)
    (root / name).mkdir(parents=True, exist_ok=True)
    (root / name / "data.json").write_text(json.dumps(data) if isinstance(data, dict) else data)


@pytest.fixture
def source(tmp_path):
    root = tmp_path / "samples"
    sample(root, "physiclear_2", POTATO | {"exploratory_procedure": "sliding"})
    sample(root, "physiclear_10", POTATO)
    sample(root, "objectfolder_0", {"object_id": "objectfolder_1", "object": "a spoon", "split": "train"})
    return root


def test_samples_become_records(source, tmp_path):
    report, store = imported(list_octopi(source, EVERYTHING), tmp_path / "out")
    assert (report.contacts, report.skipped, report.unlabelled) == (3, (), ())
    assert report.unannotated == ("protrusion", "material")
    assert [(k.object_id, k.motion, k.trial) for k in store.contacts] == [
        ("objectfolder_1", "free", 0),
        ("potato", "free", 0),
        ("potato", "press", 0),
    ]
    card = store.objects["potato"]
    assert (card.split, card.label_row().tolist()) == ("train", [2, 1, UNKNOWN, UNKNOWN])
    assert card.truth == {"hardness_rating_of_10": 7.67, "roughness_rating_of_10": 6.33}
    assert store.objects["objectfolder_1"].split == "unlabelled"
    sequence = store.contact(2)["gelsight_mini"]
    assert sequence.frames.shape == (3, 24, 32, 3)
    np.testing.assert_allclose(sequence.host_time_ns, np.array([2, 3, 6]) / 30 * 1e9, atol=1)
    assert sequence.camera["exploratory_procedure"] == "pressing"
    assert sequence.force_n is None


def test_ratings_are_cut_into_thirds():
    assert [level_of(r) for r in (0, 3.33, 3.34, 6.66, 6.67, 10)] == [0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        ("{", "data.json: "),
        (None, "has no data.json"),
        (os.mkfifo, "has no data.json"),  # who opens it waits, maybe for ever
        (os.mkdir, "has no data.json"),
        ({"object": "nothing"}, "data.json: 'object_id'"),
        (POTATO | {"split": "dev"}, "split is 'dev'"),
        (POTATO | {"properties": {"hardness": 11}}, "rating is 11.0: must lie in 0..10"),
        (POTATO | {"properties": {"hardness": 1.0}}, "contradicts an earlier sample of potato"),
    ],
)
def test_a_sample_without_a_usable_object_is_skipped(source, data, reason):
    sample(source, "physiclear_99", data if isinstance(data, str | dict) else "")
    if not isinstance(data, str | dict):
        (path := source / "physiclear_99" / "data.json").unlink()
        None if data is None else data(path)
    catalogue = list_octopi(source, EVERYTHING)
    assert len(catalogue.contacts) == 3
    [skip] = catalogue.skipped
    assert skip.name == "physiclear_99"
    assert reason in skip.reason


def test_files_among_the_pictures_that_are_not_named_by_a_number_are_named(source, tmp_path):
    """As downloads that were cut short or came twice."""
    folder = source / "physiclear_10" / "tactile"
    (folder / "0000000004.jpg").rename(folder / "0000000004.jpg.crdownload")
    picture(folder / "0000000003 (1).jpg", 9)
    (folder / "._0000000003.jpg").write_bytes(b"of macOS")
    report, _ = imported(list_octopi(source, EVERYTHING), tmp_path / "out")
    assert [(skip.name, skip.reason) for skip in report.skipped] == [
        (f"tactile/{name}", "is not named <number>.jpg") for name in ("0000000003 (1).jpg", "0000000004.jpg.crdownload")
    ]
