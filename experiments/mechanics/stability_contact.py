"""Where does each contact method fail, and does it flag its failures?

    python -m experiments stability_contact [--scale smoke]

Runs the failure suite, maps of the error over force and roughness and over force and thickness, and hundreds of
ordinary scenes.  A frame must be flagged if its error against the float64 solution exceeds twice the tolerance, or if
small-strain theory does not apply to its scene; an accurate ordinary scene must not be flagged.  Adhesion, which no
scene models, is flagged by a threshold for JKR's sphere on a half-space.  Here presses on the layered gels are
converted to presses with adhesion at equal contact areas (Ciavarella 2018): the flag must be set wherever adhesion
widens the contact by more than the tolerance.

Cost: half a minute on two cores (`smoke` ten seconds).

Expected: springs err by tens of per cent everywhere, the loosely stopped plain solver errs by more than it reports in
every third case, and the package's solver nowhere without a flag.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.pictures import Heatmap, heatmaps
from experiments.core.results import Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.mechanics import contact_scenes
from experiments.mechanics.contact_methods import METHODS
from experiments.mechanics.contact_scenes import GEL, ContactScenes, FailureCase, displacement_error, exact
from sensors_io import layer
from sensors_io.scenes import adhesion, contact, hertz, press
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.sensors import GELSIGHT_MINI, MODELS, SensorModel
from sensors_io.scenes.validity import STRAIN_LIMIT

SENSOR = GELSIGHT_MINI
NESTED = "nested SPG"
OTHERS = {
    "Winkler + response": jax.jit(METHODS["Winkler + response"].solve),
    "PK-25": jax.jit(METHODS["PK-25"].solve),
    "plain SPG, published stop": jax.jit(METHODS["plain 1e-3 as published"].solve),
}
COLUMNS = {name: f"error of {name}" for name in OTHERS} | {NESTED: "error"}
"""Method → column of its error."""

MOST_ERROR = 2 * contact.TOLERANCE
"""Error above which a frame must be flagged."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityContactConfig:
    """Sides of the grids of contacts and of adhesive presses; ordinary scenes; axes of the maps; seed.

    Roughness is a multiple of that of a rough sphere.
    """

    grid: int = 64
    adhesion_grid: int = 128
    scenes: int = 1000
    forces_n: tuple[float, ...] = (1e-3, 1e-2, 0.1, 1.0, 5.0, 20.0)
    roughness: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0, 5.0, 10.0)
    thickness_mm: tuple[float, ...] = (0.3, 0.6, 1.2, 2.5, 5.0, 10.0)
    seed: int = 5


class FailureOutcome(NamedTuple):
    """One scene: its row in the table of cases; whether the package's solver flags it, and returns finite numbers."""

    row: Mapping[str, Any]
    flagged: bool
    finite: bool


def run(config: StabilityContactConfig, context: Context) -> Results:
    """Suite, maps, ordinary scenes, adhesion."""
    cases = contact_scenes.failure_suite(config.grid)
    suite = {case.name: attempt(case) for case in context.each("cases", cases)}
    maps = {
        name: [[attempt(case) for case in row] for row in context.each(name, rows)]
        for name, rows in swept_cases(config).items()
    }
    ordinary = ordinary_scenes(config, context)
    spheres = context.each("adhesion", itertools.product(MODELS, RADII_MM))
    adhesive = [adhesion_threshold(sensor, radius, config.adhesion_grid) for sensor, radius in spheres]
    every = [*suite.values(), *itertools.chain(*(row for outcomes in maps.values() for row in outcomes))]
    silent = sum(o.row["error"] > MOST_ERROR and not o.flagged for o in every)
    missed = sum(case.must_flag and not suite[case.name].flagged for case in cases)
    adhesion_ratio = max(row["counts over flagged"] for row in adhesive)
    measured = {
        "frames with a NaN": (sum(not o.finite for o in every) + ordinary["not finite"], 0),
        "frames off by > 2 × tolerance and not flagged": (silent + ordinary["silent"], 0),
        "scenes beyond the theory and not flagged": (missed, 0),
        "force up to which adhesion counts, over that up to which it is flagged": (adhesion_ratio, 1.0),
        "ordinary good scenes flagged": (ordinary["flagged share"], 0.02),
    }
    wrong = lambda column: sum(outcome.row[column] > MOST_ERROR for outcome in suite.values())
    broken = [f"{name} {wrong(column)}" for name, column in COLUMNS.items()]
    return Results(
        verdict=(
            f"Cases of {len(suite)} in which a method errs by more than twice the tolerance: {', '.join(broken)}; of "
            f"the ordinary good scenes {ordinary['flagged share']:.1%} are flagged.",
        ),
        requirements=tuple(at_most(name, found, bound) for name, (found, bound) in measured.items()),
        tables=(_suite_table(suite), _adhesion_table(adhesive)),
        pictures=(
            _failure_map("roughness", "roughness, factor", config.roughness, config.forces_n, maps["roughness"]),
            _failure_map("thickness", "thickness, mm", config.thickness_mm, config.forces_n, maps["thickness"]),
        ),
        settings={"grid": config.grid, "ordinary scenes": config.scenes, "tolerance": contact.TOLERANCE},
        data=ordinary,
    )


