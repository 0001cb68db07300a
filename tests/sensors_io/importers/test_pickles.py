"""Pickles are read as data and never run."""

import functools
import os
import pickle

import numpy as np
import pytest

from sensors_io.importers.pickles import PickleError, read_pickle
from tests.sensors_io.checks import refused


class Program:
    def __reduce__(self):
        return os.getenv, ("HOME",)


def test_programs_are_refused(tmp_path):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([Program()]))
    with pytest.raises(PickleError, match=r"asks for (os|posix)\.getenv: only numbers, text and arrays are read"):
        read_pickle(tmp_path / "a.pkl")
    np.save(tmp_path / "a.npy", np.array(Program(), object), allow_pickle=True)
    refused(PickleError, "getenv", read_pickle, tmp_path / "a.npy")


def test_damage_is_named(tmp_path):
    whole = pickle.dumps(np.arange(99.0))
    for data in (b"", b"text", whole[: len(whole) // 2]):
        (tmp_path / "a.pkl").write_bytes(data)
        refused(PickleError, r"a\.pkl is damaged", read_pickle, tmp_path / "a.pkl")
    refused(PickleError, r"b\.pkl is absent", read_pickle, tmp_path / "b.pkl")
    np.save(tmp_path / "plain.npy", np.arange(3))
    refused(PickleError, "holds an array of int64", read_pickle, tmp_path / "plain.npy")


@pytest.mark.parametrize("data", [b"S" + b"x" * 10_000 + b"\n.", pickle.dumps("a\nb" * 1000)[:-1] + b"\x8c\x01c\x93."])
def test_what_a_file_has_it_say_stays_one_short_line(tmp_path, data):
    (tmp_path / "a.pkl").write_bytes(data)
    with pytest.raises(PickleError) as raised:
        read_pickle(tmp_path / "a.pkl")
    assert len(str(raised.value)) < 300
    assert "\n" not in str(raised.value)


def state(build, *state):
    """A pickle that builds something with a state of its own, as a crafted file would."""

    class Crafted:
        def __reduce__(self):
            return (*build, state if len(state) > 1 else state[0])

    return pickle.dumps(Crafted(), 2)


EMPTY = np.empty(0).__reduce__()[:2]
TYPE = (np.dtype, ("f8", False, True))
TWICE = functools.reduce(lambda part, _: (part, part), range(60), ())
"""A tuple of twice the same tuple, sixty times: 2⁶⁰ copies of the innermost."""


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (state(EMPTY, 1, (4,), np.dtype(object), False, b"\xff" * 32), "of objects of shape"),
        (state(EMPTY, 1, (2,), np.dtype(object), False, [1]), "must hold as many"),
        (state(EMPTY, 1, (1 << 40,), np.dtype("f8"), False, b"\0" * 8), "must have 8796093022208 bytes"),
        (state(EMPTY, 1, (-1,), np.dtype("f8"), False, b""), "tuple of sizes"),
        (state(EMPTY, 1, TWICE, np.dtype("f8"), False, b""), "repeats a tuple"),
        (b"\x80\x02}" + pickle.dumps(TWICE, 2)[2:-1] + b"K\x01s.", "repeats a tuple"),  # a dictionary's key
        (state(TYPE, 3, "<", None, ("a",), {"a": (np.dtype("f8"), 99)}, 8, 8, 0), "structured"),
        (pickle.dumps(np.zeros(1, [("a", object)])), "V8"),
        (pickle.dumps([0])[:-1] + b"r\xff\xff\xff\x7f.", "remembered"),
        (b"\x80\x02" + b"]" * 2000 + b"a" * 1999 + b".", "nests"),
        (pickle.dumps(np.ndarray), "as data"),
    ],
)
def test_crafted_pickles_are_refused_before_memory_is_touched(tmp_path, data, message):
    (tmp_path / "a.pkl").write_bytes(data)
    refused(PickleError, message, read_pickle, tmp_path / "a.pkl")


def test_what_a_pickle_names_again_and_again_is_read_once(tmp_path):
    """A list of twice the same list, fifty times: 2⁵⁰ copies of the innermost."""
    innermost = [np.arange(3)]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(functools.reduce(lambda part, _: [part, part], range(50), innermost)))
    found = read_pickle(tmp_path / "a.pkl")
    for _ in range(51):
        found = found[-1]
    assert found.tolist() == [0, 1, 2]


def test_arrays_of_every_order_and_type_come_back(tmp_path):
    np.save(tmp_path / "a.npy", {"timestamps": [1.0]}, allow_pickle=True)
    assert read_pickle(tmp_path / "a.npy") == {"timestamps": [1.0]}
    data = [
        {"poses": {"DIGIT": np.eye(3)}},
        "text",
        np.float64(2.5),
        np.asfortranarray(np.ones((2, 3))),
        np.arange(3, dtype=">i4"),
        np.array(["a", "bc"]),
        np.bool_(1),
    ]
    nested = np.array([{("a", (2, 3)): np.arange(2), "b": [(5, 6)] * 3}, None], object)
    for protocol in (0, 2, 4, 5):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps([*data, np.empty(0), nested], protocol))
        *found, empty, objects = read_pickle(tmp_path / "a.pkl")
        np.testing.assert_equal(found, data)
        assert (empty.shape, objects.shape, objects[1]) == ((0,), (2,), None)
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(np.array([[1, 2], [3, None]], object, order="F"), protocol))
        assert read_pickle(tmp_path / "a.pkl").tolist() == [[1, 2], [3, None]]
        np.testing.assert_array_equal(objects[0][("a", (2, 3))], [0, 1])
