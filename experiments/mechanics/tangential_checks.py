"""The friction solver against closed forms, and the promise of the cheap tier against held-out contacts."""

import dataclasses
from collections.abc import Iterable, Mapping

import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Column, Table
from sensors_io.scenes import partial_slip, tangential
from sensors_io.scenes.hertz import Hertz, half_space_spectrum
from sensors_io.scenes.sensors import BODY, SensorModel
from sensors_io.scenes.traction import Compliance, rigid_field

SIDE_MM, TIGHT = 16.0, 1e-4
SHEAR_MODULUS_MPA, FRICTION = 0.15, 0.5
SPHERE = Hertz(radius_mm=8.0, plane_modulus_mpa=2 * SHEAR_MODULUS_MPA, force_n=2.0)
"""On a half-space of ν = 0, which is as compliant along as across a wave: both closed forms are then exact."""

PULL_SHARES = (0.3, 0.6, 0.9)
STICK_RATIOS = (0.8, 0.5, 0.2)
ACCEPTED_AT = (0.02, 0.05, 0.1, 0.2)
"""Tolerances at which the cheap tier is asked whether it is enough."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PromiseCheck:
    """One contact: kind of body, sensor, error of the superposition, and the error that it was promised to keep to."""

    kind: str
    sensor: str
    error: float
    promised: float

    @property
    def kept(self) -> bool:
        """Whether the promise holds."""
        return self.error <= self.promised


def cattaneo_mindlin(grid: int, context: Context) -> dict[str, float]:
    """How far the solver is from Cattaneo (1938) and Mindlin (1949): the worst over three forces, relative.

        δ = 3μF/(8Ga) [1 − (1 − Q/μF)^⅔],   c = a (1 − Q/μF)^⅓,   τ = μ [p_a(r) − (c/a) p_c(r)]

    `slide` is the rigid slide that carries Q, `force` the Q that this slide takes, `traction` the L₂ error of τ.
    """
    x, spacing, limit, compliance = _sphere(grid)
    radius, most, a = np.hypot(x[None], x[:, None]), FRICTION * SPHERE.force_n, SPHERE.contact_radius_mm
    still = jnp.zeros((grid, grid), jnp.complex64)
    off: dict[str, list[float]] = {"slide": [], "force": [], "traction": []}
    for share in context.each("Cattaneo and Mindlin", PULL_SHARES):
        slide = 3 * most / (8 * SHEAR_MODULUS_MPA * a) * (1 - (1 - share) ** (2 / 3))
        stick = a * (1 - share) ** (1 / 3)
        inner = SPHERE.peak_pressure_mpa * stick / a * np.sqrt(np.maximum(1 - (radius / stick) ** 2, 0))
        true = FRICTION * (SPHERE.pressure_mpa(radius) - inner)
        pull = jnp.asarray([share * most, 0.0], jnp.float32)
        pulled = tangential.solve_force(limit, pull, still, compliance, spacing, TIGHT)
        slid = tangential.solve(limit, still + slide, compliance, None, TIGHT)
        off["slide"].append(abs(complex(pulled.slide_mm) / slide - 1))
        off["force"].append(abs(complex(jnp.sum(slid.traction_mpa)) * spacing**2 / (share * most) - 1))
        off["traction"].append(float(np.linalg.norm(pulled.traction_mpa - true) / np.linalg.norm(true)))
    return {name: max(values) for name, values in off.items()}


def lubkin(grid: int, context: Context) -> float:
    """How far the torque of a twisted sphere is from Lubkin (1951): the worst over three twists, relative.

    A stack of twisted punches of radius t (Reissner & Sagoci 1944: torque 16/3 G t³ each) makes τ = μp outside the
    stick radius c:  θ(c) = 3μF/(4πGa²) [K(k) − E(k)],  k² = 1 − c²/a²;  the torque is ∫ 16/3 G t³ dθ(t).
    """
    x, spacing, limit, compliance = _sphere(grid)
    axis, still = jnp.asarray(x, jnp.float32), jnp.zeros(2, jnp.float32)
    off = []
    for ratio in context.each("Lubkin", STICK_RATIOS):
        twist, torque = _lubkin(ratio)
        solved = tangential.solve(limit, rigid_field(axis, still, twist, still), compliance, None, TIGHT)
        t = np.asarray(solved.traction_mpa, np.complex128)
        off.append(abs(float(np.sum(x[None] * t.imag - x[:, None] * t.real)) * spacing**2 / torque - 1))
    return max(off)


def promise(sensor: SensorModel, kind: str, error: float, modulus_mpa: float, radius_mm: float) -> PromiseCheck:
    """What the superposition was promised to keep to on one contact, and its error."""
    body = dataclasses.replace(BODY, modulus_mpa=modulus_mpa)
    promised = partial_slip.promised_error(sensor.gel, body, radius_mm)
    return PromiseCheck(kind=kind, sensor=sensor.name, error=error, promised=promised)


def promise_table(promises: Iterable[PromiseCheck]) -> Table:
    """By kind of body, by sensor, and of all."""
    found = list(promises)
    groups: dict[str, list[PromiseCheck]] = {}
    for p in found:
        groups.setdefault(p.kind, []).append(p)
    for p in found:
        groups.setdefault(p.sensor, []).append(p)
    rows = [_promise_row(name, group) for name, group in {**groups, "all": found}.items()]
    return Table(
        title="What the superposition promises, on contacts that its constants were not fitted to",
        columns=(
            Column(name="contacts"),
            Column(name="count", format="d"),
            Column(name="error", unit="%", format=".1f", meaning="median, of the marker displacement, relative L₂"),
            Column(name="error, 95th", unit="%", format=".1f"),
            Column(name="promised", unit="%", format=".1f", meaning="median of what `promised_error` says"),
            Column(name="kept", unit="%", format=".0f", meaning="share of contacts within their promise; 95 is said"),
        ),
        rows=tuple(rows),
    )


def decision_table(promises: Iterable[PromiseCheck]) -> Table:
    """Where the superposition is taken at a tolerance, and whether it was right to."""
    found = list(promises)
    rows: list[tuple[Cell, ...]] = []
    for tolerance in ACCEPTED_AT:
        taken = [p for p in found if p.promised <= tolerance]
        right = [p for p in taken if p.error <= tolerance]
        would_do = sum(p.error <= tolerance for p in found)
        rows.append(
            (
                f"{100 * tolerance:g} %",
                100 * len(taken) / len(found),
                100 * len(right) / len(taken) if taken else None,
                100 * would_do / len(found),
            )
        )
    return Table(
        title="The cheap tier, where its promise lets it in",
        columns=(
            Column(name="tolerance"),
            Column(name="taken", unit="%", format=".0f", meaning="share of contacts that promise it"),
            Column(name="of these within", unit="%", format=".0f"),
            Column(name="in hindsight", unit="%", format=".0f", meaning="share of contacts where it would have done"),
        ),
        rows=tuple(rows),
    )


def closed_form_table(mindlin: Mapping[str, float], torque: float, grid: int) -> Table:
    """All of them."""
    rows = [(f"Cattaneo–Mindlin: {name}", 100 * value) for name, value in mindlin.items()]
    return Table(
        title=f"Closed forms at {grid}², {SPHERE.contact_radius_mm / SIDE_MM * grid:.1f} pixels a contact radius",
        columns=(Column(name="figure"), Column(name="worst error", unit="%", format=".2f")),
        rows=(*rows, ("Lubkin: torque", 100 * torque)),
        note="The traction's error is that of the edge of the contact, which cuts through pixels.",
    )


def _promise_row(name: str, group: list[PromiseCheck]) -> tuple[Cell, ...]:
    errors = 100 * np.array([p.error for p in group])
    promised = 100 * float(np.median([p.promised for p in group]))
    kept = 100 * float(np.mean([p.kept for p in group]))
    return name, len(group), float(np.median(errors)), float(np.quantile(errors, 0.95)), promised, kept


def _sphere(grid: int) -> tuple[np.ndarray, float, jnp.ndarray, Compliance]:
    """Pixel centres, pixel size, μp of the sphere, which carries its force exactly, and the half-space."""
    spacing = SIDE_MM / grid
    x = (np.arange(grid) + 0.5) * spacing - SIDE_MM / 2
    p = SPHERE.pressure_mpa(np.hypot(x[None], x[:, None]))
    limit = FRICTION * p * SPHERE.force_n / (p.sum() * spacing**2)
    half = half_space_spectrum(grid, spacing, 2 * SHEAR_MODULUS_MPA)
    mirrored = np.roll(half[::-1], 1, 0)[:, grid - 1 : 0 : -1]
    even = jnp.asarray(np.concatenate([half, mirrored], 1), jnp.float32)
    return x, spacing, jnp.asarray(limit, jnp.float32), Compliance(even=even, odd=jnp.zeros_like(even, jnp.complex64))


def _lubkin(stick_ratio: float) -> tuple[float, float]:
    """Twist and torque of the sphere when it sticks within `stick_ratio` of its contact radius."""
    a, angle = SPHERE.contact_radius_mm, np.linspace(0, np.pi / 2, 4001)
    ratio = np.linspace(stick_ratio, 1, 400)
    root = np.sqrt(1 - (1 - ratio[:, None] ** 2) * np.sin(angle) ** 2)
    scale = 3 * FRICTION * SPHERE.force_n / (4 * np.pi * SHEAR_MODULUS_MPA * a**2)
    twist = scale * np.trapezoid(1 / root - root, angle, axis=1)
    return float(twist[0]), float(np.trapezoid(16 / 3 * SHEAR_MODULUS_MPA * (ratio * a) ** 3, -twist))
