"""A hand that does what the prompts say, a gel under it, and a force sensor: no device, no clock."""

import numpy as np

from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.intake import Counts
from sensors_io.schema import Phase

MS = 1_000_000


class Hand:
    """10 ms pass at every look of the camera; the force follows the phase shown last, and slips in some contacts."""

    def __init__(self, slips_at=()):
        self.time_ns, self.force_n, self.shown, self.contacts = 10**9, 0.0, None, 0
        self.slips_at = slips_at
        self.statuses = []

    def show(self, status):
        """What `record_session` calls."""
        if status.advice.done and (self.shown is None or not self.shown.advice.done):
            self.contacts += 1
        self.shown = status
        self.statuses.append(status)

    def move(self):
        """10 ms of the hand."""
        self.time_ns += 10 * MS
        advice = None if self.shown is None else self.shown.advice
        if advice is None or advice.done or not advice.recording or advice.phase == Phase.UNLOAD:
            self.force_n = max(0.0, self.force_n - 2.0)
        elif advice.phase in (Phase.APPROACH, Phase.LOAD):
            self.force_n = min(self.force_n + 0.5, advice.target_n)
        elif self.contacts in self.slips_at:
            self.slips_at = tuple(k for k in self.slips_at if k != self.contacts)
            self.force_n = 0.0


class Camera:
    """A feed of frames whose first pixel counts them; every look moves the hand."""

    def __init__(self, hand, sensor="gelsight_mini"):
        self.hand, self.count, self.sensor = hand, 0, sensor

    identity = property(
        lambda self: Identity(
            sensor=self.sensor, serial="R0B-1", settings={"exposure": 100.0}, period_s=0.01, mm_per_px=0.0634
        )
    )
    counts = property(lambda self: Counts(arrived=self.count, delivered=self.count))

    def drain(self):
        self.hand.move()
        frame = np.zeros((4, 6, 3), np.uint8)
        frame[0, 0, 0] = self.count % 256
        self.count += 1
        return [Sample(host_time_ns=self.hand.time_ns, index=self.count, frame=frame)]


class Scale:
    """A feed of five forces for every look of the camera, with 1 N of bias along z, reading 10 mm above the window."""

    identity = property(lambda self: Identity(sensor="netft", period_s=0.002))
    counts = property(lambda self: Counts())

    def __init__(self, hand):
        self.hand, self.last_ns = hand, hand.time_ns

    def drain(self):
        times = np.arange(self.last_ns + 2 * MS, self.hand.time_ns + 1, 2 * MS)
        self.last_ns = self.hand.time_ns
        force = np.array([0.0, 0.0, 1.0 - self.hand.force_n], np.float32)
        arrays = {"force_n": force, "moment_nmm": np.zeros(3, np.float32)}
        return [Sample(host_time_ns=int(t), arrays=arrays) for t in times]


class Skin:
    """A feed of fields and of the hand's force, at the times of the camera's looks, stamped `late_ns` later."""

    identity = property(lambda self: Identity(sensor="tac3d", serial="A1", period_s=0.01))
    counts = property(lambda self: Counts(arrived=self.count, delivered=self.count))

    def __init__(self, hand, late_ns=0):
        self.hand, self.late_ns, self.count = hand, late_ns, 0

    def drain(self):
        self.count += 1
        arrays = {
            "depth_mm": np.full((3, 3), self.hand.force_n / 20, np.float32),
            "force_n": np.array([0.0, 0.0, -self.hand.force_n], np.float32),
        }
        return [Sample(host_time_ns=self.hand.time_ns + self.late_ns, index=self.count, arrays=arrays)]
