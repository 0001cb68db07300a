"""Checks of friction: closed forms, promised errors, the effect of coupling, load–unload loops of real presses."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.errors import require
from experiments.core.results import Cell, Table, named_table
from experiments.core.timing import median_ms
from experiments.mechanics import tangential_scenes as scenes
from experiments.mechanics.tangential_methods import dragged
from sensors_io.arrays import load_arrays
from sensors_io.scenes import history, tangential
from sensors_io.scenes.hertz import Hertz
from sensors_io.scenes.mindlin import FrictionalSphere, half_space
from sensors_io.scenes.sensors import BODY, SensorModel
from sensors_io.scenes.traction import Compliance, make_coupling, rigid_field

SIDE_MM, TIGHT = 16.0, 1e-4
SPHERE = FrictionalSphere(
    normal=Hertz(radius_mm=8.0, plane_modulus_mpa=0.3, force_n=2.0), shear_modulus_mpa=0.15, friction=0.5
)

PULL_SHARES = (0.3, 0.6, 0.9)
STICK_RATIOS = (0.8, 0.5, 0.2)
ACCEPTED_AT = (0.02, 0.05, 0.1, 0.2)
"""Tolerances at which the superposition is accepted where it promises them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PromiseCheck:
    """One contact: kind of body, sensor, error of the superposition, and the error that it promises not to exceed."""

    kind: str
    sensor: str
    error: float
    promised: float

    @property
    def kept(self) -> bool:
        """True if the promise holds."""
        return self.error <= self.promised


def closed_forms(grid: int, context: Context) -> dict[str, float]:
    """Relative deviation from every closed form, by form and quantity."""
    mindlin = {f"Cattaneo–Mindlin: {name}": value for name, value in cattaneo_mindlin(grid, context).items()}
    return mindlin | {"Lubkin: torque": lubkin(grid, context)}


def cattaneo_mindlin(grid: int, context: Context) -> dict[str, float]:
    """Deviation of the solver from Cattaneo (1938) and Mindlin (1949): the worst over three forces, relative.

    `slide` is the rigid slide that carries Q, `force` the Q that this slide takes, `traction` the L₂ error of τ.
    """
    x, spacing, limit, compliance = _sphere(grid)
    radius, still = np.hypot(x[None], x[:, None]), jnp.zeros((grid, grid), jnp.complex64)
    off: dict[str, list[float]] = {"slide": [], "force": [], "traction": []}
    for share in context.each("Cattaneo and Mindlin", PULL_SHARES):
        slide, true, force = SPHERE.slide_mm(share), SPHERE.pulled_mpa(share, radius), share * SPHERE.most_n
        pull = jnp.asarray([force, 0.0], jnp.float32)
        pulled = tangential.solve_force(limit, pull, still, compliance, spacing, TIGHT)
        slid = tangential.solve(limit, still + slide, compliance, None, TIGHT)
        off["slide"].append(abs(complex(pulled.slide_mm) / slide - 1))
        off["force"].append(abs(complex(jnp.sum(slid.traction_mpa)) * spacing**2 / force - 1))
        off["traction"].append(float(np.linalg.norm(pulled.traction_mpa - true) / np.linalg.norm(true)))
    return {name: max(values) for name, values in off.items()}


def lubkin(grid: int, context: Context) -> float:
    """Deviation of the torque of a twisted sphere from Lubkin (1951): the worst over three twists, relative."""
    x, spacing, limit, compliance = _sphere(grid)
    axis, still = jnp.asarray(x, jnp.float32), jnp.zeros(2, jnp.float32)
    off = []
    for ratio in context.each("Lubkin", STICK_RATIOS):
        twist, torque = SPHERE.twist(ratio)
        solved = tangential.solve(limit, rigid_field(axis, still, twist, still), compliance, None, TIGHT)
        t = np.asarray(solved.traction_mpa, np.complex128)
        off.append(abs(float(np.sum(x[None] * t.imag - x[:, None] * t.real)) * spacing**2 / torque - 1))
    return max(off)


