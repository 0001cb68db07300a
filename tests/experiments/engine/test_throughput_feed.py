"""What accelerators ask for, shrunken, and what a scale is held to."""

import dataclasses

import pytest
from rich.console import Console

from experiments.core.context import Context
from experiments.engine import throughput_feed
from experiments.engine.feed_scales import FeedScale
from experiments.engine.throughput_feed import SMOKE, FeedingConfig
from experiments.paper import presets
from tests.experiments import tiny

STUDY = dataclasses.replace(tiny.STUDY, clip_memory_gib=0.0002)  # of a quarter of the clips, more or less


@pytest.fixture(scope="module")
def results(cache_dir, tmp_path_factory):
    scales = {"tiny": FeedScale(study=STUDY, devices=2, contacts=tiny.SCENES.objects)}
    context = Context(tmp_path_factory.mktemp("feed"), cache_dir, Console(quiet=True))
    findings = throughput_feed.run(dataclasses.replace(SMOKE, scales=scales), context)
    context.close()
    return findings


def test_every_feed_of_a_scale_is_held_to_the_bound(results):
    assert [r.name for r in results.requirements] == [
        "tiny, sft, memory: device stands still",
        "tiny, grpo, memory: device stands still",
    ]
    assert all(r.bound == 0.02 and 0 <= r.measured < 1 for r in results.requirements)


def test_cores_are_the_batch_over_the_step(results):
    (table,) = results.tables
    rows = [dict(zip((c.name for c in table.columns), row, strict=True)) for row in table.rows]
    assert [row["feed"] for row in rows] == ["tiny, sft, records", "tiny, sft, memory", "tiny, grpo, memory"]
    for row in rows:
        assert row["cores needed"] == pytest.approx(row["made in"] / row["step"])


def test_it_says_that_no_accelerator_was_measured(results):
    assert "No accelerator was at work" in results.verdict[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"cores": 0}, "cores is 0"), ({"batches": 0}, "batches is 0"), ({"steps": 1}, "steps is 1: must be at least 2")],
)
def test_bad_settings_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        FeedingConfig(**changes)


def test_devices_must_share_a_batch_evenly():
    with pytest.raises(ValueError, match=r"devices is 3: must divide sft\.batch_size = 64"):
        FeedScale(study=presets.GPU, devices=3, contacts=8)


def test_steps_last_longer_where_fewer_cores_are_here(monkeypatch):
    monkeypatch.setattr(throughput_feed, "cores_here", lambda: 2)
    by_need = {need: throughput_feed.stretch(FeedingConfig(cores=16), need) for need in (0.1, 1.0, 3.0, 8.0, 50.0)}
    assert by_need == {0.1: 1, 1.0: 1, 3.0: 3, 8.0: 8, 50.0: 8}
    monkeypatch.setattr(throughput_feed, "cores_here", lambda: 32)
    assert throughput_feed.stretch(FeedingConfig(cores=16), 50.0) == 1