def attempt(case: FailureCase) -> FailureOutcome:
    """Solve one case by every method."""
    kernels, spacing = case.kernels(), case.kernels().spacing_mm
    force = np.array([case.force_n], np.float32)
    scene = ContactScenes(case.gap_mm[None].astype(np.float32), force, np.ones(1, np.float32))
    true = exact(zip(*scene, strict=True), kernels)
    gap, gel = jnp.asarray(scene.gap_mm[0]), jnp.asarray(kernels.gel, jnp.float32)
    found = jax.device_get(contact.solve(gap, force[0], gel, 0 * gel, spacing, thickness_mm=kernels.thickness_mm))
    fields = {COLUMNS[name]: solve(gap, force[0], gel, gel, spacing)[0] for name, solve in OTHERS.items()}
    error_of = lambda field: float(displacement_error(np.asarray(field)[None], true)[0])
    valid = found.validity
    failed = {"not converged": valid.converged, "strain": valid.small_strain, "unresolved": valid.resolved}
    row = {
        "case": case.name,
        "error": error_of(found.displacement_mm),
        "residual": float(found.residual),
        "iterations": int(found.iterations),
        "u/h": float(found.strain),
        "flagged for": ", ".join(name for name, ok in failed.items() if not ok) or "–",
        "must be flagged": case.must_flag,
        **{column: error_of(field) for column, field in fields.items()},
    }
    finite = all(bool(np.all(np.isfinite(leaf))) for leaf in jax.tree.leaves(found))
    return FailureOutcome(row, not bool(valid.all), finite)


def swept_cases(config: StabilityContactConfig) -> dict[str, list[list[FailureCase]]]:
    """Cases of the maps, parameter × force: a rough sphere of other roughness, and on gels of other thickness."""
    x = contact_scenes.pixel_centres(config.grid)
    smooth = (x[None] ** 2 + x[:, None] ** 2) / 40
    rough = contact_scenes.rough_sphere(np.random.default_rng(config.seed), config.grid)
    gaps = [smooth + factor * (rough - smooth) for factor in config.roughness]
    gels = [dataclasses.replace(GEL, thickness_mm=h) for h in config.thickness_mm]
    case = lambda force, gap=rough, gel=GEL: FailureCase(name="", gap_mm=gap, force_n=force, gel=gel)
    return {
        "roughness": [[case(force, gap=gap) for force in config.forces_n] for gap in gaps],
        "thickness": [[case(force, gel=gel) for force in config.forces_n] for gel in gels],
    }


