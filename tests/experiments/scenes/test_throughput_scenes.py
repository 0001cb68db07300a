"""The whole measurement over scenes that cost nothing: from the command line to the report."""

import dataclasses
import sys

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.scenes import throughput_rates, throughput_scenes
from sensors_io import generate, live
from sensors_io.records import RecordStore
from sensors_io.scenes import strength
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.protocol import contact_key
from sensors_io.schema import SENSORS
from tests.experiments.shrunk import run_shrunk
from tests.sensors_io import fakes


def make_contact(config, index):
    key = contact_key(config, index)
    return [fakes.sequence(index, sensor, config.frame_count, key=key) for sensor in SENSORS]


def contacts(config, start=0, stop=None):
    return (make_contact(config, i) for i in range(start, config.contact_count if stop is None else stop))


def look(skins, turn_rad, modulus_mpa):
    """Hard objects bear less than soft ones."""
    bears = 12 + 13 / (1 + np.log10(1 + 10 * np.asarray(modulus_mpa)))
    return strength.Limits(actual_n=bears, rigid_n=11.8 + 0.2 * np.cos(turn_rad))


@pytest.fixture
def cheap(monkeypatch):
    monkeypatch.setattr(live, "make_contact", make_contact)
    monkeypatch.setattr(throughput_rates, "make_contact", make_contact)
    monkeypatch.setattr(generate, "contacts", contacts)
    monkeypatch.setattr(strength, "look", look)
    monkeypatch.setattr(throughput_rates, "part_costs", lambda *_: {"pressure": 1.0, "picture": 2.0})
    return monkeypatch


@pytest.mark.long
def test_the_experiment_runs_shrunken(cheap, tmp_path):
    def killed(command, out, kills, shards, shard_s, advance):
        assert command[6:10] == ["--objects", "4", "--sequences", "32"]
        assert shards == 1
        generate.generate_records(config.scenes(8, 32), out)
        return kills

    config = dataclasses.replace(throughput_scenes.SMOKE, written_contacts=8, kills=5)
    cheap.setattr(throughput_rates, "killed_and_resumed", killed)
    directory = run_shrunk(throughput_scenes, config, tmp_path / "runs", "--cache-dir", str(tmp_path / "cache"))
    results = read_json(directory / "results.json")
    named = {r["name"]: r for r in results["requirements"]}
    assert named["kills at random moments"]["met"]
    assert named["records written over the kills"]["measured"] == 640
    for what in ("missing after the kills", "there twice", "damaged, by their checksums"):
        assert named[f"contacts {what}"]["measured"] == 0
    assert named["contacts unlike an undisturbed writer's"]["measured"] == 0
    assert named["written frames past the strain limit"]["measured"] == 0
    assert results["data"] == {"feed_records": 320, "large_records": 160, "written_records": 640}
    assert not (directory / "written").exists()


def test_what_kills_may_do_to_a_set_is_counted(tmp_path):
    a, b = fakes.write(tmp_path / "a", 4), fakes.write(tmp_path / "b", 4)
    same = throughput_rates.compare(a, b)
    assert same == {
        "records": sum(RecordStore(a).frames.values()),
        **dict.fromkeys(("missing", "repeated", "damaged", "differing"), 0),
    }
    fewer_sensors = fakes.write(tmp_path / "c", 4, sensors=SENSORS[:3])
    assert throughput_rates.compare(a, fewer_sensors)["differing"] == 4
    shorter = fakes.write(tmp_path / "d", 2)
    assert throughput_rates.compare(a, shorter)["missing"] == 2
    shard = min(b.glob("contacts-*"))
    data = bytearray(shard.read_bytes())
    for at in range(len(data) // 4, len(data) // 2, 97):
        data[at] ^= 0xFF
    shard.write_bytes(bytes(data))
    assert throughput_rates.compare(a, b)["damaged"] > 0


def test_a_writer_is_killed_at_random_moments_and_goes_on(tmp_path):
    """The writer publishes a shard every tenth of a second."""
    script = tmp_path / "writer.py"
    script.write_text(
        "import pathlib, sys, time\n"
        "out = pathlib.Path(sys.argv[-1]); out.mkdir(exist_ok=True)\n"
        "for i in range(len(list(out.iterdir())), 6):\n"
        "    time.sleep(0.1); (out / f'contacts-{i}').touch()\n"
    )
    command, out = [sys.executable, str(script), str(tmp_path / "out")], tmp_path / "out"
    assert throughput_rates.killed_and_resumed(command, out, kills=3, shards=6, shard_s=0.1) == 3
    assert len(list(out.iterdir())) == 6


@pytest.mark.long
def test_force_predicts_hardness_when_frames_are_dropped_and_not_when_matched(cheap):
    config = SceneConfig(objects=300, sequences=4 * 600, seed=17)  # plans are cached by config: this one is used once
    dropped, rigid, kept, matched = throughput_scenes.force_leaks(config)
    best = lambda row: max(row[name] for name in throughput_scenes.ORDINAL)
    assert best(kept) < 45
    assert kept["presses that reach 20 N"] == 100
    assert dropped["hardness"] > 70
    assert rigid["hardness"] < 45
    assert best(matched) < 45
    assert matched["median peak"] <= rigid["median peak"]
