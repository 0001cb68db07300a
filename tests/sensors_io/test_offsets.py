"""Offsets come back from their file, and a file that holds none is named."""

import json
import os

import pytest

from sensors_io.offsets import Offset, Offsets, OffsetsError
from tests.sensors_io.checks import refused

FOUND = Offsets(
    reference="netft",
    sensors={
        "gelsight_mini": Offset(late_s=0.031, spread_s=0.002, events=6, by="taps"),
        "tac3d": Offset(late_s=-0.01, spread_s=None, events=0, by="presses", agreement=0.9),
    },
)


def test_offsets_come_back(tmp_path):
    FOUND.save(tmp_path / "s.json")
    assert Offsets.load(tmp_path / "s.json") == FOUND
    assert FOUND.late_s == {"netft": 0.0, "gelsight_mini": 0.031, "tac3d": -0.01}
    assert [p.name for p in tmp_path.iterdir()] == ["s.json"]


@pytest.mark.parametrize(
    "tree",
    [
        [],
        {"reference": "netft"},
        {"reference": "a", "sensors": {"b": {"late_s": 1}}},
        {"reference": "a", "sensors": {"b": {"late_s": 31, "spread_s": 0, "events": 1, "by": "taps"}}},
        {"reference": "a", "sensors": {"b": {"late_s": "0.1", "spread_s": 0, "events": 1, "by": "taps"}}},
        {"reference": "a", "sensors": {"b": {"late_s": float("nan"), "spread_s": 0, "events": 1, "by": "taps"}}},
    ],
)
@pytest.mark.parametrize("end", [None, -1])
def test_anything_else_is_refused(tmp_path, tree, end):
    (tmp_path / "s.json").write_text(json.dumps(tree)[:end])
    refused(OffsetsError, "make them with `sync`", Offsets.load, tmp_path / "s.json")


def test_a_pipe_and_a_value_that_is_there_twice_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    refused(OffsetsError, "a pipe", Offsets.load, tmp_path / "pipe")
    (tmp_path / "s.json").write_text('{"reference": "a", "sensors": {}, "reference": "b"}')
    refused(OffsetsError, "'reference' stands there twice", Offsets.load, tmp_path / "s.json")
