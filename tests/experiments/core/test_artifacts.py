"""Atomic files and JSON values."""

import contextlib
import dataclasses
import enum
import json
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core import artifacts
from experiments.core.artifacts import jsonable
from sensors_io.json_files import seal


class Colour(enum.Enum):
    RED = "red"


@dataclasses.dataclass(frozen=True)
class Inner:
    path: Path
    sizes: tuple[int, ...]


@pytest.mark.parametrize(
    ("value", "tree"),
    [
        (Inner(Path("a/b"), (1, 2)), {"path": "a/b", "sizes": [1, 2]}),
        (Colour.RED, "red"),
        (np.eye(2, dtype=np.float32), [[1.0, 0.0], [0.0, 1.0]]),
        (jnp.float32(0.5), 0.5),
        (np.bool_(True), True),
        (None, None),
    ],
)
def test_configs_and_results_have_a_json_form(tmp_path, value, tree):
    artifacts.write_json(tmp_path / "value.json", {"value": value})
    assert artifacts.read_json(tmp_path / "value.json") == {"value": tree}


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        ({"a": {"b": float("nan")}}, ValueError, r"value\.a\.b is nan"),
        ([np.array([1.0, np.inf])], ValueError, r"value\[0\]\[1\] is inf"),
        ({1: 2}, ValueError, "key 1"),
        ({"f": print}, TypeError, r"value\.f is a builtin"),
    ],
)
def test_a_value_without_a_json_form_is_named(value, error, message):
    with pytest.raises(error, match=message):
        jsonable(value)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "results.json"
    artifacts.write_json(path, {"a": 1})
    (tmp_path / f".results.json.{os.getpid()}").mkdir()  # where the new content would be written
    with pytest.raises(OSError, match=r"results\.json"):
        artifacts.write_json(path, {"a": 2})
    assert artifacts.read_json(path) == {"a": 1}
    path.write_text("{")
    with pytest.raises(artifacts.DamagedFileError, match="put a copy back"):
        artifacts.read_json(path)


@pytest.mark.parametrize("value", [{}, {"a": 1, "b": {"crc32": 2}}, {"stage": "sft/0", "result": [0.5, None, "ä"]}])
@pytest.mark.parametrize("indented", [True, False])
def test_every_flipped_bit_of_a_sealed_file_is_named_or_harmless(tmp_path, value, indented):
    path = tmp_path / "value.json"
    artifacts.write_sealed(path, value)
    if not indented:
        path.write_text(seal(json.dumps(value)))
    sealed = path.read_bytes()
    assert json.loads(sealed).keys() == {*value, "crc32"}
    assert artifacts.read_json(path) == value
    for bit in range(8 * len(sealed)):
        content = bytearray(sealed)
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        with contextlib.suppress(artifacts.DamagedFileError):
            assert artifacts.read_json(path) == value, bit


@pytest.mark.parametrize("value", [{}, {"a": 1}, {"a": {"b": 3}}, {"crc": 7}, [1, 2], 5])
def test_files_of_earlier_versions_have_no_checksum_and_are_read(tmp_path, value):
    artifacts.write_json(tmp_path / "old.json", value)
    assert artifacts.read_json(tmp_path / "old.json") == value


def test_a_link_is_replaced_but_a_folder_is_not(tmp_path):
    link = tmp_path / "latest"
    for target in ("one", "two"):
        artifacts.point_link(link, target)
        assert link.readlink() == Path(target)
    (tmp_path / "real").mkdir()
    with pytest.raises(FileExistsError, match="real"):
        artifacts.point_link(tmp_path / "real", "two")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["latest", "real"]
