"""What it changes, and costs, to let the gel's sideways motion under pressure meet friction.

Pressure alone moves the surface of the gel sideways, and that of the object by another amount.  Where both stick,
friction takes up the difference; the generator leaves that out unless its scenes are `coupled`.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array

from experiments.core.results import Cell, Column, Table
from experiments.core.timing import interleaved
from experiments.mechanics import tangential_scenes
from experiments.mechanics.tangential_scenes import FrictionKernels, FrictionSequence
from sensors_io.scenes import drag, traction
from sensors_io.scenes.sensors import BODY, SensorModel
from sensors_io.scenes.traction import in_series

MOTIONS = ("hold", "slide_x", "twist")
"""A press that is held and released, which has no friction at all without coupling, and two that have."""

_ROUNDS = 3  # of timing; the ratio is told to a tenth
_MICROMETRES = 1e3


@dataclasses.dataclass(frozen=True, kw_only=True)
class CouplingEffect:
    """What coupling does to one motion on one gel, over all bodies.

    `relative` is the change of the markers' sideways displacement, L₂ over the sequence, relative to it without;
    `rms_mm` the same per pixel; `noise_mm` that of a node of the sensor's field; `force` the greatest change of the
    tangential force over μF; `ms` and `coupled_ms` the time of friction a frame; `failed` the share of frames that the
    coupled solver does not finish.
    """

    motion: str
    sensor: str
    relative: float
    rms_mm: float
    noise_mm: float
    force: float
    ms: float
    coupled_ms: float
    failed: float


def measure(sensor: SensorModel, grid: int, frames: int, bodies: int, seed: int) -> list[CouplingEffect]:
    """Every motion of `MOTIONS` on the gel of one sensor with markers, by `bodies` objects, of every kind in turn."""
    kernels = tangential_scenes.friction_kernels(sensor, grid)
    size, spacing = kernels.normal_gel.shape[0], sensor.window_mm / grid
    gel, body = (traction.make_coupling(layer, size, spacing) for layer in (sensor.gel, BODY))
    kinds = tangential_scenes.KINDS
    rng = np.random.default_rng([seed, 2])
    objects = [tangential_scenes.draw(rng, kinds[i % len(kinds)]) for i in range(bodies)]
    found = []
    for name in MOTIONS:
        motions = [tangential_scenes.make_motion(kernels, each, name, frames) for each in objects]
        found.append(_change(name, sensor, kernels, motions, [gel - body / m.modulus_mpa for m in motions]))
    return found


def change_table(changes: Sequence[CouplingEffect]) -> Table:
    """All motions on all gels."""
    rows: list[tuple[Cell, ...]] = [
        (
            f"{c.motion}, {c.sensor}",
            100 * c.relative,
            _MICROMETRES * c.rms_mm,
            _MICROMETRES * c.noise_mm,
            100 * c.force,
            None if c.motion == "hold" else c.ms,
            c.coupled_ms,
            100 * c.failed,
        )
        for c in changes
    ]
    return Table(
        title="What coupling changes, and costs",
        columns=(
            Column(name="motion, sensor"),
            Column(name="markers", unit="%", format=".1f", meaning="change of their sideways displacement, relative"),
            Column(name="by", unit="µm", format=".1f", meaning="the same, rms over pixels and frames"),
            Column(name="noise", unit="µm", format=".0f", meaning="of one node of the sensor's field"),
            Column(name="force", unit="% of μF", format=".1f", meaning="greatest change of the tangential force"),
            Column(name="time without", unit="ms", format=".2f", meaning="friction, a frame; a press has none"),
            Column(name="time with", unit="ms", format=".2f", meaning="friction, a frame"),
            Column(name="not converged", unit="%", format=".1f", meaning="frames, with coupling"),
        ),
        rows=tuple(rows),
        note="Of sensors with markers, means over bodies of every kind.  Coupled presses pay for friction in full.",
    )


def verdict(changes: Sequence[CouplingEffect]) -> str:
    """Which default is right, in a sentence."""
    press, moved = ([c for c in changes if (c.motion == "hold") is still] for still in (True, False))
    hidden = max(c.rms_mm / c.noise_mm for c in changes)
    return (
        f"Coupling changes the markers' sideways displacement by {_mean(press):.0%} in a press and {_mean(moved):.0%} "
        f"in a motion, at most {hidden:.1f} of a node's noise; it costs a press "
        f"{float(np.mean([c.coupled_ms for c in press])):.1f} ms a frame that it did not need, a motion "
        f"{float(np.mean([c.coupled_ms / c.ms for c in moved])):.1f} × its friction."
    )


def _mean(changes: Sequence[CouplingEffect]) -> float:
    return float(np.mean([c.relative for c in changes]))


def _change(
    name: str,
    sensor: SensorModel,
    kernels: FrictionKernels,
    motions: Sequence[FrictionSequence],
    couplings: Sequence[Array],
) -> CouplingEffect:
    calls = {
        "without": lambda: [_frames(motion, kernels, None) for motion in motions],
        "with": lambda: [_frames(motion, kernels, each) for motion, each in zip(motions, couplings, strict=True)],
    }
    without, coupled = (jax.device_get(call()) for call in calls.values())
    seconds = interleaved(calls, range(_ROUNDS))
    count = len(motions) * len(motions[0].pressure_mpa)
    ms = {key: 1e3 * float(np.median(s)) / count for key, s in seconds.items()}
    before, after = (np.stack([f.displacement_mm[:, :2] for f in found]) for found in (without, coupled))
    return CouplingEffect(
        motion=name,
        sensor=sensor.name,
        relative=float(np.linalg.norm(after - before) / np.linalg.norm(before)),
        rms_mm=float(np.sqrt(np.mean(np.sum((after - before) ** 2, 2)))),
        noise_mm=sensor.lateral_noise_mm,
        force=max(map(_force_change, without, coupled, motions)),
        ms=ms["without"],
        coupled_ms=ms["with"],
        failed=float(np.mean([~f.converged for f in coupled])),
    )


def _force_change(without: drag.Frame, coupled: drag.Frame, motion: FrictionSequence) -> float:
    off = np.linalg.norm(coupled.force_n[:, :2] - without.force_n[:, :2], axis=1)
    limit = float(motion.friction) * np.abs(without.force_n[:, 2]).max()
    return float(off.max() / limit)


@jax.jit
def _frames(motion: FrictionSequence, kernels: FrictionKernels, coupling: Array | None) -> drag.Frame:
    """A sequence as the generator makes it, coupled or not."""
    series = in_series(kernels.gel, kernels.body, 1.0, motion.modulus_mpa)
    bodies = drag.Bodies(compliance=series, coupling=coupling, response=kernels.markers)

    def go_on(history: drag.History, frame: tuple[Array, drag.Step]) -> tuple[drag.History, drag.Frame]:
        pressure, step = frame
        return drag.advance(history, pressure, motion.friction, step, bodies, kernels.x_mm)

    start = drag.at_rest(kernels.x_mm.shape[0])
    solved: drag.Frame = jax.lax.scan(go_on, start, (motion.pressure_mpa, motion.step))[1]
    return solved
