"""A recording that browsers watch, and a bridge that carries pictures: the delays, and the samples lost.

A camera is replayed at its true rate and recorded into a journal as a session does it, while browsers in processes of
their own follow the page: each receives every state and requests all of its pictures.
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
from typing import Any

import numpy as np

from experiments.core.context import Context
from experiments.core.results import ReportPart, at_least, at_most, named_table
from experiments.faults.replayed_camera import NoiseCamera
from sensors_io.clock import NS_PER_S
from sensors_io.devices.bridge import BridgeConfig
from sensors_io.devices.errors import DeviceLostError
from sensors_io.devices.reader import Reader
from sensors_io.devices.replay import Replay
from sensors_io.recording.journal import JournalWriter
from sensors_io.viewer.presenter import Channel, Presenter
from sensors_io.viewer.server import LiveView

BRIDGE_SHAPE = (480, 640, 3)  # of a picture through the bridge: the cameras of Xense and DM-Tac
FASTEST_HZ = 120.0  # rate of the vendors' fastest camera, a DM-Tac

_IDLE_S = 0.002  # between looks of a session at its devices

BROWSER = """
import http.client, json, sys, threading, time, urllib.parse
host, port, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
newest, changed = [None], threading.Event()
def listen():
    events = http.client.HTTPConnection(host, port)
    events.request("GET", "/numbers")
    for line in events.getresponse():
        if line.startswith(b"data: "):
            newest[0] = json.loads(line[6:])
            changed.set()
threading.Thread(target=listen, daemon=True).start()
pictures = http.client.HTTPConnection(host, port)
end, ages = time.monotonic() + seconds, []
while time.monotonic() < end:
    if not changed.wait(0.1):
        continue
    changed.clear()
    state = newest[0]
    for name in state["panels"]:
        pictures.request("GET", "/panel/" + urllib.parse.quote(name))
        pictures.getresponse().read()
    ages.append(time.monotonic() - state["time_s"])
print(json.dumps({"ages_s": ages}))
"""
"""A browser as the server sees it: it receives every state and, like the page, skips pictures rather than fall behind.
The age of what it shows is the time from the sample's stamp until the last panel is there."""


_DEPTH = np.linspace(0, 1, 18 * 24, dtype=np.float32).reshape(18, 24)
_SHIFT = np.stack([_DEPTH, _DEPTH[::-1]], -1) * np.float32(0.3)
FIELDS = {"depth_mm": _DEPTH, "deformation_mm": _SHIFT, "shear_mm": _SHIFT}  # fields to show with every picture


def viewed(camera: NoiseCamera, seconds: float, browsers: int | None) -> dict[str, Any]:
    """Record a camera for some seconds, watched by so many browsers; `None` records without a page.

    States that a browser shows a second, ages of their pictures, times between two looks of the recorder at its device,
    ms, and the samples that are in the journal and those that are not.
    """
    with contextlib.ExitStack() as stack:
        home = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        reader = stack.enter_context(Reader(Replay(dataclasses.replace(camera, arrays=FIELDS))))
        journal = stack.enter_context(JournalWriter(home / "journal"))
        watching = []
        if browsers is not None:
            live = stack.enter_context(LiveView(port=0))
            stack.enter_context(Presenter([Channel(reader)], None, live).in_thread())
            host, port = live.address.removeprefix("http://").rstrip("/").split(":")
            command = [sys.executable, "-c", BROWSER, host, port, str(seconds)]
            watching = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(browsers)]
        looks, written = _record(reader, journal, seconds)
        counts = reader.counts  # before the browsers end
        ages = [json.loads(browser.communicate()[0])["ages_s"] for browser in watching]
    shown = np.array([age for each in ages for age in each])
    return {
        "watched by": "no page" if browsers is None else f"{browsers} browser" + "s" * (browsers != 1),
        "shown": len(shown) / seconds / len(ages) if ages else None,
        "age, median": _quantile_ms(shown, 0.5),
        "age, p95": _quantile_ms(shown, 0.95),
        "look, p99": _quantile_ms(looks, 0.99),
        "look, longest": _quantile_ms(looks, 1.0),
        "recorded": written,
        "lost": counts.lost,
    }


