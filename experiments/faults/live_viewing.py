"""A recording that is watched: what browsers see and when, and what the recorder notices of them.

A camera is replayed at its true rate and recorded into a journal as a session does it, while browsers in processes of
their own follow the page: each hears of every state and asks for all of its pictures.
"""

import contextlib
import dataclasses
import json
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence

import numpy as np

from experiments.faults.replayed_camera import NoiseCamera
from sensors_io.clock import NS_PER_S
from sensors_io.devices.base import Identity
from sensors_io.devices.bridge import BridgeConfig
from sensors_io.devices.errors import DeviceLostError
from sensors_io.devices.reader import Reader
from sensors_io.devices.replay import Replay
from sensors_io.devices.sources import Recorded
from sensors_io.recording.journal import JournalWriter
from sensors_io.viewer.presenter import Channel, Presenter
from sensors_io.viewer.server import LiveView

_IDLE_S = 0.002  # between looks of a session at its devices
_FIELD = (18, 24)  # rows and columns of the fields that are shown

BROWSER = """
import http.client, json, sys, threading, time, urllib.parse
host, port, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
newest, heard = [None], threading.Event()
def listen():
    events = http.client.HTTPConnection(host, port)
    events.request("GET", "/numbers")
    for line in events.getresponse():
        if line.startswith(b"data: "):
            newest[0] = json.loads(line[6:])
            heard.set()
threading.Thread(target=listen, daemon=True).start()
pictures = http.client.HTTPConnection(host, port)
end, ages, size = time.monotonic() + seconds, [], 0
while time.monotonic() < end:
    if not heard.wait(0.1):
        continue
    heard.clear()
    said = newest[0]
    for name in said["panels"]:
        pictures.request("GET", "/panel/" + urllib.parse.quote(name))
        size += len(pictures.getresponse().read())
    ages.append(time.monotonic() - said["time_s"])
print(json.dumps({"ages_s": ages, "bytes": size}))
"""
"""A browser as far as the server can tell: it hears of every state and skips pictures rather than fall behind, as the
page does.  What it shows is as old as the stamp of the sample that it heard of when the last panel is in."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class NoiseFieldCamera:
    """The camera of `endurance.Loop` with fields to be shown."""

    loop: NoiseCamera

    @property
    def identity(self) -> Identity:
        return self.loop.identity

    def samples(self) -> Iterator[Recorded]:
        depth = np.linspace(0, 1, _FIELD[0] * _FIELD[1], dtype=np.float32).reshape(_FIELD)
        shift = np.stack([depth, depth[::-1]], -1) * np.float32(0.3)
        arrays = {"depth_mm": depth, "deformation_mm": shift, "shear_mm": shift}
        for recorded in self.loop.samples():
            yield dataclasses.replace(recorded, arrays=arrays)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewedRecording:
    """One recording.

    Args:
      name: who watched.
      shown_hz: states that a browser showed a second, mean over browsers; NaN without any.
      ages_s: of the pictures when they were there, all browsers.
      looks_s: time between two looks of the recorder at its device.
      written, lost: samples journaled, and those that were not.
    """

    name: str
    shown_hz: float
    ages_s: np.ndarray
    looks_s: np.ndarray
    written: int
    lost: int


def watched(loop: NoiseCamera, seconds: float, browsers: int | None) -> ViewedRecording:
    """Record for so long.

    Args:
      loop: the camera.
      seconds: of recording.
      browsers: that watch; `None` records without a page.
    """
    with contextlib.ExitStack() as stack:
        home = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        reader = stack.enter_context(Reader(Replay(NoiseFieldCamera(loop=loop))))
        journal = stack.enter_context(JournalWriter(home / "journal"))
        watchers: list[subprocess.Popen[str]] = []
        if browsers is not None:
            live = stack.enter_context(LiveView(port=0))
            stack.enter_context(Presenter([Channel(reader)], None, live).beside())
            watchers = [_browser(live, seconds) for _ in range(browsers)]
        looks, written = _record(reader, journal, seconds)
        counts = reader.counts  # nobody reads on while the browsers end
        told = [json.loads(watcher.communicate()[0]) for watcher in watchers]
    ages = np.concatenate([np.array(t["ages_s"]) for t in told]) if told else np.zeros(0)
    return ViewedRecording(
        name="no page" if browsers is None else f"{browsers} browser" + "s" * (browsers != 1),
        shown_hz=len(ages) / seconds / len(told) if told else float("nan"),
        ages_s=ages,
        looks_s=looks,
        written=written,
        lost=counts.lost,
    )


def _record(reader: Reader, journal: JournalWriter, seconds: float) -> tuple[np.ndarray, int]:
    """Journal everything that comes, as a session does; times between looks, and how many samples."""
    looks, written = [time.monotonic()], 0
    while looks[-1] - looks[0] < seconds:
        samples = reader.drain()
        for sample in samples:
            assert sample.frame is not None
            journal.append("frame", {"time_ns": sample.host_time_ns}, frame=sample.frame, **sample.arrays)
        written += len(samples)
        if not samples:
            time.sleep(_IDLE_S)
        looks.append(time.monotonic())
    return np.diff(looks), written


def _browser(live: LiveView, seconds: float) -> subprocess.Popen[str]:
    host, port = live.address.removeprefix("http://").rstrip("/").split(":")
    command = [sys.executable, "-c", BROWSER, host, port, str(seconds)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BridgeTransfer:
    """What a bridge carried: pictures a second, and how old each was when it was read, [N]."""

    rate_hz: float
    ages_s: np.ndarray


def bridged(count: int) -> BridgeTransfer:
    """Read pictures of 640 × 480 from a bridge as fast as it gives them; the first is left out."""
    config = BridgeConfig(python=sys.executable, adapter="experiments.faults.picture_flood:frames", serial=str(count))
    stamps: list[tuple[int, int]] = []
    with config.open() as device, contextlib.suppress(DeviceLostError):  # it ends after so many
        device.read(60.0)
        while True:
            sample = device.read(60.0)
            stamps.append((sample.host_time_ns, time.monotonic_ns()))
    made, read = np.array(stamps, np.int64).T
    return BridgeTransfer(
        rate_hz=(len(read) - 1) * NS_PER_S / float(read[-1] - read[0]), ages_s=(read - made) / NS_PER_S
    )


def quantiles_ms(seconds: np.ndarray, shares: Sequence[float]) -> list[float | None]:
    """Quantiles in ms; `None` of nothing."""
    return [1e3 * float(np.quantile(seconds, share)) if len(seconds) else None for share in shares]
