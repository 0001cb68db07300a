"""Bytes mutated at random, and what a parser makes of them: a documented error or a value, soon, in little memory.

Where a checksum would stop mutated bytes at once, the tests sign them again, as a program of another version would.
"""

import contextlib
import copy
import json
import time
import tracemalloc

import numpy as np

COUNTED = {"policy": 300, "picture": 1_000, "video": 1_000, "HDF5": 1_000}
"""Inputs of the parsers that take long."""

INPUTS = 4_000
"""Of each of the 31 others: 127,300 in all."""

SLOWEST_S = 1.0
MEMORY = 10
"""Times the input, besides two megabytes for what Python itself takes."""

NUMBERS = (b"0", b"-1", b"1e999", b"NaN", b"99999999999999999999", b"null", b"{}", b"[]", b'""', b"true")
ODD = (0, -1, 0.5, 2**63, 10**400, float("nan"), float("inf"), None, True, "", "x", [], [[1]], {}, {"x": 1})


def check_parser(name, seed, parse, data, documented, *, shaped):
    """Give a parser mutated inputs.

    Args:
      name: of the parser.
      seed: of the mutations.
      parse: function of bytes.
      data: bytes that are mutated.
      documented: the errors that it may raise.
      shaped: `data` is JSON, of which every second input has another shape instead of other bytes.
    """
    rng = np.random.default_rng([22, seed])
    refused, count = 0, COUNTED.get(name, INPUTS)
    for i in range(count):
        bad = reshaped(rng, data) if shaped and i % 2 else mutated(rng, data)
        traced = i % 16 == 15 and name != "policy"  # it takes four times as long; a policy is traced by JAX itself
        if traced:
            tracemalloc.start()
        began = time.process_time()
        try:
            parse(bad)
        except documented:
            refused += 1
        except Exception as error:
            raise AssertionError(f"{name}, input {i}, {len(bad)} bytes: {bad[:400]!r}") from error
        spent = time.process_time() - began
        peak = 0
        if traced:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert spent < SLOWEST_S, f"input {i} took {spent:.2f} s: {bad[:400]!r}"
        most = MEMORY * len(bad) + 2_000_000
        if peak >= most:  # the first input of a kind may import modules: another look does not
            peak = memory_of(parse, bad, documented)
        assert peak < most, f"input {i} took {peak} bytes: {bad[:400]!r}"
    assert refused > count / 4


def memory_of(parse, data, documented):
    """Bytes that a parser takes at most."""
    tracemalloc.start()
    with contextlib.suppress(documented):
        parse(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def mutated(rng, data):
    """One to four random changes of some bytes."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at, size = int(rng.integers(0, len(data) + 1)), int(rng.integers(1, 17))
        match rng.integers(0, 7):
            case 0 if at < len(data):
                data[at] ^= 1 << int(rng.integers(0, 8))
            case 1 if at < len(data):
                data[at] = int(rng.integers(0, 256))
            case 2:
                del data[at : at + size]
            case 3:
                data[at:at] = data[at : at + size]
            case 4:
                data[at:at] = rng.bytes(size)
            case 5:
                digits = [i for i, byte in enumerate(data[:4000]) if 48 <= byte <= 57]
                if digits:
                    i = digits[int(rng.integers(0, len(digits)))]
                    data[i : i + 1] = NUMBERS[int(rng.integers(0, len(NUMBERS)))]
            case _:
                data = data[: int(rng.integers(0, len(data) + 1))]
    return bytes(data)


def reshaped(rng, data):
    """JSON with one to three values replaced or removed."""
    tree = json.loads(data)
    for _ in range(rng.integers(1, 4)):
        places = list(places_in(tree))
        if not places:
            break
        within, name = places[int(rng.integers(0, len(places)))]
        if rng.random() < 0.2:
            del within[name]
        else:
            within[name] = copy.deepcopy(ODD[int(rng.integers(0, len(ODD)))])
    return json.dumps(tree).encode()


def places_in(tree):
    """Every container in a JSON tree with each of its keys or positions."""
    for name in tree if isinstance(tree, dict) else range(len(tree)):
        yield tree, name
        if isinstance(tree[name], dict | list):
            yield from places_in(tree[name])


def file_of(path, read):
    """A parser of the bytes of a file."""

    def parse(data):
        path.write_bytes(data)
        return read(path)

    return parse


def written(folder, name, write):
    """Bytes of a file that a function writes."""
    write(folder / name)
    return (folder / name).read_bytes()
