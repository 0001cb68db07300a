"""TensorBoard's event files say what `metrics.jsonl` says, read back from the disk."""

import struct
import sys

import pytest
from tensorboardX.proto.event_pb2 import Event, SessionLog

from experiments.core import events
from experiments.core.context import MetricLog
from experiments.core.events import Events
from experiments.core.runner import main

FAKES = "tests.experiments.fakes"


def read_events(folder):
    """The events of a stage, file after file: each has its length, a checksum of that, its bytes, a checksum."""
    found = []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        content, at = path.read_bytes(), 0
        while at < len(content):
            (size,) = struct.unpack_from("<Q", content, at)
            found.append(Event.FromString(content[at + 12 : at + 12 + size]))
            at += 16 + size
    return found


def curve(folder, name):
    """Step → value as TensorBoard shows it: a session that starts drops what earlier ones wrote at or past its step."""
    points = {}
    for event in read_events(folder):
        if event.session_log.status == SessionLog.START:
            points = {step: value for step, value in points.items() if step < event.step}
        points |= [(event.step, value.simple_value) for value in event.summary.value if value.tag == name]
    return points


def log(path, steps, scale):
    written = Events(path / "events")
    lines = MetricLog(path / "metrics.jsonl", [written])
    for step in steps:
        lines.append("grpo/paid/0", step, {"reward": scale * step, "levels": [1, 2], "whole": 3})
    lines.close()
    written.closed()


def test_a_resumed_stage_shows_what_its_last_session_logged(tmp_path):
    log(tmp_path, range(6), 1.0)
    log(tmp_path, range(4, 8), 0.5)
    folder = tmp_path / "events" / "grpo" / "paid" / "0"
    assert curve(folder, "reward") == {0: 0, 1: 1, 2: 2, 3: 3, 4: 2, 5: 2.5, 6: 3, 7: 3.5}
    assert curve(folder, "whole") == dict.fromkeys(range(8), 3)
    assert curve(folder, "levels") == {}


def test_a_run_writes_them_when_it_is_told_to(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["coin", "--scale", "smoke", "--tensorboard"], package=FAKES) == 0
    folder = tmp_path / "runs/coin/latest/events/train/unpaid/1"
    assert curve(folder, "reward") == pytest.approx({0: 0, 1: 1 / 3, 2: 2 / 3})
    assert main(["coin", "--scale", "smoke"], package=FAKES) == 0
    assert not (tmp_path / "runs/coin/latest/events").exists()


def test_without_the_package_nothing_begins_and_the_cure_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, events.PACKAGE, None)
    assert main(["coin", "--tensorboard"], package=FAKES) == 2
    assert "pip install 'touchr1-jax[tensorboard]'" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
    with pytest.raises(ModuleNotFoundError, match="tensorboardX"):
        Events(tmp_path)
