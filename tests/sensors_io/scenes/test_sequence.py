"""Touches over time: forces obey friction and the plan, repeat exactly, and what passes the limit is replaced."""

import dataclasses

import numpy as np
import pytest

from sensors_io.scenes import motions, protocol, schedule, strength
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.draws import site_of
from sensors_io.scenes.protocol import make_contact
from sensors_io.scenes.sensors import MODELS
from sensors_io.scenes.sequence import light_touches, make_sequence
from sensors_io.schema import SENSORS, Flag, Phase

CONFIG = SceneConfig(objects=12, sequences=4 * 40, frames=40, image_px=24, contact_grid=24, view_px=16)
TAC3D = SENSORS.index("tac3d")


def _slot(motion: str, force_n: float = 2.0) -> schedule.Slot:
    return schedule.Slot(object_index=3, site=1, motion=motion, force_n=force_n)


@pytest.fixture(scope="module")
def slide():
    return make_sequence(CONFIG, 5, _slot("slide_x"), TAC3D, 0)


@pytest.fixture(scope="module")
def hold():
    return make_sequence(CONFIG, 6, _slot("hold", 8.0), TAC3D, 0)


@pytest.mark.long
def test_friction_follows_the_slide_and_keeps_to_coulomb(slide):
    hand = motions.plan("slide_x", 2.0, schedule.pace(40))
    moving = hand.phase == Phase.MOVE
    friction = site_of(CONFIG, 3, 1, 0).solid.friction
    assert np.all(np.abs(slide.force_n[:, 0]) <= friction * np.abs(slide.force_n[:, 2]) * 1.1 + 0.15)
    speed = np.gradient(hand.slide_mm[:, 0])
    late = moving & (np.abs(np.diff(speed, prepend=speed[0])) < 1e-9) & (np.abs(speed) > 0)
    assert np.corrcoef(slide.force_n[late, 0], speed[late])[0, 1] > 0.5
    assert np.abs(slide.force_n[:, 1]).max() < 0.3
    assert np.abs(slide.shear_mm[moving]).max() > 5 * np.abs(slide.shear_mm[: 1 + hand.phase.argmax()][0]).max() / 4


@pytest.mark.long
def test_frames_come_on_the_cameras_clock(slide, hold):
    for sequence in (slide, hold):
        assert np.all(np.diff(sequence.host_time_ns) > 0)
        seconds = (sequence.host_time_ns - sequence.host_time_ns[0]) / 1e9
        assert seconds[-1] == pytest.approx(39 * 0.04, abs=0.04)
        np.testing.assert_array_equal(sequence.force_time_ns, sequence.host_time_ns - 2_000_000)


def same(a, b):
    """All arrays of two sequences, but for the flag of adhesion."""
    for name, array in vars(a).items():
        if isinstance(array, np.ndarray):
            adhesive = np.uint32(Flag.ADHESION) if name == "flags" else array.dtype.type(0)
            pair = [x & ~adhesive if name == "flags" else x for x in (array, getattr(b, name))]
            np.testing.assert_array_equal(*pair, err_msg=name)


def test_a_sequence_repeats_bit_for_bit_and_what_adhesion_would_change_is_flagged(slide):
    """Sixty times the work makes every touch at 2 N a light one; none makes none; nothing else changes."""
    configs = [CONFIG, *(dataclasses.replace(CONFIG, adhesion_j_per_m2=work) for work in (0.0, 3.0))]
    again, without, much = (make_sequence(config, 5, _slot("slide_x"), TAC3D, 0) for config in configs)
    for other in (again, without, much):
        same(slide, other)
    adhesive = lambda made: (made.flags & np.uint32(Flag.ADHESION)) > 0
    np.testing.assert_array_equal(adhesive(again), adhesive(slide))
    assert not np.any(adhesive(without))
    np.testing.assert_array_equal(adhesive(much), slide.target_force_n > 0)


def test_a_contact_past_the_limit_is_replaced_by_another_site(monkeypatch, hold):
    tried = []

    def fake(config, index, what, order, trial):
        tried.append(trial)
        flags = np.where(np.arange(40) == 39, np.uint32(Flag.STRAIN_LIMIT if trial < 2 else 0), np.uint32(0))
        return dataclasses.replace(hold, flags=flags.astype(np.uint32), sensor=SENSORS[order])

    monkeypatch.setattr(protocol, "make_sequence", fake)
    monkeypatch.setattr(protocol, "slot", lambda config, index: _slot("hold"))
    made = make_contact(CONFIG, 0)
    assert tried == [0] * 4 + [1] * 4 + [2] * 4
    assert not any(s.flags.any() for s in made)
    for config in (SceneConfig(objects=12), dataclasses.replace(CONFIG, past_limit="flag")):
        tried.clear()
        made = make_contact(config, 0)
        assert tried == [0] * 4
        assert all(s.flags.any() for s in made)


@pytest.mark.long
def test_limits_lie_where_the_strain_does():
    """The look's limit, on one sensor and a coarse grid, against presses at that force."""
    sites = [site_of(CONFIG, i, 0, 0) for i in range(10)]
    turns, moduli = np.array([(s.turn_rad, s.solid.modulus_mpa) for s in sites]).T
    limits = strength.look([s.skin for s in sites], turns, moduli, MODELS[TAC3D : TAC3D + 1])
    assert np.all(limits.rigid_n <= limits.actual_n * 1.02)
    for factor, past in ((0.8, False), (1.6, True)):
        for i in range(10):
            if not 1.5 < limits.actual_n[i] < 20:
                continue  # beyond the forces of the look its limit is a guess
            slot = schedule.Slot(object_index=i, site=0, motion="hold", force_n=float(factor * limits.actual_n[i]))
            flags = make_sequence(CONFIG, 20 + i, slot, TAC3D, 0).flags
            assert bool(np.any(flags & np.uint32(Flag.STRAIN_LIMIT))) == past, (i, factor)


def test_adhesion_counts_in_the_lightest_touches_of_smooth_objects():
    config = dataclasses.replace(CONFIG, objects=40)
    force = np.array([0.0, 0.01, 0.1, 0.3, 1.0, 5.0])
    found = []
    for index in range(config.objects):
        site = site_of(config, index, 0, 0)
        found.append(light_touches(config, MODELS[TAC3D], site, force) > 0)
        if site.solid.rms_mm > 0.03:
            assert not found[-1].any()
    share = np.mean(found, 0)
    assert share[0] == share[-1] == 0
    assert np.all(np.diff(share[1:]) <= 0)
    assert 0.1 < share[1] < 0.7


@pytest.mark.long
def test_a_coupled_press_feels_the_spreading_gel_and_an_uncoupled_one_nothing(hold):
    coupled = make_sequence(dataclasses.replace(CONFIG, coupled=True), 6, _slot("hold", 8.0), TAC3D, 0)
    np.testing.assert_array_equal(coupled.depth_mm.shape, hold.depth_mm.shape)
    pressed = hold.target_force_n > 4
    change = np.abs(coupled.shear_mm - hold.shear_mm)[pressed].max()
    assert 0.002 < change < 0.5  # above the rounding, below what would be a slide
    assert np.abs(coupled.force_n[:, :2] - hold.force_n[:, :2]).max() < 0.3  # what spreads evenly pulls nowhere
