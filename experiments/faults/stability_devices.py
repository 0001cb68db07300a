"""Is every lost sample counted, however a device fails?

    python -m experiments stability_devices [--data-dir DIR] [--scale smoke]

The package's reader reads one hour of a 120 Hz camera in compressed time, with drops, duplicates, jitter, a clock that
gains and three disconnects: with the device's counter, without it (losses are then estimated from timestamps), and with
a consumer too slow for its ring buffer.  In the vendor's Tac3D recordings in DIR/tac3d the real gaps must be counted
exactly, and the time to decode a message is measured, also by YAML if ruamel.yaml is installed.  Finally, a camera at
its true rate is recorded while browsers display it, and a bridge transfers a vendor's pictures.

Two minutes on one core (`smoke` twenty seconds).  Expected: with a counter every sample is accounted for; without one
the estimate is off by one in a thousand of the losses until stamps jitter by a quarter of the period; memory stays
flat; a message decodes in a hundredth of a millisecond, hundreds of times faster than by YAML; browsers cost the
recording nothing but processor time.
"""

import dataclasses
import pathlib
import warnings
from collections.abc import Mapping

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.context import Context
from experiments.core.results import Picture, ReportPart, Results, assemble, at_most, named_table
from experiments.core.runner import Experiment
from experiments.core.text import plain
from experiments.faults import live_viewing as viewing
from experiments.faults import tac3d_recordings as tac3d
from experiments.faults.replayed_camera import NoiseCamera, ReplayOutcome, replay_camera
from sensors_io.devices.errors import OverloadWarning
from sensors_io.devices.replay import Disconnect, Faults

BY_COUNTER, BY_STAMPS, SLOW = "with a counter", "without a counter", "slow consumer"

MOST_GAINED_MB = 5.0  # resident memory that an hour's replay may gain

RATE_HZ = 120.0
FAULTS = Faults(drop_share=0.02, duplicate_share=0.005, jitter_s=0.001, skew=5e-5, seed=0)
AWAY_S = {0.25: 0.4, 0.5: 3.0, 0.75: 20.0}
"""Share of the replay at which the device is disconnected → duration; shorter replays scale the durations."""

JITTER_SHARES = (0.0, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0)  # mean jitters of the sweep, in periods of the camera


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeviceStabilityConfig:
    """Seconds of device time of the replays, rows and columns of pictures, sizes of the other measurements.

    `browsers` watch in turn, `bridge_frames` are carried by a bridge; `data_dir` holds the folder tac3d, if any.
    """

    seconds: float = 3600.0
    size_px: tuple[int, int] = (240, 320)
    traced_seconds: float = 900.0
    sweep_seconds: float = 300.0
    rounds: int = 25
    watch_seconds: float = 5.0
    browsers: tuple[int, ...] = (0, 1, 3)
    bridge_frames: int = 600
    data_dir: pathlib.Path | None = None


def run(config: DeviceStabilityConfig, context: Context) -> Results:
    """Replay the camera, check the vendor's recordings, time the decoders, watch a recording."""
    camera = NoiseCamera(rate_hz=RATE_HZ, size_px=config.size_px)
    outcomes = {
        name: replay_whole(name, camera, config.seconds, context)
        for name in context.each("replays", (BY_COUNTER, BY_STAMPS, SLOW))
    }
    faults = injected(config.traced_seconds)
    with context.progress_callback("device time with Python's memory traced, s") as report:
        traced = replay_camera(camera, config.traced_seconds, faults, capacity=256, traced=True, report=report)
    parts = [
        *replay_section(outcomes, traced, over_jitter(camera, config.sweep_seconds, context)),
        *tac3d.recording_section(config.data_dir, config.rounds, context),
        *viewing.viewing_section(camera, config.watch_seconds, config.browsers, config.bridge_frames, context),
    ]
    settings = {
        "samples": round(config.seconds * RATE_HZ),
        "pictures": f"{config.size_px[0]} × {config.size_px[1]}",
        "faults": f"{100 * FAULTS.drop_share:g} % drops, {100 * FAULTS.duplicate_share:g} % duplicates, "
        f"jitter {1e3 * FAULTS.jitter_s:g} ms, clock {1e6 * FAULTS.skew:g} ppm fast, "
        f"away {plain(list(AWAY_S.values()))} s",
        "vendor's recordings": ", ".join(path.stem for path in tac3d.recordings(config.data_dir)) or "no --data-dir",
        "vendor's parser installed": tac3d.YAML,
    }
    return assemble(parts, settings, {name: o.wrong for name, o in outcomes.items()})


def replay_whole(name: str, camera: NoiseCamera, seconds: float, context: Context) -> ReplayOutcome:
    """One of the long replays by name."""
    capacity, every = (16, 24) if name == SLOW else (256, 1)
    faults = injected(seconds, hidden=name == BY_STAMPS)
    progress = context.progress_callback(f"device time {name}, s")
    with context.timed(name), progress as report, warnings.catch_warnings():
        warnings.simplefilter("ignore", OverloadWarning)  # intended, and counted
        return replay_camera(camera, seconds, faults, capacity=capacity, every=every, report=report)


