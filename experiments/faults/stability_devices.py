"""Is every lost sample counted, however a device fails?

    python -m experiments stability_devices [--data-dir DIR] [--scale smoke]

One hour of a 120 Hz camera in compressed time, with 2 % drops, duplicates, jitter, a clock that gains 50 ppm and three
disconnects, read through the package's reader: with the device's counter, without it (losses estimated from the stamps,
duplicates told by their pictures), and by a consumer too slow for its ring.  What the reader's books say is held
against what was injected; memory is looked at every tenth of the hour, once with Python's own traced.  Then the
vendor's Tac3D recordings in DIR/tac3d, whose real gaps must come out exactly, and the time to decode a message, cached
and by YAML where ruamel.yaml is installed.  Last, a camera at its true rate is recorded while browsers watch it, and a
bridge carries the pictures of a vendor's camera.  Two minutes on one core (`smoke` twenty seconds).  Expected: with a
counter nothing is ever unaccounted for; without one the estimate is off by one in a thousand of the losses until
stamps jitter by a quarter of the period; memory stays flat; a message decodes in a hundredth of a millisecond, hundreds
of times faster than by YAML; watching costs the recording nothing but time of the core.
"""

import dataclasses
import pathlib
import warnings
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, PALETTE, svg
from experiments.core.context import Context
from experiments.core.results import Cell, Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.faults import live_viewing as watching
from experiments.faults import live_viewing_tables as watching_tables
from experiments.faults import tac3d_recordings as vendor
from experiments.faults.replayed_camera import NoiseCamera, ReplayOutcome, endure
from sensors_io.devices.errors import OverloadWarning
from sensors_io.devices.replay import Disconnect, Faults

