"""The storage experiment, shrunk: every codec is exact or reported as lossy, and the rule picks by size and rate."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.scenes import pareto_storage
from experiments.scenes.pareto_storage import CHANGES, GENERATED, IMPORTED, STILLS, WHOLE, FeedConfig, recorded_clips
from experiments.scenes.storage_codecs import OWN, CodecMeasurement, all_codecs, chosen_filters
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from tests.sensors_io.importers.films import film, picture

RNG = np.random.default_rng(0)
SMOOTH = np.cumsum(RNG.integers(-2, 3, (5, 24, 32, 3)), axis=1).astype(np.uint8)
TINY = pareto_storage.StorageConfig(
    scenes=tiny.SCENES,
    contacts=1,
    videos=2,
    rounds=1,
    feed=FeedConfig(scenes=tiny.SCENES, contacts=1, batch_size=2, batches=1, workers=(0,)),
)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    root = tmp_path_factory.mktemp("recordings")
    (root / "physiclear" / "videos").mkdir(parents=True)
    for n in range(3):
        film(root / "a.avi", 6).rename(root / "physiclear" / "videos" / f"ball_{n}.mov")
    for n in range(2):
        picture(root / "gelslam" / "6.310mm" / str(n) / "gelsight.png", 90 * n)
    return root


@pytest.mark.parametrize("codec", [c for c in all_codecs() if c.kind != "video"], ids=lambda codec: codec.name)
def test_every_codec_gives_every_bit_back(codec, tmp_path):
    clips = [SMOOTH, RNG.integers(0, 256, (3, 7, 5, 3), dtype=np.uint8), np.zeros((1, 4, 4, 3), np.uint8)]
    codec.store(clips, tmp_path)
    loaded = codec.load(tmp_path)
    for before, after in zip(clips, loaded, strict=True):
        np.testing.assert_array_equal(after, before)


@pytest.mark.slow
def test_the_report_holds_every_codec_on_every_kind_of_clips(recordings, tmp_path):
    directory = run_shrunk(pareto_storage, TINY, tmp_path, "--data-dir", str(recordings))
    results = read_json(directory / "results.json")
    *codecs, filters, parts, _ = (table["rows"] for table in results["tables"])
    names = {codec.name for codec in all_codecs() if codec.kind != "video"}
    for table in codecs:
        rows = {row[0]: row for row in table}
        assert names <= set(rows)
        assert all(rows[name][-1] for name in names)
        assert rows["raw"][2] == 1
    assert [row[0] for row in filters] == [GENERATED, IMPORTED, WHOLE, STILLS]
    assert sum(filters[0][1:]) == 3  # three sensors with a camera
    assert [row[0] for row in parts][3:] == [name for name, change in CHANGES.items() if change]
    lossless = {r["name"]: r["met"] for r in results["requirements"]}["kinds of clips that the records' codec changes"]
    assert lossless


def test_kinds_that_are_not_there_are_left_out(recordings, tmp_path, context):
    assert recorded_clips(tmp_path, 2, 4, context) == {}
    found = recorded_clips(recordings, 2, 4, context)
    assert {kind: [clip.shape for clip in clips] for kind, clips in found.items()} == {
        IMPORTED: [(6, 24, 32, 3)] * 2,  # never enlarged
        WHOLE: [(4, 24, 32, 3)] * 2,
        STILLS: [(1, 24, 32, 3)] * 2,
    }


def measured(name, size, read):
    codec = dataclasses.replace(all_codecs()[0], name=name)
    return CodecMeasurement(codec=codec, bytes=size, write_fps=1.0, read_fps=read, exact=True)


def test_the_rule_by_hand():
    group = [measured(*row) for row in (("raw", 100, 90), ("a", 50, 40), ("b", 60, 30), ("c", 20, 10), (OWN, 45, 20))]
    rows = {GENERATED: group, IMPORTED: group}
    assert pareto_storage.fastest_small(rows, 15).name == OWN
    assert pareto_storage.fastest_small(rows, 35).name == "a"
    assert pareto_storage.fastest_small(rows, 1000).name == "raw"
    inexact = {GENERATED: [dataclasses.replace(row, exact=row.codec.name != "c") for row in group]}
    assert pareto_storage.fastest_small(inexact, 5).name == OWN


def test_filters_are_counted():
    assert chosen_filters([np.repeat(SMOOTH[:1], 9, 0), SMOOTH]) == {"none": 0, "time": 1, "rows": 1, "time+rows": 0}