def promise_table(promises: Sequence[PromiseCheck]) -> Table:
    """Errors and promises by kind of body, by sensor, and of all."""
    groups: dict[str, list[PromiseCheck]] = {}
    for group_of in (lambda p: p.kind, lambda p: p.sensor, lambda p: "all"):
        for p in promises:
            groups.setdefault(group_of(p), []).append(p)
    rows: list[dict[str, Cell]] = []
    for name, group in groups.items():
        errors, promised = 100 * np.array([p.error for p in group]), [p.promised for p in group]
        row = {"error": float(np.median(errors)), "error, 95th": float(np.quantile(errors, 0.95))}
        row |= {"promised": 100 * float(np.median(promised)), "kept": 100 * float(np.mean([p.kept for p in group]))}
        rows.append({"contacts": name, "count": len(group), **row})
    figures = ("error", "error, 95th", "promised")
    return named_table(
        "Promised errors of the superposition, on contacts to which its constants were not fitted",
        rows,
        formats={"count": "d", **dict.fromkeys(figures, ".1f"), "kept": ".0f"},
        units=dict.fromkeys((*figures, "kept"), "%"),
        meanings={
            "error": "median, of the marker displacement, relative L₂",
            "promised": "median of `promised_error`",
            "kept": "share of contacts within their promise; 95 is promised",
        },
    )


def decision_table(promises: Sequence[PromiseCheck]) -> Table:
    """Contacts on which the superposition is accepted at a tolerance, and the share of right decisions."""
    error, promised = (np.array([getattr(p, field) for p in promises]) for field in ("error", "promised"))
    percent = lambda chosen: 100 * int(chosen.sum()) / len(chosen) if len(chosen) else None
    rows: list[dict[str, Cell]] = [
        {
            "tolerance": f"{100 * tolerance:g} %",
            "taken": percent(promised <= tolerance),
            "of these within": percent(error[promised <= tolerance] <= tolerance),
            "in hindsight": percent(error <= tolerance),
        }
        for tolerance in ACCEPTED_AT
    ]
    figures = ("taken", "of these within", "in hindsight")
    return named_table(
        "The superposition, where it promises the tolerance",
        rows,
        formats=dict.fromkeys(figures, ".0f"),
        units=dict.fromkeys(figures, "%"),
        meanings={
            "taken": "share of contacts that promise it",
            "in hindsight": "share of contacts whose error is within it",
        },
    )


def closed_form_table(errors: Mapping[str, float], grid: int) -> Table:
    """Deviations from all closed forms."""
    return named_table(
        f"Closed forms at {grid}², {SPHERE.normal.contact_radius_mm / SIDE_MM * grid:.1f} pixels a contact radius",
        [{"figure": name, "worst error": 100 * value} for name, value in errors.items()],
        formats={"worst error": ".2f"},
        units={"worst error": "%"},
        note="The traction's error is that of the edge of the contact, which cuts through pixels.",
    )


def _sphere(grid: int) -> tuple[np.ndarray, float, jnp.ndarray, Compliance]:
    """Pixel centres, pixel size, μp of the sphere, and the half-space."""
    spacing = SIDE_MM / grid
    x = (np.arange(grid) + 0.5) * spacing - SIDE_MM / 2
    limit = SPHERE.limit_mpa(np.hypot(x[None], x[:, None]), spacing)
    return x, spacing, jnp.asarray(limit, jnp.float32), half_space(grid, spacing, 2 * SPHERE.shear_modulus_mpa)


# Coupling ------------------------------------------------------------------------------------------------------------

MOTIONS = ("hold", "slide_x", "twist")
"""A press that is held and released, which has no friction at all without coupling, and two that have."""

_ROUNDS = 3  # of timing; the ratio is reported to a tenth
_MICROMETRES = 1e3


