"""The vendor's Tac3D recordings: what is missing in them, and how fast their messages decode."""

import dataclasses
import importlib.util
import pathlib
import struct
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from experiments.core.timing import interleaved
from sensors_io.clock import NS_PER_S, JumpingClock
from sensors_io.devices import tac3d_messages
from sensors_io.devices.intake import Counts, Intake
from sensors_io.devices.reader import Pump, ReaderConfig
from sensors_io.devices.replay import Replay
from sensors_io.devices.sources import Tac3dRecording
from sensors_io.sync import ClockMap

YAML = importlib.util.find_spec("ruamel") is not None and importlib.util.find_spec("ruamel.yaml") is not None
"""Whether the vendor's parser is installed, so that its way can be timed."""

BY_YAML = "YAML each time, as the vendor does"
_PART_BYTES = 1400  # of a packet: below the Ethernet's 1500


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordingCheck:
    """One recording, through the reader and by its arrays alone.

    Args:
      name: of the recording.
      frames: in it.
      missing, gap_s: indices that are not there, largest time between two frames; by the arrays.
      counts: of the reader.
      seen_gap_s: largest time between two samples that the reader gave.
      late_s: of arrival behind the mapped stamps, median and largest, [2]; NaN where arrival was not recorded.
    """

    name: str
    frames: int
    missing: int
    gap_s: float
    counts: Counts
    seen_gap_s: float
    late_s: np.ndarray


def check(path: pathlib.Path) -> RecordingCheck:
    """Replay a recording through a reader in compressed time, and hold its books against the arrays."""
    truth = tac3d_messages.load_recording(path)
    clock = JumpingClock()
    intake = Intake(capacity=len(truth.index) + 1, clock=clock)
    pump = Pump(Replay(Tac3dRecording(path=path), clock=clock), intake, ReaderConfig(), clock, threading.Event())
    pump.open()
    while pump.step():
        pass
    times = []
    while intake.counts.waiting:
        times.append(intake.next(0.0).device_time_ns or 0)
    present = set(truth.index.tolist())
    missing = sum(i not in present for i in range(int(truth.index[0]), int(truth.index[-1]) + 1))
    return RecordingCheck(
        name=path.stem,
        frames=len(truth.index),
        missing=missing,
        gap_s=float(np.diff(truth.send_time_s).max()),
        counts=intake.counts,
        seen_gap_s=float(np.diff(times).max()) / NS_PER_S,
        late_s=_lateness_s(truth),
    )


def _lateness_s(recording: tac3d_messages.Recording) -> np.ndarray:
    """How much later messages arrived than the running minimum says they were sent, median and largest."""
    if recording.receive_time_s is None:
        return np.full(2, np.nan)
    clock = ClockMap()
    sent, received = (np.rint(t * NS_PER_S).astype(int) for t in (recording.send_time_s, recording.receive_time_s))
    late = [host - clock.to_host_ns(int(device), int(host)) for device, host in zip(sent, received, strict=True)]
    return np.quantile(late, [0.5, 1.0]) / NS_PER_S


def message(path: pathlib.Path | None) -> list[bytes]:
    """The middle message of a recording as the vendor's program sends it, in packets; random numbers without one."""
    if path is None:
        rng = np.random.default_rng(0)
        arrays = {
            name: rng.normal(size=(400, 3)) for name in ("3D_Positions", "3D_Displacements", "3D_Normals", "3D_Forces")
        }
        arrays |= {name: rng.normal(size=(1, 3)) for name in ("3D_ResultantForce", "3D_ResultantMoment")}
        index, time_s = 10, 12.345
    else:
        recording = tac3d_messages.load_recording(path)
        k = len(recording.index) // 2
        arrays = {name: np.ascontiguousarray(a[k], np.float64) for name, a in recording.matrices.items()}
        index, time_s = int(recording.index[k]), float(recording.send_time_s[k])
    lines, offset = [], 0
    for name, a in arrays.items():
        shape = f"width: {a.shape[1]}, height: {a.shape[0]}"
        lines.append(f"  - {{name: {name}, type: mat, dtype: f64, {shape}, offset: {offset}, length: {a.nbytes}}}")
        offset += a.nbytes
    head = f'index: {index}\nSN: AD2-0065L\ntimestamp: {time_s}\nmsg: ""\ndata:\n' + "\n".join(lines) + "\n"
    data = b"".join(a.tobytes() for a in arrays.values())
    parts = [head.encode(), *(data[k : k + _PART_BYTES] for k in range(0, len(data), _PART_BYTES))]
    return [struct.pack("=IHH", 1, len(parts) - 1, k) + part for k, part in enumerate(parts)]


def decode_ms(packets: list[bytes], rounds: Iterable[object], repeats: int = 20) -> dict[str, np.ndarray]:
    """Time of one message by every way, ms [rounds]: decoding alone, from the packets, as samples, by YAML."""
    whole = _joined(packets)
    decoder = tac3d_messages.Decoder()
    calls: dict[str, Callable[[], Any]] = {
        "cached layout": lambda: decoder.decode(*whole),
        "cached layout, packets joined, schema's arrays": lambda: tac3d_messages.to_schema(
            decoder.decode(*_joined(packets)).matrices
        ),
        "layout parsed each time": lambda: tac3d_messages.Decoder().decode(*whole),
    }
    if YAML:
        calls[BY_YAML] = _by_yaml(*whole)

    def repeated(call: Callable[[], Any]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(repeats):
                call()

        return run

    ready = {name: repeated(call) for name, call in calls.items()}
    for call in ready.values():
        call()
    return {name: 1e3 * s / repeats for name, s in interleaved(ready, rounds).items()}


def _joined(packets: list[bytes]) -> tuple[bytes, bytes]:
    assembler = tac3d_messages.Assembler()
    found = [whole for packet in packets if (whole := assembler.add(packet)) is not None]
    return found[0]


def _by_yaml(layout: bytes, data: bytes) -> Callable[[], Mapping[str, np.ndarray]]:
    """The vendor's way: the whole layout through a YAML parser for every message."""
    from ruamel.yaml import YAML as Parser

    parser = Parser()

    def decode() -> Mapping[str, np.ndarray]:
        tree = parser.load(layout.decode("ascii"))
        return {
            item["name"]: np.frombuffer(data[item["offset"] : item["offset"] + item["length"]]).reshape(
                item["height"], item["width"]
            )
            for item in tree["data"]
        }

    return decode
