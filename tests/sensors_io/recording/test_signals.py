"""Devices that feel one hand, stamped apart: the offsets come out with their signs."""

import numpy as np
import pytest

from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.intake import Counts
from sensors_io.offsets import OffsetsError
from sensors_io.recording.signals import Listener, measure_offsets
from tests.sensors_io.checks import refused

AT = np.cumsum([1.0, 1.3, 0.9, 1.7, 1.1, 1.45])


def touches(time_s, rise_s):
    """Taps at `AT`: a rise, then a slower fall."""
    past = time_s[:, None] - AT
    return (np.clip(past / rise_s, 0, 1) * np.exp(-np.clip(past - rise_s, 0, None) / (3 * rise_s))).sum(-1)


class Feed:
    """Samples of a device with some rate and lateness, all in one look."""

    counts = property(lambda self: Counts())

    def __init__(self, sensor, rate_hz, late_s=0.0, rise_s=0.02, picture=False, seed=0):
        self.identity = Identity(sensor=sensor)
        rng = np.random.default_rng(seed)
        time_s = np.arange(0, 9, 1 / rate_hz)
        load = touches(time_s, rise_s) + 0.002 * rng.normal(size=len(time_s))
        self.samples = [self._sample(round(1e9 * (t + late_s)), n, picture) for t, n in zip(time_s, load, strict=True)]

    @staticmethod
    def _sample(time_ns, load, picture):
        if picture:
            return Sample(host_time_ns=time_ns, frame=np.full((8, 8, 3), 60 + 100 * max(load, 0), np.uint8))
        return Sample(host_time_ns=time_ns, arrays={"force_n": np.array([0, 0, -5 * load])})

    def drain(self):
        given, self.samples = self.samples, []
        return given


def heard(feed):
    listener = Listener(feed)
    listener.look()
    return listener.signal()


@pytest.mark.parametrize(("by", "rise_s"), [("taps", 0.02), ("presses", 0.3)])
def test_what_is_stamped_late_is_late(by, rise_s):
    reference = heard(Feed("netft", 500, rise_s=rise_s))
    others = {
        "gelsight_mini": heard(Feed("gelsight_mini", 60, late_s=0.045, rise_s=rise_s, picture=True)),
        "tac3d": heard(Feed("tac3d", 100, late_s=-0.02, rise_s=rise_s)),
    }
    found = measure_offsets(reference, others, "netft", by)
    assert found.late_s == pytest.approx({"netft": 0, "gelsight_mini": 0.045, "tac3d": -0.02}, abs=0.004)
    assert found.sensors["tac3d"].by == by


def of(*samples, sensor="tac3d"):
    """A feed of these samples."""
    feed = Feed(sensor, 100)
    feed.samples = list(samples)
    return feed


def test_a_sensor_that_felt_nothing_is_named():
    silent = of(*(Sample(host_time_ns=10**7 * n, arrays={"force_n": np.zeros(3)}) for n in range(900)))
    late = {"tac3d": heard(silent)}
    said = r"tac3d against netft: signal b shows 0 taps"
    refused(OffsetsError, said, measure_offsets, heard(Feed("netft", 500)), late, "netft", "taps")
    refused(OffsetsError, "tac3d gave 0 samples", heard, of())
    refused(OffsetsError, "nothing shows a touch", heard, of(Sample(host_time_ns=0)))


def test_samples_unlike_most_are_left_out():
    """One of another size, and one without a picture, in place of two of the camera's."""
    feed = Feed("digit", 60, picture=True)
    for n, odd in ((0, {"frame": np.zeros((16, 8, 3), np.uint8)}), (40, {"arrays": {"force_n": np.full(3, 9.0)}})):
        feed.samples[n] = Sample(host_time_ns=feed.samples[n].host_time_ns, **odd)
    signal = heard(feed)
    assert len(signal.time_ns) == 538
    assert signal.value[0] == 0
    assert signal.value.max() < 110