_MOST_GAINED_MB = 5.0  # by an hour's replay
BY_COUNTER, BY_STAMPS, SLOW = "with a counter", "without a counter", "slow consumer"


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeviceStabilityConfig:
    """Length, rate and faults of the replay; rounds of timing.

    Args:
      seconds: of device time; the disconnects lie at a quarter, a half and three quarters.
      rate_hz: of the camera.
      size_px: rows and columns of its pictures.
      drop_share, duplicate_share, jitter_s, skew: see `Faults`.
      away_s: how long each disconnect lasts.
      traced_seconds: of a shorter replay in which Python's memory is traced.
      sweep_seconds, jitter_shares: of the replays over jitter, in periods of the camera.
      rounds: of timing the decoders.
      watch_seconds: of each recording that is watched.
      browsers: that watch, in turn.
      bridge_frames: that a bridge carries.
      data_dir: holds the folder tac3d; `None` leaves the vendor's recordings out.
      seed: of the faults.
    """

    seconds: float = 3600.0
    rate_hz: float = 120.0
    size_px: tuple[int, int] = (240, 320)
    drop_share: float = 0.02
    duplicate_share: float = 0.005
    jitter_s: float = 0.001
    skew: float = 5e-5
    away_s: tuple[float, float, float] = (0.4, 3.0, 20.0)
    traced_seconds: float = 900.0
    sweep_seconds: float = 300.0
    jitter_shares: tuple[float, ...] = (0.0, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
    rounds: int = 25
    watch_seconds: float = 5.0
    browsers: tuple[int, ...] = (0, 1, 3)
    bridge_frames: int = 600
    data_dir: pathlib.Path | None = None
    seed: int = 0


def run(config: DeviceStabilityConfig, context: Context) -> Results:
    """Replay, check the vendor's recordings, time the decoders."""
    outcomes = {name: _replay(name, config, context) for name in context.each("replays", (BY_COUNTER, BY_STAMPS, SLOW))}
    short = dataclasses.replace(config, seconds=config.traced_seconds)
    faults = _faults(short, hidden=False)
    with context.progress_callback("device time with Python's memory traced, s") as tell:
        traced = endure(_source(short), short.seconds, faults, capacity=256, traced=True, tell=tell)
    sweep = over_jitter(config, context)
    paths = recordings(config.data_dir)
    checked = [vendor.check(path) for path in context.each("recordings", paths)]
    rounds = context.rounds("timing decoders", config.rounds)
    decode = vendor.decode_ms(vendor.message(paths[0] if paths else None), rounds)
    watchers = context.each("watched recordings", (None, *config.browsers))
    seen = [watching.watched(_source(config), config.watch_seconds, n) for n in watchers]
    carried = watching.bridged(config.bridge_frames)
    return Results(
        verdict=(*verdict(outcomes, checked, decode), _watched(seen, carried)),
        requirements=(
            *requirements(outcomes, traced, checked, decode),
            *watching_tables.requirements(seen, carried),
        ),
        tables=(
            _accounts(outcomes),
            *([_recorded(checked)] if checked else []),
            _decoders(decode),
            *watching_tables.tables(seen, carried),
        ),
        pictures=(_jitter_picture(sweep, config), _memory_picture(outcomes, config)),
        settings={
            "samples": round(config.seconds * config.rate_hz),
            "pictures": f"{config.size_px[0]} × {config.size_px[1]}",
            "faults": f"{config.drop_share:.1%} drops, {config.duplicate_share:.1%} duplicates, jitter "
            f"{1e3 * config.jitter_s:g} ms, {1e6 * config.skew:g} ppm, away {config.away_s} s",
            "vendor's recordings": ", ".join(c.name for c in checked) or "no --data-dir",
            "vendor's parser installed": vendor.YAML,
        },
        data={name: o.wrong for name, o in outcomes.items()},
    )


def recordings(data_dir: pathlib.Path | None) -> list[pathlib.Path]:
    """The vendor's recordings below a directory.

    Raises:
      FileNotFoundError: a directory without any.
    """
    if data_dir is None:
        return []
    found = sorted((data_dir / "tac3d").glob("*.npz"))
    if not found:
        raise FileNotFoundError(
            f"data_dir is {data_dir}: must hold tac3d/*.npz; give another directory or leave it out"
        )
    return found


def over_jitter(config: DeviceStabilityConfig, context: Context) -> dict[str, np.ndarray]:
    """Share of the losses by which the count is off, with a counter and without one, for every jitter, [J] each."""
    short = dataclasses.replace(config, seconds=config.sweep_seconds)
    found: dict[str, list[float]] = {BY_COUNTER: [], BY_STAMPS: []}
    for share in context.each("jitter", config.jitter_shares):
        jittery = dataclasses.replace(short, jitter_s=share / config.rate_hz)
        for name, values in found.items():
            o = endure(_source(short), short.seconds, _faults(jittery, hidden=name == BY_STAMPS), capacity=256)
            values.append(abs(o.wrong["missing"]) / max(1, o.truth.dropped + o.truth.away))
    return {name: np.array(values) for name, values in found.items()}


def requirements(
    outcomes: Mapping[str, ReplayOutcome],
    traced: ReplayOutcome,
    checked: Sequence[vendor.RecordingCheck],
    decode: Mapping[str, np.ndarray],
) -> tuple[Requirement, ...]:
    """The figures that must be kept."""
    exact = sum(abs(n) for name in (BY_COUNTER, SLOW) for n in outcomes[name].wrong.values())
    memory = outcomes[BY_COUNTER].memory_mb
    kept = [
        _most("losses, duplicates, disconnects not counted", exact, 0),
        _most("samples unaccounted for", sum(o.counts.unaccounted for o in outcomes.values()), 0),
        _most("memory gained from the first tenth to the last", float(memory[-1] - memory[1]), _MOST_GAINED_MB, "MB"),
        _most("Python's memory gained, traced", traced.traced_growth_kb, 100, "kB"),
        _most("Tac3D message decoded", float(np.median(decode["cached layout"])), 0.05, "ms"),
    ]
    if checked:
        off = sum(abs(c.missing - c.counts.missing) for c in checked)
        gap = max(abs(c.gap_s - c.seen_gap_s) for c in checked)
        kept += [
            _most("Tac3D recordings: missing indices not counted", off, 0),
            _most("Tac3D recordings: largest gap off by", 1e3 * gap, 0.001, "ms"),
        ]
    return tuple(kept)


def verdict(
    outcomes: Mapping[str, ReplayOutcome], checked: Sequence[vendor.RecordingCheck], decode: Mapping[str, np.ndarray]
) -> tuple[str, ...]:
    """The answer in sentences."""
    counter, stamps, slow = (outcomes[name] for name in (BY_COUNTER, BY_STAMPS, SLOW))
    truth = counter.truth
    lost = truth.dropped + truth.away
    off, fast = stamps.wrong, np.median(decode["cached layout"])
    said = [
        f"With a counter the books are exact: of {truth.produced} samples {truth.dropped} dropped, {truth.away} "
        f"produced while away, {truth.duplicated} twice; {sum(map(abs, counter.wrong.values()))} wrongly counted.",
        f"Without one the {stamps.truth.dropped + stamps.truth.away} losses are estimated {off['missing']:+d} off "
        f"({abs(off['missing']) / max(1, lost):.2%}) and duplicates {off['duplicates']:+d}.",
        f"A consumer too slow for its ring loses {slow.counts.overwritten} samples, all of them counted.",
        f"A Tac3D message decodes in {fast:.4f} ms"
        + (
            f", {np.median(decode[vendor.BY_YAML]) / fast:.0f} times faster than by YAML."
            if vendor.YAML
            else "; the vendor's parser is not installed."
        ),
    ]
    said += [
        f"{c.name}: {c.counts.missing} of {c.frames + c.missing} indices are missing, the largest gap is "
        f"{1e3 * c.seen_gap_s:.0f} ms."
        for c in checked
    ]
    return tuple(said)


def _watched(seen: Sequence[watching.ViewedRecording], carried: watching.BridgeTransfer) -> str:
    most = seen[-1]
    age = 1e3 * float(np.median(most.ages_s))
    return (
        f"Watched by {most.name}, a recording at full rate loses {most.lost} of {most.written} samples; each sees "
        f"{most.shown_hz:.0f} states a second, {age:.0f} ms old.  A bridge carries {carried.rate_hz:.0f} pictures of "
        "640 × 480 a second."
    )


def _replay(name: str, config: DeviceStabilityConfig, context: Context) -> ReplayOutcome:
    capacity, every = (16, 24) if name == SLOW else (256, 1)
    faults = _faults(config, hidden=name == BY_STAMPS)
    shown = context.progress_callback(f"device time {name}, s")
    with context.timed(name.replace(" ", "_")), shown as tell, warnings.catch_warnings():
        warnings.simplefilter("ignore", OverloadWarning)  # meant, and counted
        return endure(_source(config), config.seconds, faults, capacity=capacity, every=every, tell=tell)


def _source(config: DeviceStabilityConfig) -> NoiseCamera:
    return NoiseCamera(rate_hz=config.rate_hz, size_px=config.size_px)


def _faults(config: DeviceStabilityConfig, *, hidden: bool) -> Faults:
    at = [config.seconds * share for share in (0.25, 0.5, 0.75)]
    scale = min(1.0, config.seconds / 200)  # so that a shrunken run is not away most of its time
    return Faults(
        drop_share=config.drop_share,
        duplicate_share=config.duplicate_share,
        jitter_s=config.jitter_s,
        skew=config.skew,
        disconnects=tuple(Disconnect(at_s=a, for_s=scale * f) for a, f in zip(at, config.away_s, strict=True)),
        hide_counter=hidden,
        hide_clock=hidden,
        seed=config.seed,
    )


def _most(name: str, measured: float, bound: float, unit: str = "") -> Requirement:
    return Requirement(name=name, measured=float(measured), bound=bound, better="lower", unit=unit)


def _accounts(outcomes: Mapping[str, ReplayOutcome]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, o in outcomes.items():
        t, c = o.truth, o.counts
        late = 1e3 * o.late_s
        rows.append(
            (
                name, t.produced, t.dropped, t.away, c.missing, o.wrong["missing"], t.duplicated, o.wrong["duplicates"],
                t.disconnects, c.reconnects, c.overwritten, c.unaccounted, float(late[0]), float(late[1]),
            )
        )  # fmt: skip
    heads = (
        "replay", "produced", "dropped", "away", "counted missing", "off by", "twice", "twice, off by", "disconnects",
        "reconnects", "overwritten", "unaccounted", "late, median", "late, p99",
    )  # fmt: skip
    return Table(
        title="The books against what was injected",
        columns=tuple(
            Column(name=h, unit="ms" if h.startswith("late") else "", format=".2f" if h.startswith("late") else "d")
            for h in heads
        ),
        rows=tuple(rows),
        note="Losses before the first sample and after the last are left out: nobody can see them.  Late: stamps "
        "behind the device's true time; by running minimum where it tells its clock, else as they arrived.",
    )


def _recorded(checked: Sequence[vendor.RecordingCheck]) -> Table:
    return Table(
        title="The vendor's Tac3D recordings",
        columns=(
            Column(name="recording"),
            Column(name="frames", format="d"),
            Column(name="missing", format="d", meaning="by the arrays"),
            Column(name="counted", format="d", meaning="by the reader"),
            Column(name="largest gap", unit="ms", format=".3f"),
            Column(name="as seen", unit="ms", format=".3f"),
            Column(name="late, median", unit="ms", format=".1f", meaning="arrival behind the running minimum's stamp"),
            Column(name="late, worst", unit="ms", format=".1f"),
        ),
        rows=tuple(_recording_row(c) for c in checked),
    )


def _recording_row(c: vendor.RecordingCheck) -> tuple[Cell, ...]:
    late = [None if np.isnan(s) else 1e3 * float(s) for s in c.late_s]
    return (c.name, c.frames, c.missing, c.counts.missing, 1e3 * c.gap_s, 1e3 * c.seen_gap_s, *late)


def _decoders(decode: Mapping[str, np.ndarray]) -> Table:
    fast = float(np.median(decode["cached layout"]))
    return Table(
        title="Time to decode one Tac3D message",
        columns=(
            Column(name="way"),
            Column(name="median", unit="ms", format=".4f"),
            Column(name="p95", unit="ms", format=".4f"),
            Column(name="against cached", format=".1f"),
        ),
        rows=tuple(
            (name, float(np.median(ms)), float(np.quantile(ms, 0.95)), float(np.median(ms)) / fast)
            for name, ms in decode.items()
        ),
    )


def _jitter_picture(sweep: Mapping[str, np.ndarray], config: DeviceStabilityConfig) -> Picture:
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.6, 3.2), layout="constrained")
        axes = figure.subplots()
        for (name, off), colour in zip(sweep.items(), PALETTE, strict=False):
            axes.plot(config.jitter_shares, 100 * off, "o-", color=colour, ms=4, lw=1.3, label=name)
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set(
            xlabel="mean jitter of arrival, periods of the camera", ylabel="losses miscounted, %", ylim=(-0.01, None)
        )
        axes.legend(loc="best")
        content = svg(figure)
    caption = "Losses are counted exactly with a counter whatever the delays; stamps alone tell them while delays stay "
    caption += "well below half a period. The axis is linear up to 0.1 %."
    return Picture(name="jitter", title="Where counting without a counter breaks", caption=caption, content=content)


