"""Pickles are read as data and never run."""

import os
import pickle

import numpy as np
import pytest

from sensors_io.importers.pickles import PickleError, read_pickle


class Program:
    def __reduce__(self):
        return os.getenv, ("HOME",)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_dictionaries_come_back(tmp_path, protocol):
    data = {"start_time": "2022-03-20", "timestamps": [0.0, 0.5], "poses": {"DIGIT": np.eye(3)}, "one": np.float64(2.5)}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(data, protocol))
    np.testing.assert_equal(read_pickle(tmp_path / "a.pkl"), data)


def test_a_pickled_object_in_npy(tmp_path):
    np.save(tmp_path / "a.npy", {"timestamps": [1.0]}, allow_pickle=True)
    assert read_pickle(tmp_path / "a.npy") == {"timestamps": [1.0]}


def test_programs_are_refused(tmp_path):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([Program()]))
    with pytest.raises(PickleError, match=r"asks for (os|posix)\.getenv: only numbers, text and arrays are read"):
        read_pickle(tmp_path / "a.pkl")
    np.save(tmp_path / "a.npy", np.array(Program(), object), allow_pickle=True)
    with pytest.raises(PickleError, match="getenv"):
        read_pickle(tmp_path / "a.npy")


def test_damage_is_named(tmp_path):
    whole = pickle.dumps(np.arange(99.0))
    for data in (b"", b"text", whole[: len(whole) // 2]):
        (tmp_path / "a.pkl").write_bytes(data)
        with pytest.raises(PickleError, match=r"a\.pkl is damaged"):
            read_pickle(tmp_path / "a.pkl")
    with pytest.raises(PickleError, match=r"b\.pkl is absent"):
        read_pickle(tmp_path / "b.pkl")
    np.save(tmp_path / "plain.npy", np.arange(3))
    with pytest.raises(PickleError, match="holds an array of int64"):
        read_pickle(tmp_path / "plain.npy")