def _record(reader: Reader, journal: JournalWriter, seconds: float) -> tuple[np.ndarray, int]:
    """Write all samples into a journal, as a session does; returns times between looks and the number of samples."""
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


def frames(count: str) -> Iterator[tuple[int, int, dict[str, np.ndarray]]]:
    """An adapter for `bridge_server` in place of a vendor's SDK: pictures of noise, stamped when they are made."""
    noise = np.random.default_rng(0).integers(0, 256, BRIDGE_SHAPE, dtype=np.uint8)
    for n in range(int(count)):
        yield time.monotonic_ns(), n, {"frame_bgr": noise}


def bridged(count: int) -> dict[str, Any]:
    """Rate and age of so many pictures, read from a bridge as fast as it gives them; the first is left out."""
    config = BridgeConfig(python=sys.executable, adapter=f"{__name__}:{frames.__name__}", serial=str(count))
    stamps: list[tuple[int, int]] = []
    with config.open() as device, contextlib.suppress(DeviceLostError):  # it ends after so many
        device.read(60.0)
        while True:
            sample = device.read(60.0)
            stamps.append((sample.host_time_ns, time.monotonic_ns()))
    made, read = np.array(stamps, np.int64).T
    rate_hz, ages = (len(read) - 1) * NS_PER_S / float(read[-1] - read[0]), (read - made) / NS_PER_S
    return {
        "picture": " × ".join(map(str, BRIDGE_SHAPE)),
        "rate": rate_hz,
        "carried": rate_hz * float(np.prod(BRIDGE_SHAPE)) / 1e6,
        "age when read, median": _quantile_ms(ages, 0.5),
        "age when read, p95": _quantile_ms(ages, 0.95),
    }


def viewing_section(
    camera: NoiseCamera, seconds: float, browsers: Sequence[int], pictures: int, context: Context
) -> list[ReportPart]:
    """Recordings of some seconds that so many browsers watch in turn; so many pictures through a bridge."""
    watched = context.each("watched recordings", (None, *browsers))
    views = [viewed(camera, seconds, number) for number in watched]
    transfer, most = bridged(pictures), views[-1]
    times = dict.fromkeys(("age, median", "age, p95", "look, p99", "look, longest"), "ms")
    return [
        f"Watched by {most['watched by']}, a recording loses {most['lost']} of {most['recorded']} samples; a bridge "
        f"carries {transfer['rate']:.0f} pictures a second.",
        at_most("samples lost while watched", sum(view["lost"] for view in views), 0),
        at_most("age of what a browser shows, p95, worst", max(view["age, p95"] or 0.0 for view in views), 150, "ms"),
        at_least("pictures of 640 × 480 through a bridge", transfer["rate"], FASTEST_HZ, "Hz"),
        named_table(
            "A recording that is watched",
            views,
            formats=dict.fromkeys(times, ".1f") | {"shown": ".1f", "age, median": ".0f", "age, p95": ".0f"},
            units={"shown": "Hz"} | times,
            meanings={
                "shown": "states that one browser shows",
                "age, median": "of all panels when the last is there",
                "look, p99": "between two looks of the recorder",
            },
            note="Camera, recorder, server and browsers share the cores of the run; four panels a page.",
        ),
        named_table(
            "Pictures through a bridge",
            [transfer],
            formats=dict.fromkeys(list(transfer)[1:3], ".0f") | dict.fromkeys(list(transfer)[3:], ".1f"),
            units=dict(zip(list(transfer)[1:], ("Hz", "MB/s", "ms", "ms"), strict=True)),
            note="The adapter gives pictures as fast as they are taken, so the age is that of a full pipe.",
        ),
    ]


def _quantile_ms(seconds: np.ndarray, share: float) -> float | None:
    return 1e3 * float(np.quantile(seconds, share)) if len(seconds) else None