def ordinary_scenes(config: StabilityContactConfig, context: Context) -> dict[str, float]:
    """Of random scenes: those flagged though their exact strain is small, and those wrong without a flag."""
    scenes = contact_scenes.sample_scenes(SENSOR, config.scenes, config.grid, config.seed)
    kernels = contact_scenes.gel_kernels(SENSOR, config.grid)
    true = exact(context.each("ordinary scenes", zip(*scenes, strict=True)), kernels)

    def solve(gap: jax.Array, force: jax.Array, gel: jax.Array, body: jax.Array) -> contact.Contact:
        return contact.solve(gap, force, gel, body, kernels.spacing_mm, thickness_mm=kernels.thickness_mm)

    with context.progress("solving ordinary scenes", 1) as advance:
        found = jax.device_get(contact_scenes.batch_solver(solve, scenes, kernels)())
        advance()
    error = displacement_error(found.displacement_mm, true)
    flagged = ~np.asarray(found.validity.all)
    good = true.max((1, 2)) / kernels.thickness_mm <= STRAIN_LIMIT
    return {
        "good scenes": int(good.sum()),
        "flagged share": float(flagged[good].mean()),
        "silent": int(np.sum((error > MOST_ERROR) & ~flagged)),
        "not finite": int(np.sum(~np.isfinite(error))),
        "worst error": float(error.max()),
        "strained share": float(np.mean(~good)),
        "worst error over residual": float(np.max(error / found.residual)),
        "most iterations": int(found.iterations.max()),
    }


# Adhesion ------------------------------------------------------------------------------------------------------------

RADII_MM = (5.0, 15.0, 40.0)
"""Radii of spheres, from the most curved to the flattest bodies of the generator."""

_FORCES = (5e-3, 3.0)  # of a press over that at which the flag stops: from below the pull-off of a half-space on
_RAMP = 28  # forces of a press, geometric
_SIDE = 2.5  # of the grid, over the contact's radius on a half-space, which is wider than on a layer
_DEGREE = 4  # of the polynomials in log δ that smooth a ramp
_TOLERANCE, _ITERATIONS = 1e-4, 400


def adhesion_threshold(sensor: SensorModel, radius_mm: float, grid: int) -> dict[str, Any]:
    """Force up to which frames are flagged, and up to which adhesion matters, N; frames are missed at a ratio > 1."""
    config = SceneConfig()
    work = 1e-3 * config.adhesion_j_per_m2  # N/mm
    modulus = adhesion.plane_modulus_mpa(sensor.gel)
    sphere = adhesion.Adhesion(radius_mm=radius_mm, plane_modulus_mpa=modulus, work_n_per_mm=work)
    flagged = sphere.least_force_n(config.adhesion_tolerance)
    force, approach, area = _press(sensor, radius_mm, flagged * np.geomspace(*_FORCES, _RAMP), grid)
    stuck_force, _ = adhesion.adhesive_ramp(force, approach, area, work)
    stable = slice(int(np.argmin(stuck_force)), None)
    wider = np.sqrt(area[stable] / np.interp(stuck_force[stable], force, area)) - 1
    matters = (wider > config.adhesion_tolerance) & (stuck_force[stable] >= force[0])
    most = float(np.max(stuck_force[stable], where=matters, initial=0.0))
    return {
        "sensor and sphere": f"{sensor.name}, R = {radius_mm:g} mm",
        "flagged below": flagged,
        "counts below": most,
        "counts over flagged": most / flagged,
    }


