"""The file format, byte by byte, and files that are broken."""

import json
import resource
import struct

import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.models.qwen.safetensors import METADATA, read_header, read_tensor, write_file


def raw_file(path, header: dict | bytes, body: bytes) -> None:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)


def test_file_by_hand(tmp_path):
    """Two tensors and metadata, written down from the format's description."""
    body = np.array([[1.5, -2.0, 3.0]], "<f4").tobytes() + b"\x80\x3f\x00\xc0"  # bfloat16 1 and −2
    header = {
        METADATA: {"format": "pt"},
        "a": {"dtype": "F32", "shape": [1, 3], "data_offsets": [0, 12]},
        "b": {"dtype": "BF16", "shape": [2], "data_offsets": [12, 16]},
    }
    raw_file(tmp_path / "x.safetensors", header, body)
    found = {name: read_tensor(entry) for name, entry in read_header(tmp_path / "x.safetensors").items()}
    np.testing.assert_array_equal(found["a"], [[1.5, -2.0, 3.0]])
    np.testing.assert_array_equal(found["b"].astype(np.float32), [1, -2])
    assert set(found) == {"a", "b"}


@pytest.mark.parametrize("dtype", [np.float32, np.float16, jnp.bfloat16])
def test_what_is_written_is_read(tmp_path, dtype):
    rng = np.random.default_rng(0)
    tensors = {name: rng.normal(size=shape).astype(dtype) for name, shape in {"a": (3, 4), "b": (), "c": (5,)}.items()}
    tensors["turned"] = tensors["a"].T
    write_file(tmp_path / "x.safetensors", tensors)
    for name, entry in read_header(tmp_path / "x.safetensors").items():
        np.testing.assert_array_equal(read_tensor(entry), tensors[name])
    assert [p.name for p in tmp_path.iterdir()] == ["x.safetensors"]


def test_a_disk_that_fills_is_named_by_the_system(tmp_path):
    """A limit on the size of files stands for it: the first tensor fits in part."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            write_file(tmp_path / "x.safetensors", {"a": np.ones(2**16, np.float32)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_types_that_no_weight_has_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="ids is int64: must be one of"):
        write_file(tmp_path / "x.safetensors", {"ids": np.arange(3)})


@pytest.mark.parametrize("content", [b"", b"abc", b"\xff" * 64, struct.pack("<Q", 100) + b"{}"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(ValueError, match="is no safetensors file or was cut off"):
        read_header(tmp_path / "x")


def test_a_pointer_is_named(tmp_path):
    (tmp_path / "x").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 17\n")
    with pytest.raises(ValueError, match="points to a file of Git LFS that was not fetched"):
        read_header(tmp_path / "x")


@pytest.mark.parametrize("header", [b"not json", b"[]", b"7", b"[" * 100_000, b'{"a": 3}', b'{"a": "dtype"}'])
def test_header_must_be_an_object_of_objects(tmp_path, header):
    raw_file(tmp_path / "x", header, b"")
    with pytest.raises(ValueError, match=r"header is no JSON|a lacks data_offsets"):
        read_header(tmp_path / "x")


@pytest.mark.parametrize(
    "change",
    [
        {"shape": ["3"]},
        {"shape": 3},
        {"shape": [1.5, 2]},
        {"dtype": ["F32"]},
        {"data_offsets": [-12, 0]},
        {"data_offsets": [0]},
    ],
)
def test_shapes_and_offsets_must_be_sizes(tmp_path, change):
    """Negative offsets would read the header as weights."""
    raw_file(tmp_path / "x", {"a": {"dtype": "F32", "shape": [3], "data_offsets": [0, 12]} | change}, bytes(12))
    with pytest.raises(ValueError, match=r"of a (are|is) .*: must be (sizes|a type)"):
        read_header(tmp_path / "x")


def test_bytes_must_fit_the_shape(tmp_path):
    raw_file(tmp_path / "x", {"a": {"dtype": "F32", "shape": [4], "data_offsets": [0, 12]}}, bytes(12))
    with pytest.raises(ValueError, match="a has 12 bytes, its type and shape need 16"):
        read_header(tmp_path / "x")


def test_entries_must_be_whole(tmp_path):
    raw_file(tmp_path / "x", {"a": {"dtype": "F32", "shape": [4]}}, bytes(16))
    with pytest.raises(ValueError, match="a lacks data_offsets"):
        read_header(tmp_path / "x")


def test_file_that_was_cut_off(tmp_path):
    raw_file(tmp_path / "x", {"a": {"dtype": "F32", "shape": [4], "data_offsets": [0, 16]}}, bytes(10))
    with pytest.raises(ValueError, match="was cut off: a ends at byte"):
        read_header(tmp_path / "x")


def test_file_that_shrinks_while_it_is_read(tmp_path):
    path = tmp_path / "x"
    write_file(path, {"a": np.ones(4, np.float32)})
    entry = read_header(path)["a"]
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(ValueError, match="ends inside a tensor, 12 bytes of 16"):
        read_tensor(entry)