def coupling_rows(sensor: SensorModel, grid: int, frames: int, bodies: int, seed: int) -> list[dict[str, Any]]:
    """Effect of every motion on the gel of one sensor, over `bodies` objects of every kind in turn.

    Pressure alone moves the surface of the gel sideways, and that of the object by another amount.  Where both stick,
    friction takes up the difference; the generator leaves that out unless its scenes are `coupled`.
    """
    kernels = scenes.friction_kernels(sensor, grid)
    size, spacing = kernels.normal_gel.shape[0], sensor.window_mm / grid
    gel, body = (make_coupling(layer, size, spacing) for layer in (sensor.gel, BODY))
    rng = np.random.default_rng([seed, 2])
    drawn = [scenes.draw(rng, scenes.KINDS[i % len(scenes.KINDS)]) for i in range(bodies)]
    solve_all = lambda motions, couplings: [_frames(m, kernels, c) for m, c in zip(motions, couplings, strict=True)]
    rows = []
    for name in MOTIONS:
        motions = [scenes.make_motion(kernels, each, name, frames) for each in drawn]
        couplings = {"without": [None] * bodies, "with": [gel - body / m.modulus_mpa for m in motions]}
        calls = {key: functools.partial(solve_all, motions, each) for key, each in couplings.items()}
        without, coupled = (jax.device_get(call()) for call in calls.values())
        ms = {key: time / (bodies * frames) for key, time in median_ms(calls, range(_ROUNDS)).items()}
        before, after = (np.stack([f.displacement_mm[:, :2] for f in found]) for found in (without, coupled))
        forces = []
        for still, moved, motion in zip(without, coupled, motions, strict=True):
            off = np.linalg.norm(moved.force_n[:, :2] - still.force_n[:, :2], axis=1)
            forces.append(float(off.max() / (float(motion.friction) * np.abs(still.force_n[:, 2]).max())))
        rows.append(
            {
                "motion, sensor": f"{name}, {sensor.name}",
                "markers": 100 * float(np.linalg.norm(after - before) / np.linalg.norm(before)),
                "by": _MICROMETRES * float(np.sqrt(np.mean(np.sum((after - before) ** 2, 2)))),
                "noise": _MICROMETRES * sensor.lateral_noise_mm,
                "force": 100 * max(forces),
                "time without": None if name == "hold" else ms["without"],
                "time with": ms["with"],
                "not converged": 100 * float(np.mean([~f.converged for f in coupled])),
            }
        )
    return rows


_frames = jax.jit(lambda motion, kernels, coupling: dragged(motion, kernels, lambda frame: frame, coupling))


def coupling_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Effect and cost of coupling for all motions on all gels."""
    percent, times = ("markers", "by", "force", "not converged"), ("time without", "time with")
    return named_table(
        "Effect and cost of coupling",
        rows,
        formats={**dict.fromkeys(percent, ".1f"), "noise": ".0f", **dict.fromkeys(times, ".2f")},
        units={
            **{"markers": "%", "by": "µm", "noise": "µm", "force": "% of μF", "not converged": "%"},
            **dict.fromkeys(times, "ms"),
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


# Loops of real presses -----------------------------------------------------------------------------------------------

RECORDING = "example_1_AD2-0065L.npz"
"""The vendor's longer recording, 20 × 20 markers, frames 32.7 ms apart."""

LAGS_S = (0.0, 0.03, 0.06, 0.09)
TOUCHES_N = 0.05
"""Force above which the sensor is touched."""


def loop_table(data_dir: Path) -> Table:
    """Area of the loop of force over mean indentation, relative to the work of loading, for every press.

    An elastic gel makes 0, a lossy one a positive area, a force that is read before the displacement a negative one.

    Raises:
      ResultsError: the directory does not hold `RECORDING`.
    """
    path = data_dir / RECORDING
    require(path.is_file(), "data_dir", data_dir, f"must hold {RECORDING}", "give the folder of the recordings")
    recording = load_arrays(path)
    force = -recording["3D_ResultantForce"].reshape(-1, 3)[:, 2]
    depth = -recording["3D_Displacements"][..., 2].mean(1)
    time = recording["sendTimestamp"].ravel() - recording["sendTimestamp"].ravel()[0]
    heading = {lag: f"force read {1000 * lag:.0f} ms later" for lag in LAGS_S}
    rows: list[dict[str, Cell]] = []
    for press in _presses(force):
        t = time[press]
        returned = {lag: history.returned_share(np.interp(t + lag, time, force), depth[press]) for lag in LAGS_S}
        areas = {heading[lag]: 100 * (1 - share) for lag, share in returned.items()}
        rows.append({"press": f"{t[0]:.1f}–{t[-1]:.1f} s", "peak": float(force[press].max()), **areas})
    return named_table(
        "Loops of force over indentation in real presses",
        rows,
        formats={"peak": ".2f", **dict.fromkeys(heading.values(), ".1f")},
        units={"peak": "N", **dict.fromkeys(heading.values(), "%")},
        note="Area over the work of loading, by a Tac3D's own force and mean indentation; positive: energy is lost.",
    )


def _presses(force_n: np.ndarray) -> list[slice]:
    """Frames of every press that begins and ends within a recording, one untouched frame included on either side."""
    edges = np.diff((force_n > TOUCHES_N).astype(int))
    begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    return [slice(int(b), int(ends[ends > b][0]) + 2) for b in begins if np.any(ends > b)]
