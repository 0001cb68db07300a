"""Atomic files and JSON values."""

import dataclasses
import enum
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core import artifacts
from experiments.core.artifacts import jsonable


class Colour(enum.Enum):
    RED = "red"


@dataclasses.dataclass(frozen=True)
class Inner:
    path: Path
    sizes: tuple[int, ...]


def test_jsonable_covers_what_configs_and_results_hold():
    value = {
        "inner": Inner(Path("a/b"), (1, 2)),
        "colour": Colour.RED,
        "array": np.eye(2, dtype=np.float32),
        "scalar": jnp.float32(0.5),
        "flag": np.bool_(True),
        "nothing": None,
    }
    assert json.loads(json.dumps(jsonable(value))) == {
        "inner": {"path": "a/b", "sizes": [1, 2]},
        "colour": "red",
        "array": [[1.0, 0.0], [0.0, 1.0]],
        "scalar": 0.5,
        "flag": True,
        "nothing": None,
    }


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        ({"a": {"b": float("nan")}}, ValueError, r"value\.a\.b is nan"),
        ([np.array([1.0, np.inf])], ValueError, r"value\[0\]\[1\] is inf"),
        ({1: 2}, ValueError, "key 1"),
        ({"f": print}, TypeError, r"value\.f is a builtin"),
    ],
)
def test_jsonable_names_what_it_refuses(value, error, message):
    with pytest.raises(error, match=message):
        jsonable(value)


def test_a_failed_write_leaves_the_old_file_and_no_debris(tmp_path, monkeypatch):
    path = tmp_path / "results.json"
    artifacts.write_json(path, {"a": 1})

    def full(*_):
        raise OSError("no space left")

    monkeypatch.setattr(artifacts.os, "replace", full)
    with pytest.raises(OSError, match="no space"):
        artifacts.write_json(path, {"a": 2})
    assert artifacts.read_json(path) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


def test_a_link_is_replaced_but_a_file_is_not(tmp_path):
    link = tmp_path / "latest"
    artifacts.point_link(link, "one")
    artifacts.point_link(link, "two")
    assert link.readlink() == Path("two")
    (tmp_path / "real").mkdir()
    with pytest.raises(FileExistsError, match="real"):
        artifacts.point_link(tmp_path / "real", "two")