def injected(seconds: float, *, hidden: bool = False, jitter_s: float = FAULTS.jitter_s) -> Faults:
    """The faults of a replay; hidden, the device gives neither counter nor clock."""
    scale = min(1.0, seconds / 200)  # so that a shrunken run is not away most of its time
    away = tuple(Disconnect(at_s=seconds * share, for_s=scale * for_s) for share, for_s in AWAY_S.items())
    return dataclasses.replace(FAULTS, jitter_s=jitter_s, disconnects=away, hide_counter=hidden, hide_clock=hidden)


def over_jitter(camera: NoiseCamera, seconds: float, context: Context) -> dict[str, np.ndarray]:
    """Error of the count of losses as a share of the losses, with a counter and without one, by jitter, [J] each."""
    found: dict[str, list[float]] = {BY_COUNTER: [], BY_STAMPS: []}
    for share in context.each("jitter", JITTER_SHARES):
        for name, values in found.items():
            faults = injected(seconds, hidden=name == BY_STAMPS, jitter_s=share / RATE_HZ)
            o = replay_camera(camera, seconds, faults, capacity=256)
            values.append(abs(o.wrong["missing"]) / max(1, o.truth.dropped + o.truth.away))
    return {name: np.array(values) for name, values in found.items()}


def replay_section(
    outcomes: Mapping[str, ReplayOutcome], traced: ReplayOutcome, sweep: Mapping[str, np.ndarray]
) -> list[ReportPart]:
    """Lost samples that were counted and injected, memory, and where counting without a counter breaks."""
    counter, stamps, slow = (outcomes[name] for name in (BY_COUNTER, BY_STAMPS, SLOW))
    missing, losses = stamps.wrong["missing"], stamps.truth.dropped + stamps.truth.away
    exact = sum(abs(n) for one in (counter, slow) for n in one.wrong.values())
    late = ("late, median", "late, p99")
    rows = [
        {
            "replay": name, "produced": o.truth.produced, "dropped": o.truth.dropped, "away": o.truth.away,
            "counted missing": o.counts.missing, "off by": o.wrong["missing"], "twice": o.truth.duplicated,
            "twice, off by": o.wrong["duplicates"], "disconnects": o.truth.disconnects,
            "reconnects": o.counts.reconnects, "overwritten": o.counts.overwritten,
            "unaccounted": o.counts.unaccounted, "late, median": 1e3 * float(o.late_s[0]),
            "late, p99": 1e3 * float(o.late_s[1]),
        }
        for name, o in outcomes.items()
    ]  # fmt: skip
    return [
        f"Of {counter.truth.produced} samples {sum(map(abs, counter.wrong.values()))} are wrongly counted with a "
        f"counter; without one the {losses} losses are estimated {missing:+d} off; a consumer too slow for its ring "
        f"loses {slow.counts.overwritten} samples, all of them counted.",
        at_most("losses, duplicates, disconnects not counted", exact, 0),
        at_most("samples unaccounted for", sum(o.counts.unaccounted for o in outcomes.values()), 0),
        at_most("memory gained from the first tenth to the last", counter.gained_mb, MOST_GAINED_MB, "MB"),
        at_most("Python's memory gained, traced", traced.gained_kb, 100, "kB"),
        named_table(
            "Counted and injected losses",
            rows,
            formats=dict.fromkeys(late, ".2f"),
            units=dict.fromkeys(late, "ms"),
            note="Losses before the first sample and after the last are left out, for they cannot be noticed. Late: "
            "time from when a sample was taken to its stamp, which is that of its arrival where the device gives no "
            "clock.",
        ),
        jitter_picture(sweep),
    ]


def jitter_picture(sweep: Mapping[str, np.ndarray]) -> Picture:
    """Error of the count of losses over jitter."""
    panel = Panel(
        [Series(name, x=JITTER_SHARES, y=100 * off, marker="o") for name, off in sweep.items()],
        x_label="mean jitter of arrival, periods of the camera",
        y_label="losses miscounted, %",
        y_scale="symlog",
        y_limits=(-0.01, None),
        linear_to=0.1,
    )
    return Picture(
        name="jitter",
        title="Where counting without a counter breaks",
        caption="With a counter losses are counted exactly whatever the delays; stamps alone give the number while "
        "delays stay well below half a period. The axis is linear up to 0.1 %.",
        content=draw([panel], size=(6.6, 3.4)),
    )


DEFAULT = DeviceStabilityConfig()
SMOKE = DeviceStabilityConfig(
    seconds=60.0, size_px=(24, 32), traced_seconds=20.0, sweep_seconds=10.0, rounds=5, watch_seconds=1.0,
    bridge_frames=100,
)  # fmt: skip

EXPERIMENT = Experiment(name="stability_devices", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
