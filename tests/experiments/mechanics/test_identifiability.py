"""The study of identifiability, shrunk: presses are the generator's own, probes are tested on unseen objects."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.mechanics import identify_features, identify_motions, identify_presses, identify_probes
from experiments.mechanics.identify_presses import ContactTier, press_features, press_setup, read_press
from sensors_io.scenes import schedule, surface
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.press import make_kernels
from sensors_io.scenes.sensors import MODELS
from sensors_io.scenes.sequence import make_sequence
from sensors_io.schema import SENSORS, Phase
from touchr1_jax.training.linear_probe import ProbeConfig, cross_fit

SCENES = SceneConfig(objects=8, sites=1, frames=3, min_force_n=0.3, max_force_n=3.0, image_px=24, contact_grid=24)
PROBE = ProbeConfig(folds=4, iterations=20)


@pytest.mark.long
def test_features_repeat_whatever_the_batch_and_grow_with_noise():
    order, tier = SENSORS.index("tac3d"), ContactTier(name="", grid=24)
    draws = identify_presses.drawn_presses(SCENES, order)[:3]
    two, one = (press_features(SCENES, tier, order, draws, (0.0, 4.0), batch) for batch in (2, 1))
    assert two.features.shape[:2] == (3, 2)
    np.testing.assert_allclose(two.features, one.features, atol=2e-3)
    assert np.all(two.converged)
    assert np.all(np.diff(two.strain, axis=1) > 0)
    assert np.abs(two.features[:, 1] - two.features[:, 0]).max() > 0.1


@pytest.mark.long
@pytest.mark.parametrize("order", [SENSORS.index("gelsight_mini"), SENSORS.index("tac3d")])
def test_a_press_is_the_generators_own(order):
    tier = ContactTier(name="", grid=SCENES.contact_grid, tolerance=SCENES.solver_tolerance)
    by = press_setup(SCENES, tier, order, (1.0,))
    drawn = identify_presses.drawn_presses(SCENES, order)[2]
    kernels = make_kernels(MODELS[order], by.grid)
    seen = jax.jit(lambda touch: read_press(touch, kernels, tier.tolerance, by))(drawn)
    made = make_sequence(SCENES, 2, schedule.press_slot(SCENES, 2), order, 0)
    np.testing.assert_array_equal(drawn.measured_n, made.force_n)
    np.testing.assert_allclose(seen.fields.depth_mm[:, 0], made.depth_mm, atol=1e-5)
    if made.deformation_mm is not None:
        np.testing.assert_allclose(seen.fields.deformation_mm[:, 0], made.deformation_mm, atol=1e-5)
    if made.frames is not None:
        off = np.abs(seen.pictures[:, 0].astype(int) - made.frames.astype(int))
        assert off.max() <= 1
        assert np.mean(off > 0) < 1e-3


def skin(radius_mm=(20.0, 40.0), wave_mm=1.5, amplitude_mm=0.0):
    """A paraboloid with one plane wave along x."""
    features = {"feature_height_mm": 0.0, "feature_pitch_mm": 3.0, "feature_width": 0.2}
    waves = {
        "wave_numbers": [[2 * np.pi / wave_mm, 0.0]],
        "wave_amplitudes_mm": [amplitude_mm],
        "wave_phases_rad": [0.0],
    }
    fields = {"curvature_per_mm": 1 / np.array(radius_mm), "turn_rad": 0.3, "site_mm": np.zeros(2), **features, **waves}
    return surface.Skin(pattern=jnp.asarray(0), **{name: jnp.asarray(v, jnp.float32) for name, v in fields.items()})


def test_statistics_of_a_paraboloid():
    (found,) = np.exp(identify_features.statistics([skin()]))
    np.testing.assert_allclose(found[:2], [1 / 40, 1 / 20], rtol=1e-3)
    np.testing.assert_allclose(found[2:9], 0, atol=1e-4)
    below = 2 * np.pi * np.sqrt(20 * 40) * np.array([0.1, 0.3]) / identify_features.WINDOW_MM**2  # π√(R₁R₂)·2h
    np.testing.assert_allclose(found[11:13], below, rtol=0.05)


@pytest.mark.parametrize(("wave_mm", "band"), [(1.5, 5), (1.0, 6)])
def test_a_wave_lies_in_its_band(wave_mm, band):
    (found,) = np.exp(identify_features.statistics([skin((1e4, 1e4), wave_mm, 0.02)]))
    rms = found[2:9]
    assert rms[band] == pytest.approx(0.02 / np.sqrt(2) * 0.375, rel=0.05)  # Hann's mean square along each axis is 3/8
    assert np.delete(rms, band).max() < 0.1 * rms[band]


@pytest.fixture(scope="module")
def questions():
    """Features that show the level of 60 contacts of 30 objects, levels, objects."""
    rng = np.random.default_rng(1)
    objects = np.repeat(np.arange(30), 2)
    labels = (objects % 3).astype(int)
    features = (np.eye(3)[labels] + 0.4 * rng.normal(size=(60, 3))).astype(np.float32)
    return features, labels, objects


@pytest.mark.long
def test_reading_the_training_records_is_cross_fitting(questions):
    features, labels, objects = questions
    own, again = identify_probes.transfer(features, [features], labels, objects, PROBE)
    expected = cross_fit(features, labels, objects, 3, PROBE)
    np.testing.assert_allclose(own.log_probs, expected, atol=1e-5)
    np.testing.assert_array_equal(again.log_probs, own.log_probs)
    assert own.right.mean() > 0.8


@pytest.mark.long
def test_an_object_is_predicted_by_a_probe_that_never_saw_it(questions):
    _, labels, objects = questions
    names = np.eye(30, dtype=np.float32)[objects]  # determine everything about objects that were trained on
    (answers,) = identify_probes.transfer(names, [], labels, objects, PROBE)
    assert answers.right.mean() < 0.5


@pytest.mark.long
def test_a_probe_carries_over_what_its_records_taught(questions):
    features, labels, objects = questions
    wrong = features[:, [1, 2, 0]]  # each level looks like another one
    own, exact = identify_probes.transfer(wrong, [features], labels, objects, PROBE)
    assert own.right.mean() > 0.8
    assert exact.right.mean() < 0.2


def test_fused_answers_multiply():
    labels = np.array([0, 1])
    first = np.log([[0.6, 0.3, 0.1], [0.4, 0.5, 0.1]])
    second = np.log([[0.2, 0.1, 0.7], [0.3, 0.6, 0.1]])
    one, two = (identify_probes.ProbePredictions(p, labels) for p in (first, second))
    both = identify_probes.fuse([one, two])
    np.testing.assert_allclose(np.exp(both.log_probs[0]), [0.12, 0.03, 0.07])
    assert (two.right.tolist(), both.right.tolist()) == ([0, 1], [1, 1])
    assert (two.far_off, both.far_off) == (50, 0)


def test_frames_of_a_motion_are_those_in_which_something_changes():
    a, load, hold, un = (p.value for p in (Phase.APPROACH, Phase.LOAD, Phase.HOLD, Phase.UNLOAD))
    phase = np.array([a, a, load, load, hold, hold, hold, un, un])
    np.testing.assert_array_equal(identify_motions.choose_frames(phase, 3), [0, 2, 8])
    np.testing.assert_array_equal(identify_motions.choose_frames(phase, 5), [0, 2, 3, 7, 8])
    with pytest.raises(ValueError, match="moments is 6: only 5 frames differ"):
        identify_motions.choose_frames(phase, 6)
