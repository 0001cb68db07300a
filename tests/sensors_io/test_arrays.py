"""Arrays of files from outside: equal to NumPy's, or refused."""

import contextlib
import os
import zipfile

import numpy as np
import pytest

from sensors_io.arrays import ArraysError, load_arrays
from tests.sensors_io.checks import refused


def test_arrays_come_back_from_both_formats(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text"), "c": np.asfortranarray(np.ones((2, 2), ">i4"))}
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    np.testing.assert_equal(load_arrays(tmp_path / "x.npz"), arrays)
    with (tmp_path / "a.npy").open("wb") as file:
        np.lib.format.write_array(file, arrays["a"], version=(2, 0))
    np.testing.assert_equal(load_arrays(tmp_path / "a.npy"), {"a": arrays["a"]})


def npy(header):
    text = header.encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "cannot be read"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"), "its header states"),
        (npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }") + b"\0" * 8, "Python objects"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }"), "cannot be read"),
        (npy("{'descr': 'nonsense'"), "cannot be read"),
    ],
)
def test_what_is_no_array_is_refused(tmp_path, data, message):
    (tmp_path / "a.npy").write_bytes(data)
    refused(ArraysError, message, load_arrays, tmp_path / "a.npy")


def test_a_refusal_is_one_line_and_does_not_say_how_to_trust_the_file(tmp_path):
    (tmp_path / "a.npy").write_bytes(npy(" " * 60_000))
    with pytest.raises(ArraysError, match="Header info length") as raised:
        load_arrays(tmp_path / "a.npy")
    assert "\n" not in str(raised.value)


def test_two_arrays_of_one_name_are_refused(tmp_path):
    np.savez(tmp_path / "x.npz", a=np.zeros(2))
    with zipfile.ZipFile(tmp_path / "x.npz", "a") as archive, archive.open("a", "w") as file:
        np.save(file, np.ones(2))
    refused(ArraysError, "two arrays of one name", load_arrays, tmp_path / "x.npz")


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_a_pipe_is_refused(tmp_path, name):
    os.mkfifo(tmp_path / name)
    refused(ArraysError, "a pipe", load_arrays, tmp_path / name)


@pytest.mark.long
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_every_flipped_bit_of_an_archive_is_named_or_harmless(tmp_path, save):
    """A flipped bit in the list of its entries may hide some of them."""
    path, arrays = tmp_path / "x.npz", {"a": np.arange(3), "b": np.eye(2), "c": np.zeros(1)}
    save(path, **arrays)
    whole = path.read_bytes()
    end = 8 * whole.index(b"PK\1\2")
    for bit in [*range(0, end, 9), *range(end, 8 * len(whole))]:
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        with contextlib.suppress(ArraysError):
            np.testing.assert_equal(load_arrays(path), arrays)
