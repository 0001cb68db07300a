"""Sequences and cards as bytes: exact where it is promised, within the stated error elsewhere, never silently wrong."""

import dataclasses
import json
import pathlib
import tracemalloc
import zlib

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sensors_io import codec
from sensors_io.schema import FRAME_ARRAYS, SENSORS, SchemaError
from tests.sensors_io.checks import refused
from tests.sensors_io.fakes import card, sequence

ENTRIES = pathlib.Path(__file__).parents[1] / "data" / "entries_v1"
EXACT = [name for name in FRAME_ARRAYS if name not in codec.TOLERANCE]


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_sequence_comes_back(sensor):
    before = sequence(3, sensor, length=7, moment_nmm=np.full((7, 3), -87.3, np.float32))
    data = codec.encode_sequence(before)
    after = codec.decode_sequence(data)
    assert codec.encode_sequence(after) == data
    for name in ("key", "sensor", "serial", "calibration", "camera", "contact_region_px", "mm_per_px"):
        assert getattr(after, name) == getattr(before, name)
    for name in EXACT:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    for name, tolerance in codec.TOLERANCE.items():
        if getattr(before, name) is None:
            assert getattr(after, name) is None
        else:
            np.testing.assert_allclose(getattr(after, name), getattr(before, name), rtol=0, atol=tolerance)


def test_encoding_takes_the_memory_of_the_entry_and_of_its_differences():
    frames = np.random.default_rng(0).integers(0, 255, (8, 200, 200, 3), np.uint8)
    before = dataclasses.replace(sequence(0, length=8), frames=frames.cumsum(0, np.uint8))
    tracemalloc.start()
    codec.encode_sequence(before)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2.5 * frames.nbytes


def test_a_card_comes_back_exactly():
    before = card(2, visual_lies=True, truth={"modulus_mpa": np.float64(0.25)}, name="a thing")
    after = codec.decode_card(codec.encode_card(before))
    np.testing.assert_array_equal(after.view, before.view)
    np.testing.assert_array_equal(after.view_depth_mm, before.view_depth_mm)
    plain = {"view": None, "view_depth_mm": None}
    assert dataclasses.replace(after, **plain) == dataclasses.replace(before, **plain)


@hypothesis.given(
    shape=st.tuples(st.integers(1, 4), st.integers(1, 9), st.integers(1, 9)),
    seed=st.integers(0, 2**31),
    share=st.floats(0, 1),
)
def test_frames_and_masks_come_back_bit_for_bit(shape, seed, share):
    rng = np.random.default_rng(seed)
    n, h, w = shape
    frames = rng.integers(0, 256, (n, h + 1, w, 3), dtype=np.uint8)
    flags = rng.integers(0, 2**32, n, dtype=np.uint32)
    times = rng.integers(-(2**62), 2**62, n)
    fields = {"deformation_mm": None, "depth_mm": np.zeros(shape, np.float32), "valid": rng.random(shape) < share}
    before = sequence(length=n, frames=frames, flags=flags, host_time_ns=times, **fields)
    after = codec.decode_sequence(codec.encode_sequence(before))
    for name in EXACT:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


@hypothesis.given(
    hnp.arrays(np.float32, hnp.array_shapes(max_dims=3, max_side=6), elements=st.floats(-31.5, 31.5, width=32)),
    st.floats(2.0**-60, 1),
)
def test_quantisation_is_within_half_a_step_and_idempotent(x, shrink):
    x = x * np.float32(shrink)
    counts, scale = codec.quantise("depth_mm", x, where="here")
    back = counts * np.float32(scale)
    assert back.dtype == np.float32
    assert np.abs(back.astype(np.float64) - x).max() <= scale / 2 <= codec.TOLERANCE["depth_mm"]
    again, again_scale = codec.quantise("depth_mm", back, where="here")
    np.testing.assert_array_equal(again * np.float32(again_scale), back)
    assert codec.quantise("depth_mm", -x, where="here")[1] == scale


@pytest.mark.parametrize("name", codec.TOLERANCE)
def test_the_largest_range_is_carried_and_the_next_is_refused(name):
    limit = 32767 * 2.0 ** np.floor(np.log2(2 * codec.TOLERANCE[name]))
    counts, scale = codec.quantise(name, np.array([-limit], np.float32), where="here")
    assert counts[0] == -32767
    assert scale / 2 <= codec.TOLERANCE[name]
    with pytest.raises(SchemaError, match=f"here: {name} reaches .* records hold at most"):
        codec.quantise(name, np.array([limit * 1.001], np.float32), where="here")