def _memory_picture(outcomes: Mapping[str, ReplayOutcome], config: DeviceStabilityConfig) -> Picture:
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.6, 3.2), layout="constrained")
        axes = figure.subplots()
        for (name, o), colour in zip(outcomes.items(), PALETTE, strict=False):
            minutes = np.linspace(0, config.seconds / 60, len(o.memory_mb))
            axes.plot(minutes, o.memory_mb - o.memory_mb[0], "o-", color=colour, ms=3, lw=1.3, label=name)
        axes.axhline(_MOST_GAINED_MB, color="black", lw=0.8, ls=":")
        axes.set(xlabel="device time, minutes", ylabel="resident memory gained, MB", ylim=(-1, 1.2 * _MOST_GAINED_MB))
        axes.legend(loc="center right")
        content = svg(figure)
    start = ", ".join(f"{o.memory_mb[0]:.0f}" for o in outcomes.values())
    caption = "Memory of the process since each replay began, one after the other in the same process (at the start "
    caption += f"{start} MB); dotted, what may be gained."
    return Picture(name="memory", title="Memory stays flat", caption=caption, content=content)


DEFAULT = DeviceStabilityConfig()
SMOKE = DeviceStabilityConfig(
    seconds=60.0,
    size_px=(24, 32),
    traced_seconds=20.0,
    sweep_seconds=10.0,
    rounds=5,
    watch_seconds=1.0,
    bridge_frames=100,
)

EXPERIMENT = Experiment(name="stability_devices", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
