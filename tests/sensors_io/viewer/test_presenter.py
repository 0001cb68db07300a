"""What a bench shows, from fake devices."""

import json
import threading
import time

import numpy as np
import pytest

from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import StaleFrameError, StreamEndedError
from sensors_io.devices.intake import Counts
from sensors_io.fields.extract import Extractor
from sensors_io.schema import Flag
from sensors_io.viewer.presenter import Channel, Presenter
from sensors_io.viewer.server import LiveView


class Watched:
    """A device whose newest sample is set from outside."""

    overloaded = False

    def __init__(self, sensor, arrays=None, frame=None, **counts):
        self.identity = Identity(sensor=sensor, serial="7")
        self.counts = Counts(**counts)
        self.newest = self.made(arrays or {}, frame)

    def made(self, arrays, frame=None):
        return Sample(host_time_ns=time.monotonic_ns(), frame=frame, arrays=arrays)

    def latest(self, max_age_s):
        if isinstance(self.newest, Exception):
            raise self.newest
        return self.newest


def shown(presenter, live):
    presenter.step()
    return json.loads(live.shown.event().removeprefix(b"data: "))


@pytest.fixture
def live():
    with LiveView(port=0) as view:
        yield view


def test_two_sensors_and_a_force_on_one_page(live):
    frame = np.full((6, 8, 3), 90, np.uint8)
    camera = Watched("gelsight_mini", frame=frame, arrived=50, missing=3)
    skin = Watched("tac3d", {"depth_mm": np.zeros((4, 4)), "flags": np.uint32(Flag.TIME_GAP | Flag.SATURATED)})
    force = Watched("netft", {"force_n": np.array([3.0, 4.0, -2.0])})
    larger = Extractor(np.full((60, 80, 3), 90, np.uint8), 0.1)
    said = shown(Presenter([Channel(camera, larger), Channel(skin)], force, live), live)
    assert said["tables"]["gelsight_mini"]["fields"].startswith(
        "none: pictures are (6, 8), the gel at rest is (60, 80)"
    )
    assert said["panels"] == ["gelsight_mini: camera", "tac3d: depth"]
    assert said["captions"]["tac3d: depth"].startswith("indentation")
    assert said["title"] == "gelsight_mini 7 + tac3d 7"
    assert said["force_n"] == [3.0, 4.0, -2.0]
    assert said["tables"]["gelsight_mini"]["lost"] == "3 (3 not received)"
    assert said["tables"]["tac3d"]["flags"] == "saturated, time gap"
    assert said["tables"]["force"] == {"normal": "2.00 N", "tangential": "5.00 N", "lost": "0"}


def test_alarms_are_told_worst_first(live):
    skin = Watched("tac3d", {"force_n": np.array([0.0, 0.0, -30.0])}, disconnects=1)
    presenter = Presenter([Channel(skin)], None, live)
    assert shown(presenter, live)["alarm"] == "overload: 30 N, release"
    skin.newest = skin.made({"force_n": np.array([0.0, 0.0, np.nan])})
    said = shown(presenter, live)
    assert (said["alarm"], said["force_n"]) == ("tac3d: disconnected", None)
    skin.counts, skin.overloaded = Counts(), True
    skin.newest = skin.made({"force_n": np.zeros(3)})
    assert "too slowly" in shown(presenter, live)["alarm"]
    skin.newest = StaleFrameError("old")
    assert not presenter.step()


def test_a_session_puts_its_prompt_on_the_page(live):
    said = shown(Presenter([Channel(Watched("tac3d"))], None, live, lambda: ("hold 5 N", "out of range")), live)
    assert (said["prompt"], said["alarm"]) == ("hold 5 N", "out of range")


def test_the_background_of_a_camera_is_refreshed_where_nothing_touches(live):
    gel = np.random.default_rng(0).integers(60, 120, (40, 40, 3)).astype(np.uint8)
    camera = Watched("gelsight_mini", frame=gel)
    channel = Channel(camera)
    for level in range(130):
        camera.newest = camera.made({}, gel + np.uint8(level // 26))
        channel.look()
    assert channel.drift.rms == pytest.approx(0.66, abs=0.1)
    assert "grey levels" in channel.table()["background drift"]


def test_it_runs_beside_and_stops_with_its_device(live):
    device = Watched("tac3d", {"depth_mm": np.zeros((4, 4))})
    presenter = Presenter([Channel(device)], None, live)
    with presenter.in_thread():
        deadline = time.monotonic() + 5
        while live.shown.version == 0 and time.monotonic() < deadline:
            time.sleep(0.01)
    assert live.shown.version == 1
    device.newest = StreamEndedError("over")
    presenter.run(lambda: False)
    assert not [t for t in threading.enumerate() if t.name == "presenter"]