def _press(
    sensor: SensorModel, radius_mm: float, force_n: np.ndarray, grid: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force, approach and contact area of a press without adhesion, on a grid that its widest contact fills.

    The ramp is smoothed by polynomials of the logarithms.
    """
    modulus = adhesion.plane_modulus_mpa(sensor.gel)
    widest = hertz.Hertz(radius_mm=radius_mm, plane_modulus_mpa=modulus, force_n=float(force_n[-1])).contact_radius_mm
    side = _SIDE * widest
    spacing = side / grid
    size = press.padded_size(grid, side, sensor.gel.thickness_mm)
    gel = jnp.asarray(layer.normal_compliance(np.hypot(*layer.wave_numbers(size, spacing)), sensor.gel), jnp.float32)
    x = (np.arange(grid) + 0.5) * spacing - side / 2
    gap = jnp.asarray((x[None] ** 2 + x[:, None] ** 2) / (2 * radius_mm), jnp.float32)

    @jax.jit
    def touch(force: jax.Array) -> tuple[jax.Array, jax.Array]:
        solved = contact.solve(gap, force, gel, 0 * gel, spacing, _TOLERANCE, _ITERATIONS)
        return solved.approach_mm, _area_px(solved.pressure_mpa)

    approach, pixels = (np.asarray(a, float) for a in jax.lax.map(touch, jnp.asarray(force_n, jnp.float32)))
    at = np.geomspace(approach[0], approach[-1], 2000)
    ramps = (force_n, pixels * spacing**2)
    fitted = (np.polynomial.Polynomial.fit(np.log(approach), np.log(y), _DEGREE) for y in ramps)
    force, area = (np.exp(curve(np.log(at))) for curve in fitted)
    return force, at, area


def _area_px(pressure: jax.Array) -> jax.Array:
    """Area of a round contact, pixels, by the second moment of its pressure, which pixels blur less than its edge.

    a² = 5/2 · Σ p r² / Σ p, exact for p ∝ √(1 − r²/a²), Hertz; 17 % too small for the parabola of a thin layer.
    """
    n = pressure.shape[0]
    x = jnp.arange(n) - (n - 1) / 2
    second = jnp.sum(pressure * (x[None] ** 2 + x[:, None] ** 2)) / jnp.sum(pressure)
    return jnp.pi * 2.5 * second


# Report --------------------------------------------------------------------------------------------------------------


def _suite_table(suite: Mapping[str, FailureOutcome]) -> Table:
    return named_table(
        "The failure suite",
        [outcome.row for outcome in suite.values()],
        formats={"iterations": "d", "u/h": ".2f", **dict.fromkeys((*COLUMNS.values(), "residual"), ".1e")},
        meanings={"error": "relative, of the displacement"},
    )


def _adhesion_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    config = SceneConfig()
    return named_table(
        "Adhesion: where it is flagged, and where it counts",
        rows,
        formats={"flagged below": ".3f", "counts below": ".3f", "counts over flagged": ".2f"},
        units={"flagged below": "N", "counts below": "N"},
        meanings={"flagged below": "by JKR's sphere on a half-space", "counts below": "on the gel's finite thickness"},
        note=f"Work of adhesion {config.adhesion_j_per_m2:g} J/m²; it counts where it widens the contact by more than "
        f"{config.adhesion_tolerance:.0%}.",
    )


def _failure_map(
    name: str, label: str, rows: Sequence[float], forces: Sequence[float], outcomes: list[list[FailureOutcome]]
) -> Picture:
    """Error of every method over two parameters, with a cross where the package's solver flags the frame."""
    cells = outcomes[::-1]  # the lowest value stands at the bottom
    flagged = np.array([[o.flagged for o in row] for row in cells])
    return Picture(
        name=f"stability_{name}",
        title=f"Error of each method over force and {name}",
        caption="Error compared with the float64 solution; the white line on the scale is twice the tolerance. "
        f"Crosses: flagged by the package's solver (strain above {STRAIN_LIMIT}, contact unresolved, not converged); "
        "the other methods flag nothing.",
        content=heatmaps(
            [
                Heatmap(
                    np.nan_to_num([[o.row[COLUMNS[method]] for o in row] for row in cells], nan=1.0, posinf=1.0),
                    rows=[f"{v:g}" for v in reversed(rows)],
                    columns=[f"{v:g}" for v in forces],
                    title=method,
                    crosses=flagged if method == NESTED else None,
                )
                for method in (*OTHERS, NESTED)
            ],
            x_label="force, N",
            y_label=label,
            columns=len(OTHERS) + 1,
            limits=(contact.TOLERANCE * 1e-2, 1.0),
            logarithmic=True,
            colour_map="cividis",
            colour_bar="error of displacement",
            mark=MOST_ERROR,
            size=(2.6 * (len(OTHERS) + 1) + 0.9, 3.1),
        ),
    )


SMOKE = StabilityContactConfig(
    grid=32, adhesion_grid=64, scenes=40, forces_n=(0.01, 1.0), roughness=(0.0, 2.0), thickness_mm=(0.3, 5.0)
)

EXPERIMENT = Experiment(name="stability_contact", config=StabilityContactConfig(), scales={"smoke": SMOKE}, run=run)
