"""Effect and cost of coupling friction to the sideways motion of the gel under pressure.

Pressure alone moves the surface of the gel sideways, and that of the object by another amount.  Where both stick,
friction takes up the difference; the generator leaves that out unless its scenes are `coupled`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from experiments.core.results import Table, named_table
from experiments.core.timing import interleaved
from experiments.mechanics import tangential_scenes
from experiments.mechanics.tangential_scenes import FrictionKernels, FrictionSequence
from sensors_io.scenes import drag, traction
from sensors_io.scenes.sensors import BODY, SensorModel
from sensors_io.scenes.traction import in_series

MOTIONS = ("hold", "slide_x", "twist")
"""A press that is held and released, which has no friction at all without coupling, and two that have."""

_ROUNDS = 3  # of timing; the ratio is reported to a tenth
_MICROMETRES = 1e3


def measure(sensor: SensorModel, grid: int, frames: int, bodies: int, seed: int) -> list[dict[str, Any]]:
    """Rows of `effect_table`: every motion on the gel of one sensor, over `bodies` objects of every kind in turn."""
    kernels = tangential_scenes.friction_kernels(sensor, grid)
    size, spacing = kernels.normal_gel.shape[0], sensor.window_mm / grid
    gel, body = (traction.make_coupling(layer, size, spacing) for layer in (sensor.gel, BODY))
    kinds = tangential_scenes.KINDS
    rng = np.random.default_rng([seed, 2])
    objects = [tangential_scenes.draw(rng, kinds[i % len(kinds)]) for i in range(bodies)]
    rows = []
    for name in MOTIONS:
        motions = [tangential_scenes.make_motion(kernels, each, name, frames) for each in objects]
        rows.append(_effect(name, sensor, kernels, motions, [gel - body / m.modulus_mpa for m in motions]))
    return rows


def effect_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Effect and cost of coupling for all motions on all gels."""
    return named_table(
        "What coupling changes, and costs",
        rows,
        formats={
            **dict.fromkeys(("markers", "by", "force", "not converged"), ".1f"),
            "noise": ".0f",
            **dict.fromkeys(("time without", "time with"), ".2f"),
        },
        units={
            "markers": "%",
            "by": "µm",
            "noise": "µm",
            "force": "% of μF",
            "time without": "ms",
            "time with": "ms",
            "not converged": "%",
        },
        meanings={
            "markers": "change of their sideways displacement, relative",
            "by": "the same, rms over pixels and frames",
            "noise": "of one node of the sensor's field",
            "force": "greatest change of the tangential force",
            "time without": "friction, a frame; a press has none",
            "time with": "friction, a frame",
            "not converged": "frames, with coupling",
        },
        note="Of sensors with markers, means over bodies of every kind.  Coupled presses pay for friction in full.",
    )


def verdict(rows: Sequence[Mapping[str, Any]]) -> str:
    """Effect and cost of coupling in a sentence."""
    press, moved = ([row for row in rows if (row["time without"] is None) is still] for still in (True, False))
    mean = lambda rows: float(np.mean([row["markers"] / 100 for row in rows]))
    return (
        f"Coupling changes the markers' sideways displacement by {mean(press):.0%} in a press and {mean(moved):.0%} "
        f"in a motion, at most {max(row['by'] / row['noise'] for row in rows):.1f} of a node's noise; it adds "
        f"{float(np.mean([row['time with'] for row in press])):.1f} ms per frame to a press, which needs no friction "
        "without it, and makes the friction of a motion cost "
        f"{float(np.mean([row['time with'] / row['time without'] for row in moved])):.1f} times as much."
    )


def _effect(
    name: str,
    sensor: SensorModel,
    kernels: FrictionKernels,
    motions: Sequence[FrictionSequence],
    couplings: Sequence[Array],
) -> dict[str, Any]:
    calls = {
        "without": lambda: [_frames(motion, kernels, None) for motion in motions],
        "with": lambda: [_frames(motion, kernels, each) for motion, each in zip(motions, couplings, strict=True)],
    }
    without, coupled = (jax.device_get(call()) for call in calls.values())
    seconds = interleaved(calls, range(_ROUNDS))
    count = len(motions) * len(motions[0].pressure_mpa)
    ms = {key: 1e3 * float(np.median(s)) / count for key, s in seconds.items()}
    before, after = (np.stack([f.displacement_mm[:, :2] for f in found]) for found in (without, coupled))
    return {
        "motion, sensor": f"{name}, {sensor.name}",
        "markers": 100 * float(np.linalg.norm(after - before) / np.linalg.norm(before)),
        "by": _MICROMETRES * float(np.sqrt(np.mean(np.sum((after - before) ** 2, 2)))),
        "noise": _MICROMETRES * sensor.lateral_noise_mm,
        "force": 100 * max(map(_force_change, without, coupled, motions)),
        "time without": None if name == "hold" else ms["without"],
        "time with": ms["with"],
        "not converged": 100 * float(np.mean([~f.converged for f in coupled])),
    }


def _force_change(without: drag.Frame, coupled: drag.Frame, motion: FrictionSequence) -> float:
    off = np.linalg.norm(coupled.force_n[:, :2] - without.force_n[:, :2], axis=1)
    limit = float(motion.friction) * np.abs(without.force_n[:, 2]).max()
    return float(off.max() / limit)


@jax.jit
def _frames(motion: FrictionSequence, kernels: FrictionKernels, coupling: Array | None) -> drag.Frame:
    """A sequence as the generator makes it, coupled or not."""
    series = in_series(kernels.gel, kernels.body, 1.0, motion.modulus_mpa)
    bodies = drag.Bodies(compliance=series, coupling=coupling, response=kernels.markers)

    def go_on(history: drag.History, frame: tuple[Array, drag.RigidMotion]) -> tuple[drag.History, drag.Frame]:
        pressure, step = frame
        return drag.advance(history, pressure, motion.friction, step, bodies, kernels.x_mm)

    start = drag.at_rest(kernels.x_mm.shape[0])
    solved: drag.Frame = jax.lax.scan(go_on, start, (motion.pressure_mpa, motion.step))[1]
    return solved