def test_what_cannot_be_stored_is_refused():
    said = "object_0/0/press/0/gelsight_mini: depth_mm .* not finite; put 0 there"
    for bad in (np.nan, np.inf, -np.inf):
        depth = np.where(np.arange(360).reshape(12, 5, 6) == 101, bad, 0).astype(np.float32)
        refused(SchemaError, said, codec.encode_sequence, sequence(depth_mm=depth))
    for gain in (np.float32(1), float("nan"), float("inf")):
        said = "settings cannot be stored as JSON"
        refused(SchemaError, said, codec.encode_sequence, sequence(camera={"gain": gain}))
    for camera in (None, [], {"recording": None}, {"recording": {"background": 3}}, {"recording": {"left_out": "3"}}):
        refused(SchemaError, "camera is .* must map names", sequence, camera=camera)
    refused(SchemaError, "mm_per_px is '.1': must be a number", sequence, mm_per_px=".1")
    fields = dict.fromkeys(("deformation_mm", "shear_mm", "valid"))
    refused(SchemaError, "must have rows and", sequence, depth_mm=np.zeros((12, 0, 0), np.float32), **fields)


@hypothesis.given(st.data())
def test_every_flipped_bit_is_found(data):
    entry = bytearray(codec.encode_sequence(sequence(length=2)))
    position = data.draw(st.integers(0, len(entry) - 1))
    entry[position] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(codec.CorruptRecordsError):
        codec.decode_sequence(bytes(entry))


def test_entries_of_version_1_are_read():
    """Object 0 of `fakes`, two frames of 4 × 5 px whose bytes count up, and card 1 without the depth of its view."""
    stored, card_1 = ((ENTRIES / f"{name}.bin").read_bytes() for name in ("sequence", "card"))
    old = codec.decode_sequence(stored)
    assert stored[:4] == b"TCH1"
    np.testing.assert_array_equal(old.frames.ravel(), np.arange(120))
    np.testing.assert_array_equal(old.depth_mm, np.full((2, 2, 3), 0.25))
    np.testing.assert_array_equal(codec.decode_card(card_1).view, card(1).view)
    again = codec.decode_sequence(codec.encode_sequence(old))
    np.testing.assert_array_equal(again.frames, old.frames)


def test_a_filter_that_this_code_does_not_know_is_refused():
    entry = codec.encode_sequence(sequence(frames=np.zeros((12, 16, 20, 3), np.uint8)))
    changed = entry[8:].replace(b'"filter": "none"', b'"filter": "nine"')
    with pytest.raises(codec.CorruptRecordsError, match="frames went through filter 'nine': must be one of"):
        codec.decode_sequence(entry[:4] + zlib.crc32(changed).to_bytes(4, "little") + changed)


def test_a_cut_entry_and_a_wrong_kind_are_found():
    entry = codec.encode_sequence(sequence())
    for cut in (0, 3, 11, 100, len(entry) - 1):
        with pytest.raises(codec.CorruptRecordsError):
            codec.decode_sequence(entry[:cut])
    refused(codec.CorruptRecordsError, "is of kind 'sequence', not 'object'", codec.decode_card, entry)


def test_the_layout_describes_itself_and_arrays_are_aligned():
    entry = codec.encode_sequence(sequence())
    end = 12 + int.from_bytes(entry[8:12], "little")
    header = json.loads(entry[12:end])
    assert header["plain"]["key"]["object_id"] == "object_0"
    assert [a["name"] for a in header["arrays"]][:2] == ["frames", "deformation_mm"]
    assert bytes(sequence().frames[0, 0, 0]) == entry[end:][:3]
    assert (end % 8, len(entry) % 8) == (0, 0)


def test_errors_are_half_a_micrometre_a_millinewton_and_a_hundredth_of_a_newton_millimetre():
    lengths, forces = ("deformation_mm", "shear_mm", "depth_mm"), ("force_n", "target_force_n")
    stated = dict.fromkeys(lengths, 5e-4) | dict.fromkeys(forces, 1e-3) | {"moment_nmm": 1e-2}
    assert stated == codec.TOLERANCE
    assert {round(codec.WIDEST[name]) for name in (*lengths, *forces, "moment_nmm")} == {32, 64, 512}


def test_fields_can_be_left_out_only_beside_frames():
    slim = codec.decode_sequence(codec.encode_sequence(sequence()), fields=False)
    assert all(getattr(slim, name) is None for name in codec.FIELDS)
    assert (slim.frames is None, slim.force_n is None) == (False, False)
    assert codec.decode_sequence(codec.encode_sequence(sequence(sensor="tac3d")), fields=False).depth_mm is not None
