"""The background follows untouched frames, and says how far it has gone."""

import numpy as np

from sensors_io.devices.background import GelBackground
from tests.sensors_io.checks import refused


def grey(level):
    return np.full((2, 3, 3), level, np.uint8)


def test_the_mean_of_untouched_frames_and_its_drift():
    """A mean of four, into which the fifth enters by a quarter."""
    background = GelBackground(memory=4)
    for level, touched in [(100, False), (200, True), (102, False), (104, False), (106, False)]:
        background.offer(grey(level), touched=touched)
    assert background.frames == 4
    assert np.all(background.picture() == 103)
    assert background.drift().rms == 0
    background.offer(grey(107), touched=False)
    assert np.all(background.picture() == 104)
    for _ in range(60):
        background.offer(grey(113), touched=False)
    np.testing.assert_allclose([*background.drift().mean, background.drift().rms], 10, atol=0.01)


def test_an_empty_background_has_no_picture_and_no_drift():
    background = GelBackground()
    background.offer(grey(5), touched=True)
    assert background.drift() is None
    refused(ValueError, "holds no frame", background.picture)
    background.offer(grey(5), touched=False)
    other = np.full((4, 4, 3), 7, np.uint8)  # a camera that came back with another size
    assert not background.looks_touched(other)
    background.offer(other, touched=False)
    assert (background.frames, background.picture().tolist()) == (1, other.tolist())
    refused(ValueError, "memory is 0", GelBackground, 0)


def test_pictures_tell_a_touch_and_not_the_lamps():
    rng = np.random.default_rng(0)
    gel = rng.integers(60, 120, (60, 80, 3)).astype(np.uint8)
    noisy = (gel + rng.normal(0, 2, gel.shape)).clip(0, 255).astype(np.uint8)
    touched = gel.copy()
    touched[20:30, 30:40] += 40
    background = GelBackground()
    assert not background.looks_touched(touched)  # there is nothing to compare with
    background.offer(gel, touched=False)
    brighter = gel + np.uint8(25)
    assert [background.looks_touched(picture) for picture in (gel, noisy, brighter, touched)] == [False] * 3 + [True]
