"""Which frames stand for a sequence: exact against brute force, covering the ramp, always with the deepest press."""

import itertools

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from sensors_io.schema import ContactKey, Flag, SchemaError
from sensors_io.selection import FIELD_MM_PER_COUNT, choose_frames, field_images, nearest_increasing
from tests.sensors_io.checks import refused
from tests.sensors_io.fakes import sequence

REJECTED = (Flag.STRAIN_LIMIT, Flag.NOT_CONVERGED, Flag.SATURATED)
FREE = ContactKey(object_id="object_0", site=0, motion="free", trial=0)


def pressed(load, **changes):
    """A press whose measured normal load is `load`, N."""
    force = np.zeros((len(load), 3), np.float32)
    force[:, 2] = -np.asarray(load)
    return sequence(length=len(load), force_n=force, **changes)


def filmed(change, **changes):
    """Unguided motion without force, frame n everywhere 50 + change[n] counts."""
    frames = np.broadcast_to(50 + np.asarray(change, np.uint8)[:, None, None, None], (len(change), 16, 20, 3))
    return sequence(length=len(change), key=FREE, force_n=None, frames=frames.copy(), **changes)


@hypothesis.given(
    value=st.lists(st.floats(-9, 9), min_size=1, max_size=8), level=st.lists(st.floats(-9, 9), min_size=1, max_size=5)
)
def test_the_nearest_increasing_positions_are_the_best_of_all(value, level):
    hypothesis.assume(len(level) <= len(value))
    value, level = np.array(value), np.array(level)
    got = nearest_increasing(value, level)
    assert (np.diff(got) > 0).all()
    best = min(np.abs(value[list(p)] - level).sum() for p in itertools.combinations(range(len(value)), len(level)))
    assert np.abs(value[got] - level).sum() == pytest.approx(best)


def test_a_linear_ramp_is_covered_from_zero_to_its_maximum_while_it_loads():
    load = np.linspace(0, 20, 90)
    chosen = choose_frames(pressed(load), 8, REJECTED)
    np.testing.assert_allclose(load[chosen], np.linspace(0, 20, 8), atol=20 / 89 / 2 + 1e-6)
    assert (chosen[0], chosen[-1]) == (0, 89)
    load = np.concatenate([np.linspace(0, 20, 30), np.linspace(20, 0, 60)])
    chosen = choose_frames(pressed(load), 8, REJECTED)
    assert chosen[-1] <= 30
    np.testing.assert_allclose(load[chosen], np.linspace(0, 20, 8), atol=0.4)


def test_a_slide_at_set_force_is_not_read_in_its_first_touch_only_unless_force_shall_choose():
    load = np.concatenate([np.linspace(0, 5, 5), np.full(45, 5.0)])
    slide = pressed(load, key=ContactKey(object_id="object_0", site=0, motion="slide_x", trial=0))
    ramp = pressed(np.linspace(0, 20, 50))
    own = choose_frames(slide, 8, REJECTED)
    assert np.count_nonzero(own >= 5) >= 6
    assert np.count_nonzero(choose_frames(slide, 8, REJECTED, "force") < 5) == 5
    np.testing.assert_array_equal(choose_frames(slide, 8, REJECTED, "salience"), own)
    np.testing.assert_array_equal(choose_frames(ramp, 8, REJECTED, "force"), choose_frames(ramp, 8, REJECTED))
    said = "force_n is None: frames cannot be chosen by it; choose by 'auto'"
    refused(SchemaError, said, choose_frames, filmed(np.zeros(20)), 8, REJECTED, "force")
    refused(SchemaError, "has no frame; drop the empty sequence", lambda: choose_frames(pressed([]), 8, REJECTED))


def test_film_without_force_is_read_densest_where_most_is_seen():
    change = np.zeros(60, np.uint8)
    change[30:40] = 100
    change[36] = 140
    chosen = choose_frames(filmed(change), 8, REJECTED)
    assert np.count_nonzero((chosen >= 30) & (chosen < 40)) >= 6
    assert 36 in chosen
    assert chosen[0] < 30
    change[1:30], change[36], change[40:] = 5, 100, 5  # the noise of a film, which never equals its first frame again
    chosen = choose_frames(filmed(change), 8, REJECTED)
    assert np.count_nonzero((chosen >= 30) & (chosen < 40)) == 7


@hypothesis.given(st.integers(1, 40), st.integers(1, 10), st.integers(0, 2**31), st.booleans(), st.booleans())
def test_frames_are_unique_increasing_and_hold_the_deepest_press(length, count, seed, force, jagged):
    rng = np.random.default_rng(seed)
    value = rng.permutation(200)[:length] if jagged else np.sort(rng.permutation(200)[:length])
    made = pressed(value / 10) if force else filmed(value)
    chosen = choose_frames(made, count, REJECTED)
    assert len(chosen) == min(count, length)
    assert (np.diff(chosen) > 0).all()
    deepest = value if force else np.abs(value.astype(int) - int(value[0]))
    assert deepest[chosen].max() == deepest.max()


def test_rejected_frames_are_left_out_while_others_remain():
    flags = np.zeros(20, np.uint32)
    flags[15:] = int(Flag.STRAIN_LIMIT | Flag.BORDER_CONTACT)
    flags[3] = int(Flag.BORDER_CONTACT)
    load = np.linspace(0, 20, 20)
    chosen = choose_frames(pressed(load, flags=flags), 8, REJECTED)
    assert chosen.max() == 14
    assert len(chosen) == 8
    assert len(choose_frames(pressed(load, flags=flags), 18, REJECTED)) == 15
    assert choose_frames(pressed(load, flags=flags), 8, ()).max() == 19
    assert len(choose_frames(pressed(load, flags=np.full(20, 4, np.uint32)), 8, REJECTED)) == 8


def test_field_images_have_one_fixed_scale():
    made = sequence(sensor="tac3d", length=2, deformation_mm=np.full((2, 5, 6, 2), 0.75, np.float32))
    made.deformation_mm[1] = -1.5
    made.depth_mm[:] = 1.5
    made.valid[:] = True
    made.valid[:, 0, 0] = False
    made.depth_mm[:, 0, 0] = np.nan
    images = field_images(made)
    assert pytest.approx(0.0118, rel=0.01) == FIELD_MM_PER_COUNT
    np.testing.assert_allclose(images[0, 2, 2], [128 + 63.5, 128 + 63.5, 255], rtol=1e-6)
    np.testing.assert_allclose(images[1, 2, 2], [1, 1, 255], rtol=1e-5)
    np.testing.assert_array_equal(images[:, 0, 0], 128)
