"""The protocol's schedule: balanced, within what objects bear, and blind to the labels."""

import collections
import dataclasses

import numpy as np
import pytest

from sensors_io.scenes import motions, schedule
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.motions import Pace
from sensors_io.scenes.strength import Limits
from sensors_io.schema import EXPLORATORY, FORCES_N, PRESS_FORCE_N
from tests.sensors_io.checks import refused

OBJECTS = 360
CONFIG = SceneConfig(objects=OBJECTS, sequences=4 * 1323, frames=40)


@pytest.fixture(scope="module")
def limits() -> Limits:
    """Cell 8 bears a third of what cell 0 bears, as protruding objects do; rigid objects bear less."""
    rng = np.random.default_rng(0)
    actual = 18 * np.exp(0.5 * rng.standard_normal(OBJECTS)) / (1 + _cell() / 4)
    return Limits(actual_n=actual, rigid_n=actual * rng.uniform(0.6, 1, OBJECTS))


@pytest.fixture(scope="module")
def made(limits) -> schedule.Schedule:
    return schedule.protocol(CONFIG, limits, _cell())


def _cell() -> np.ndarray:
    return np.arange(OBJECTS) % 9


def test_every_object_is_pressed_once_and_motions_and_forces_are_balanced(made):
    presses = [s.object_index for s in made.slots if s.motion == "press"]
    assert sorted(presses) == list(range(OBJECTS))
    tasks = collections.Counter((s.motion, s.force_n) for s in made.slots if s.motion != "press")
    assert set(tasks) == {(m, f) for m in EXPLORATORY for f in FORCES_N}
    assert max(tasks.values()) - min(tasks.values()) <= 1
    assert len(made.slots) == CONFIG.contact_count


def test_sites_are_numbered_through_forces_are_borne_and_prefixes_are_fair(made, limits):
    """No force is asked that a rigid object of this shape would not bear; the seed alone decides."""
    sites = collections.defaultdict(list)
    for slot in made.slots:
        sites[slot.object_index].append(slot.site)
        assert slot.force_n <= limits.rigid_n[slot.object_index] * (1 + 1e-9)
    assert all(sorted(found) == list(range(len(found))) for found in sites.values())
    half = made.slots[: len(made.slots) // 2]
    assert np.mean([s.motion == "press" for s in half]) == pytest.approx(OBJECTS / len(made.slots), abs=0.05)
    assert schedule.protocol(CONFIG, limits, _cell()).slots == made.slots


def test_every_cell_gets_the_same_forces(made):
    peaks, levels = collections.defaultdict(list), collections.defaultdict(collections.Counter)
    for slot in made.slots:
        cell = slot.object_index % 9
        if slot.motion == "press":
            peaks[cell].append(slot.force_n)
        else:
            levels[cell][slot.force_n] += 1
    for q in (0.1, 0.5, 0.9):
        assert np.ptp([np.quantile(p, q) for p in peaks.values()]) < 0.12 * np.quantile(peaks[0], q)
    for counts in levels.values():
        assert max(counts.values()) - min(counts.values()) <= len(EXPLORATORY)


def test_left_out_frames_are_counted(made, limits):
    counts = made.left_out
    touched = sum((motions.plan(s.motion, 1.0, schedule.pace(40)).force_n > 0).sum() for s in made.slots)
    assert counts.asked.sum() == touched
    assert np.all(counts.past_limit <= counts.asked)
    assert np.all(counts.replaced.sum(0) >= counts.past_limit.sum(0))
    strong = limits.actual_n > 20
    assert counts.past_limit[strong].sum() == 0
    assert counts.past_limit[limits.actual_n < 9][:, 3:].sum() > 0


@pytest.mark.parametrize("pace", [*map(schedule.pace, (20, 40, 90, 137)), *(Pace(frames=n) for n in (36, 64, 200))])
def test_the_pace_fits_any_length(pace):
    for motion in ("press", *EXPLORATORY):
        hand = motions.plan(motion, 5.0, pace)
        assert len(hand) == pace.frames
        assert hand.force_n.max() == pytest.approx(5)


def test_weak_objects_and_bad_sizes_are_refused_by_name():
    weak = Limits(actual_n=np.full(OBJECTS, 4.0), rigid_n=np.full(OBJECTS, 4.0))
    refused(ValueError, "objects is 360: none of them bears 10 N", schedule.protocol, CONFIG, weak, _cell())
    for sequences, frames, message in (
        (30, None, "sequences is 30: must be a multiple of 4"),
        (36, None, "sequences is 36: must be ≥ 40: every one of 10 objects is pressed by all sensors"),
        (80, 19, "frames is 19: must be ≥ 20"),
    ):
        refused(ValueError, message, SceneConfig, objects=10, sequences=sequences, frames=frames)


def test_frames_default_to_the_kind_of_set():
    assert SceneConfig().frame_count == 8
    assert SceneConfig(objects=10, sequences=80).frame_count == 90
    assert SceneConfig(frames=5).frame_count == 5
    assert SceneConfig(objects=1000, sequences=14_700).contact_count == 3675


def test_without_replacing_every_press_reaches_the_greatest_force_and_nothing_is_left_out(made, limits):
    flagged = schedule.protocol(dataclasses.replace(CONFIG, past_limit="flag"), limits, _cell())
    assert {s.force_n for s in flagged.slots if s.motion == "press"} == {PRESS_FORCE_N}
    assert flagged.left_out.replaced.sum() == 0
    np.testing.assert_array_equal(flagged.left_out.asked, made.left_out.asked)
    np.testing.assert_array_equal(flagged.left_out.past_limit, made.left_out.past_limit)
    forces = collections.defaultdict(list)
    for slot in flagged.slots:
        if slot.motion != "press":
            forces[slot.object_index].append(slot.force_n)
    uses = [len(found) for found in forces.values()]
    assert max(uses) - min(uses) <= 1
