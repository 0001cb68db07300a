"""Each filter by hand values; flags that can be taken back."""

import dataclasses

import numpy as np

from sensors_io import quality
from sensors_io.quality import QualityConfig
from sensors_io.schema import ContactKey, Flag, Sequence
from tests.sensors_io.checks import refused

CONFIG = QualityConfig()


def test_saturation_counts_pixels_beyond_the_background() -> None:
    frames = np.zeros((2, 10, 10, 3), np.uint8)
    frames[1, :5, :5, 2] = 255
    background = np.zeros((10, 10, 3), np.uint8)
    assert quality.saturated(frames, background, CONFIG).tolist() == [False, True]
    assert quality.saturated(frames, frames[1], CONFIG).tolist() == [False, False]


def test_rows_with_a_gap_in_any_column_are_incomplete() -> None:
    force = np.array([[0, 0, -1.0], [0, np.nan, -1], [0, 0, -1]])
    moment = np.array([[0, 0, 0.0], [0, 0, 0], [np.inf, 0, 0]])
    assert quality.incomplete(force, None, moment).tolist() == [False, True, True]
    refused(ValueError, "all None", quality.incomplete, None)


def test_force_that_swings_in_a_hold_is_unstable_elsewhere_not() -> None:
    force = np.zeros((12, 3))
    force[6:, 2] = -2.0
    hold, load = np.full(12, 2, np.uint8), np.full(12, 1, np.uint8)
    assert np.flatnonzero(quality.unstable(force, hold)).tolist() == [4, 5, 6, 7]
    assert not quality.unstable(force, load).any()


def test_a_gap_marks_the_frame_after_it() -> None:
    time = np.array([0, 10, 20, 50, 60], np.int64)
    assert quality.time_gap(time, CONFIG).tolist() == [False, False, False, True, False]
    assert not quality.time_gap(time[:1], CONFIG).any()


def test_untouched_frames_are_judged_where_depth_is_valid() -> None:
    depth, valid = np.zeros((2, 3, 3), np.float32), np.ones((2, 3, 3), bool)
    depth[:, 1, 1], valid[1, 1, 1] = 0.5, False
    assert quality.untouched(depth, valid).tolist() == [False, True]
    assert not quality.untouched(depth, None).any()


def test_odd_but_legal_sequences_are_named() -> None:
    pictures = np.arange(3 * 4 * 4 * 3, dtype=np.uint8).reshape(3, 4, 4, 3)
    key = ContactKey(object_id="a", site=0, motion="press", trial=0)
    time, flags = np.arange(3) * 10, np.zeros(3, np.uint32)
    arrays = {"frames": pictures, "host_time_ns": time, "phase": np.ones(3, np.uint8), "flags": flags}
    whole = Sequence(key=key, sensor="xense", **arrays)
    cases = {
        (): {},
        ("all pictures black",): {"frames": np.zeros_like(pictures)},
        ("all pictures white",): {"frames": np.full_like(pictures, 255)},
        ("all pictures of one colour",): {"frames": np.zeros_like(pictures) + pictures[:, :1, :1]},
        ("no change between pictures",): {"frames": np.repeat(pictures[:1], 3, 0)},
        ("pictures of one pixel",): {"frames": pictures[:, :1, :1]},
        ("times that run backwards",): {"host_time_ns": time[::-1].copy()},
        ("times that stand still",): {"host_time_ns": 0 * time},
        ("every frame flagged",): {"flags": flags + 4},
        ("no contact in any frame", "no change between fields"): {"depth_mm": np.zeros((3, 4, 4), np.float32)},
        ("no change between fields",): {"frames": None, "deformation_mm": np.ones((3, 4, 4, 2), np.float32)},
    }
    for expected, changes in cases.items():
        assert quality.oddities(dataclasses.replace(whole, **changes)) == expected
    dark, used = np.arange(3) < 2, {Flag.SATURATED, Flag.NOT_CONVERGED}
    black = {"frames": np.where(dark[:, None, None, None], 0, pictures), "flags": np.uint32([8, 0, 4])}
    assert quality.oddities(dataclasses.replace(whole, **black), rejected=[*used, Flag.SATURATED]) == (
        "all pictures black",
    )
    assert quality.oddities(dataclasses.replace(whole, flags=np.uint32([2, 8, 4])), rejected=used) == (
        "every frame flagged",
        "one frame",
    )
    hidden = {"deformation_mm": np.float32(pictures[..., :2]), "valid": np.zeros((3, 4, 4), bool)}
    assert quality.oddities(dataclasses.replace(whole, **hidden)) == ("fields that are nowhere valid",)
    sheared = {"deformation_mm": np.ones((3, 4, 4, 2), np.float32), "shear_mm": np.float32(pictures[..., :2])}
    assert not quality.oddities(dataclasses.replace(whole, **sheared))
    one = {name: getattr(whole, name)[:1] for name in ("frames", "host_time_ns", "phase", "flags")}
    assert quality.oddities(dataclasses.replace(whole, **one)) == ("one frame",)


def test_marks_can_be_taken_back() -> None:
    flags = np.array([0, int(Flag.TIME_GAP)], np.uint32)
    both = quality.marked(flags, {Flag.SATURATED: np.array([True, True])})
    assert both.tolist() == [4, 4 | 128]
    np.testing.assert_array_equal(quality.without(both, Flag.SATURATED), flags)
    assert flags.tolist() == [0, 128]


def test_a_sequence_is_judged_by_what_it_holds() -> None:
    sequence = Sequence(
        key=ContactKey(object_id="a", site=0, motion="press", trial=0),
        sensor="tac3d",
        depth_mm=np.zeros((3, 4, 4), np.float32),
        deformation_mm=np.zeros((3, 4, 4, 2), np.float32),
        force_n=np.array([[0, 0, -1], [0, 0, np.nan], [0, 0, -1]], np.float32),
        host_time_ns=np.array([0, 10, 50], np.int64),
        phase=np.zeros(3, np.uint8),
        flags=np.zeros(3, np.uint32),
    )
    found = quality.judge(sequence)
    assert set(found) == {Flag.TIME_GAP, Flag.NO_CONTACT, Flag.INCOMPLETE}
    held = dataclasses.replace(sequence, phase=np.full(3, quality.HOLD, np.uint8))
    assert set(quality.judge(held)) == {*found, Flag.UNSTABLE_FORCE}  # which is judged in holds alone
    assert found[Flag.NO_CONTACT].all()
    assert found[Flag.INCOMPLETE].tolist() == [False, True, False]
    again = quality.judged(sequence, found)
    assert again.flags[1] == int(Flag.NO_CONTACT | Flag.INCOMPLETE)
    assert not sequence.flags.any()
