"""The vendor's Tac3D recordings: the gaps that the reader counts in them, and the time to decode their messages."""

import functools
import importlib.util
import pathlib
import struct
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from experiments.core.context import Context
from experiments.core.results import ReportPart, at_most, named_table
from experiments.core.timing import interleaved
from sensors_io.clock import NS_PER_S, JumpingClock
from sensors_io.devices import tac3d_messages
from sensors_io.devices.intake import Intake
from sensors_io.devices.reader import Pump, ReaderConfig
from sensors_io.devices.replay import Replay
from sensors_io.devices.sources import Tac3dRecording
from sensors_io.sync import ClockMap

YAML = importlib.util.find_spec("ruamel") is not None and importlib.util.find_spec("ruamel.yaml") is not None
"""True if the vendor's parser is installed and can be timed."""

CACHED, BY_YAML = "cached layout", "YAML each time, as the vendor does"

_PART_BYTES = 1400  # of a packet: below the Ethernet's 1500
_REPEATS = 20  # decodings in a round of timing


def recordings(data_dir: pathlib.Path | None) -> list[pathlib.Path]:
    """The vendor's recordings below a directory, which must hold some."""
    if data_dir is None:
        return []
    found = sorted((data_dir / "tac3d").glob("*.npz"))
    if not found:
        raise FileNotFoundError(
            f"data_dir is {data_dir}: must hold tac3d/*.npz; give another directory or leave it out"
        )
    return found


def check(path: pathlib.Path) -> dict[str, Any]:
    """Replay a recording through a reader in compressed time, and count its gaps, in ms, by its arrays too.

    It is late by the time of arrival after the mapped stamp, `None` where arrival was not recorded.
    """
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
    late_ms = [None if np.isnan(late) else 1e3 * float(late) for late in _lateness_s(truth)]
    return {
        "recording": path.stem,
        "frames": len(truth.index),
        "missing": sum(i not in present for i in range(int(truth.index[0]), int(truth.index[-1]) + 1)),
        "counted": intake.counts.missing,
        "largest gap": 1e3 * float(np.diff(truth.send_time_s).max()),
        "as seen": 1e3 * float(np.diff(times).max()) / NS_PER_S,
        "late, median": late_ms[0],
        "late, worst": late_ms[1],
    }


def _lateness_s(recording: tac3d_messages.Tac3dArrays) -> np.ndarray:
    """Time of arrival after the stamp by running minimum, median and largest."""
    if recording.receive_time_s is None:
        return np.full(2, np.nan)
    clock = ClockMap()
    sent, received = (np.rint(t * NS_PER_S).astype(int) for t in (recording.send_time_s, recording.receive_time_s))
    late = [host - clock.to_host_ns(int(device), int(host)) for device, host in zip(sent, received, strict=True)]
    return np.quantile(late, [0.5, 1.0]) / NS_PER_S


def message(path: pathlib.Path | None) -> list[bytes]:
    """Packets of the middle message of a recording as the vendor's program sends it; of random numbers without one."""
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


def decode_ms(packets: list[bytes], rounds: Iterable[object]) -> dict[str, np.ndarray]:
    """Milliseconds to decode one message by every method, [rounds]."""
    layout, data = _joined(packets)
    decoder = tac3d_messages.Tac3dDecoder()
    whole = lambda: tac3d_messages.to_schema(decoder.decode(*_joined(packets)).matrices)
    calls: dict[str, Callable[[], Any]] = {
        CACHED: lambda: decoder.decode(layout, data),
        f"{CACHED}, packets joined, schema's arrays": whole,
        "layout parsed each time": lambda: tac3d_messages.Tac3dDecoder().decode(layout, data),
    }
    if YAML:
        calls[BY_YAML] = functools.partial(_decode_by_yaml, layout, data)
    repeated = lambda call: [call() for _ in range(_REPEATS)]
    ready = {name: functools.partial(repeated, call) for name, call in calls.items()}
    for call in ready.values():
        call()
    return {name: 1e3 * s / _REPEATS for name, s in interleaved(ready, rounds).items()}


def _joined(packets: list[bytes]) -> tuple[bytes, bytes]:
    assembler = tac3d_messages.Assembler()
    found = [whole for packet in packets if (whole := assembler.add(packet)) is not None]
    return found[0]


@functools.cache
def _yaml_parser() -> Any:
    from ruamel.yaml import YAML as Parser

    return Parser()


def _decode_by_yaml(layout: bytes, data: bytes) -> Mapping[str, np.ndarray]:
    """The vendor's method: the whole layout through a YAML parser for every message."""
    arrays = {}
    for item in _yaml_parser().load(layout.decode("ascii"))["data"]:
        content = data[item["offset"] : item["offset"] + item["length"]]
        arrays[item["name"]] = np.frombuffer(content).reshape(item["height"], item["width"])
    return arrays


def recording_section(data_dir: pathlib.Path | None, rounds: int, context: Context) -> list[ReportPart]:
    """Time of a message by every method; gaps and lateness of the vendor's recordings, where they are given."""
    paths = recordings(data_dir)
    checks = [check(path) for path in context.each("recordings", paths)]
    decode = decode_ms(message(paths[0] if paths else None), context.rounds("timing decoders", rounds))
    cached = float(np.median(decode[CACHED]))
    parts: list[ReportPart] = [
        f"A Tac3D message decodes in {cached:.4f} ms.",
        at_most("Tac3D message decoded", cached, 0.05, "ms"),
    ]
    if checks:
        off = sum(abs(row["missing"] - row["counted"]) for row in checks)
        gap_ms = max(abs(row["largest gap"] - row["as seen"]) for row in checks)
        gaps, lates = ("largest gap", "as seen"), ("late, median", "late, worst")
        parts += [
            at_most("Tac3D recordings: missing indices not counted", off, 0),
            at_most("Tac3D recordings: largest gap off by", gap_ms, 0.001, "ms"),
            named_table(
                "The vendor's Tac3D recordings",
                checks,
                formats=dict.fromkeys(gaps, ".3f") | dict.fromkeys(lates, ".1f"),
                units=dict.fromkeys([*gaps, *lates], "ms"),
                meanings={
                    "missing": "by the arrays",
                    "counted": "by the reader",
                    "late, median": "arrival after the stamp by running minimum",
                },
            ),
        ]
    rows = [
        {"method": name, "median": m, "p95": float(np.quantile(ms, 0.95)), "against cached": m / cached}
        for name, ms in decode.items()
        if (m := float(np.median(ms)))
    ]
    formats, units = {"median": ".4f", "p95": ".4f", "against cached": ".1f"}, {"median": "ms", "p95": "ms"}
    return [*parts, named_table("Time to decode one Tac3D message", rows, formats=formats, units=units)]
