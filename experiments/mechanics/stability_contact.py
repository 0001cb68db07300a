"""Where does each contact method break, and does it say so?

    python -m experiments stability_contact [--scale smoke]

The failure suite, a map of the error over force and roughness and one over force and thickness for every method, and
ordinary scenes by the hundreds; and where adhesion, which no scene is solved with, would count, against where it is
flagged.  The error is that of the gel's displacement by the float64 solution on the same grid;
a frame off by more than twice the tolerance must be flagged, and so must a scene that small-strain theory does not
carry; an ordinary good scene must not be.  Half a minute on two cores (`smoke` ten seconds).  Expected: springs are off
by tens of per cent everywhere, the loosely stopped plain solver by more than it says in every third case, and the
package's solver nowhere without a flag.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.mechanics import adhesion as contact_adhesion
from experiments.mechanics import contact_charts
from experiments.mechanics.contact_checks import rough_sphere
from experiments.mechanics.contact_failures import SIDE_MM, FailureCase, suite
from experiments.mechanics.contact_methods import polonsky_keer, spg_plain, winkler_and_response
from experiments.mechanics.contact_scenes import ContactScenes, displacement_error, exact, gel_kernels, sample
from sensors_io.layer import Layer
from sensors_io.scenes import contact
from sensors_io.scenes.sensors import GELSIGHT_MINI
from sensors_io.scenes.validity import STRAIN_LIMIT

SENSOR = GELSIGHT_MINI
NESTED = "nested SPG"
OTHERS = {
    "Winkler + response": winkler_and_response,
    "PK-25": polonsky_keer(25),
    "plain SPG, published stop": spg_plain(contact.TOLERANCE, True),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityContactConfig:
    """What to try.

    Args:
      grid: side of the contact grids.
      adhesion_grid: the same for the presses that adhesion is added to.
      scenes: ordinary ones.
      forces_n, roughness, thickness_mm: axes of the maps; roughness is a factor of that of the suite's rough sphere.
      seed: of the ordinary scenes and of the roughness.
    """

    grid: int = 64
    adhesion_grid: int = 128
    scenes: int = 1000
    forces_n: tuple[float, ...] = (1e-3, 1e-2, 0.1, 1.0, 5.0, 20.0)
    roughness: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0, 5.0, 10.0)
    thickness_mm: tuple[float, ...] = (0.3, 0.6, 1.2, 2.5, 5.0, 10.0)
    seed: int = 5


@dataclasses.dataclass(frozen=True, kw_only=True)
class FailureOutcome:
    """Error of every method on one scene; what the package's solver says of itself."""

    errors: Mapping[str, float]
    finite: bool
    flagged: bool
    reason: str
    residual: float
    iterations: int
    strain: float


def run(config: StabilityContactConfig, context: Context) -> Results:
    """Suite, maps, ordinary scenes."""
    cases = suite(config.grid)
    outcomes = {case.name: attempt(case) for case in context.each("cases", cases)}
    by_roughness = sweep("roughness", config.roughness, lambda rms: _rough_case(rms, config), config, context)
    by_thickness = sweep("thickness", config.thickness_mm, lambda h: _thin_case(h, config), config, context)
    ordinary = ordinary_scenes(config, context)
    sticky = contact_adhesion.thresholds(config.adhesion_grid, context)
    every = [*outcomes.values(), *by_roughness.values(), *by_thickness.values()]
    kept = [outcomes[c.name].flagged for c in cases if c.refused]
    return Results(
        verdict=_verdict(outcomes, ordinary),
        requirements=(
            _count("frames with a NaN", sum(not o.finite for o in every) + ordinary["not finite"]),
            _count("frames off by > 2 × tolerance and not flagged", _silent(every) + ordinary["silent"]),
            _count("scenes beyond the theory and not flagged", len(kept) - sum(kept)),
            Requirement(
                name="force up to which adhesion counts, over that up to which it is flagged",
                measured=max(t.missed for t in sticky),
                bound=1.0,
                better="lower",
            ),
            Requirement(
                name="ordinary good scenes flagged", measured=ordinary["flagged share"], bound=0.02, better="lower"
            ),
        ),
        tables=(_suite_table(cases, outcomes), contact_adhesion.threshold_table(sticky)),
        pictures=(
            _map("roughness", "roughness, factor", config.roughness, config.forces_n, by_roughness),
            _map("thickness", "thickness, mm", config.thickness_mm, config.forces_n, by_thickness),
        ),
        settings={"grid": config.grid, "ordinary scenes": config.scenes, "tolerance": contact.TOLERANCE},
        data=ordinary,
    )


def attempt(case: FailureCase) -> FailureOutcome:
    """Solve one case by every method."""
    kernels = case.kernels()
    scenes = ContactScenes(
        gap_mm=case.gap_mm[None].astype(np.float32),
        force_n=np.array([case.force_n], np.float32),
        modulus_mpa=np.ones(1, np.float32),
    )
    true = exact(scenes, kernels)[0]
    gap, gel = jnp.asarray(scenes.gap_mm[0]), jnp.asarray(kernels.gel, jnp.float32)
    found = jax.device_get(_solve(gap, scenes.force_n[0], gel, 0 * gel, kernels.spacing_mm, kernels.thickness_mm))
    fields = {name: _OTHERS[name](gap, scenes.force_n[0], gel, gel, kernels.spacing_mm)[0] for name in OTHERS}
    errors = {
        name: float(displacement_error(np.asarray(u)[None], true[None])[0])
        for name, u in {**fields, NESTED: found.displacement_mm}.items()
    }
    return FailureOutcome(
        errors=errors,
        finite=all(bool(np.all(np.isfinite(leaf))) for leaf in jax.tree.leaves(found)),
        flagged=not bool(found.validity.all),
        reason=_reason(found),
        residual=float(found.residual),
        iterations=int(found.iterations),
        strain=float(found.strain),
    )


def sweep(
    title: str,
    rows: Sequence[float],
    make: Callable[[float], FailureCase],
    config: StabilityContactConfig,
    context: Context,
) -> dict[tuple[int, int], FailureOutcome]:
    """Outcomes over rows × forces; `make` turns a row's value into a case."""
    cells = itertools.product(enumerate(rows), enumerate(config.forces_n))
    return {
        (i, j): attempt(dataclasses.replace(make(value), force_n=force))
        for (i, value), (j, force) in context.each(title, cells)
    }


def ordinary_scenes(config: StabilityContactConfig, context: Context) -> dict[str, float]:
    """Of random scenes, how many are flagged though the oracle calls them good, and how many are wrong in silence."""
    scenes, kernels = sample(SENSOR, config.scenes, config.grid, config.seed), gel_kernels(SENSOR, config.grid)
    true = exact(context.each("ordinary scenes", scenes), kernels)
    gel, body = jnp.asarray(kernels.gel, jnp.float32), jnp.asarray(kernels.body, jnp.float32)

    def solve(scene: tuple[jax.Array, jax.Array, jax.Array]) -> contact.Contact:
        gap, force, modulus = scene
        return _solve(gap, force, gel, body / modulus, kernels.spacing_mm, kernels.thickness_mm)

    inputs = tuple(map(jnp.asarray, (scenes.gap_mm, scenes.force_n, scenes.modulus_mpa)))
    with context.progress("solving ordinary scenes", 1) as advance:
        found = jax.device_get(jax.jit(lambda s: jax.lax.map(solve, s))(inputs))
        advance()
    error = displacement_error(found.displacement_mm, true)
    flagged = ~np.asarray(found.validity.all)
    good = true.max((1, 2)) / kernels.thickness_mm <= STRAIN_LIMIT
    return {
        "good scenes": int(good.sum()),
        "flagged share": float(flagged[good].mean()),
        "silent": int(np.sum((error > 2 * contact.TOLERANCE) & ~flagged)),
        "not finite": int(np.sum(~np.isfinite(error))),
        "worst error": float(error.max()),
        "strained share": float(np.mean(~good)),
        "worst error over residual": float(np.max(error / found.residual)),
        "most iterations": int(found.iterations.max()),
    }


def _reason(found: contact.Contact) -> str:
    v = found.validity
    failed = {"not converged": v.converged, "strain": v.small_strain, "unresolved": v.resolved}
    return ", ".join(name for name, ok in failed.items() if not ok) or "–"


def _silent(outcomes: Sequence[FailureOutcome]) -> int:
    return sum(o.errors[NESTED] > 2 * contact.TOLERANCE and not o.flagged for o in outcomes)


def _count(name: str, count: float) -> Requirement:
    return Requirement(name=name, measured=float(count), bound=0, better="lower")


def _rough_case(factor: float, config: StabilityContactConfig) -> FailureCase:
    x = (np.arange(config.grid) + 0.5) * SIDE_MM / config.grid - SIDE_MM / 2
    smooth = (x[None] ** 2 + x[:, None] ** 2) / 40
    rough = rough_sphere(np.random.default_rng(config.seed), config.grid)
    return FailureCase(name=f"roughness × {factor}", gap_mm=smooth + factor * (rough - smooth), force_n=1.0)


def _thin_case(thickness_mm: float, config: StabilityContactConfig) -> FailureCase:
    gel = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=thickness_mm)
    gap = rough_sphere(np.random.default_rng(config.seed), config.grid)
    return FailureCase(name=f"h = {thickness_mm} mm", gap_mm=gap, force_n=1.0, gel=gel)


def _map(
    name: str,
    label: str,
    rows: Sequence[float],
    forces: Sequence[float],
    outcomes: Mapping[tuple[int, int], FailureOutcome],
) -> Picture:
    shape = (len(rows), len(forces))
    errors = {
        method: np.array([outcomes[i, j].errors[method] for i in range(shape[0]) for j in range(shape[1])])
        for method in (*OTHERS, NESTED)
    }
    flags = np.array([outcomes[i, j].flagged for i in range(shape[0]) for j in range(shape[1])]).reshape(shape)
    return Picture(
        name=f"stability_{name}",
        title=f"Where each method breaks: force and {name}",
        caption="Error by the float64 solution; the white line on the scale is twice the tolerance. Crosses: flagged "
        f"by the package's solver (strain above {STRAIN_LIMIT}, contact unresolved, not converged); the others say "
        "nothing.",
        content=contact_charts.failure_maps(
            {method: np.nan_to_num(e, nan=1.0, posinf=1.0).reshape(shape) for method, e in errors.items()},
            {method: flags & (method == NESTED) for method in errors},
            (label, rows),
            ("force, N", forces),
            contact.TOLERANCE,
        ),
    )


def _suite_table(cases: Sequence[FailureCase], outcomes: Mapping[str, FailureOutcome]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for case in cases:
        o = outcomes[case.name]
        others = (o.errors[name] for name in OTHERS)
        rows.append((case.name, o.errors[NESTED], o.residual, o.iterations, o.strain, o.reason, case.refused, *others))
    return Table(
        title="The failure suite",
        columns=(
            Column(name="case"),
            Column(name="error", format=".1e", meaning="relative, of the displacement"),
            Column(name="residual", format=".1e"),
            Column(name="iterations", format="d"),
            Column(name="u/h", format=".2f"),
            Column(name="flagged for"),
            Column(name="must be flagged"),
            *(Column(name=f"error of {name}", format=".1e") for name in OTHERS),
        ),
        rows=tuple(rows),
    )


def _verdict(outcomes: Mapping[str, FailureOutcome], ordinary: Mapping[str, float]) -> tuple[str, ...]:
    worst = max(outcomes, key=lambda name: outcomes[name].errors[NESTED])
    broken = {name: sum(o.errors[name] > 2 * contact.TOLERANCE for o in outcomes.values()) for name in OTHERS}
    most = max(o.iterations for o in outcomes.values())
    return (
        f"The package's solver is furthest from the float64 solution at '{worst}', by "
        f"{outcomes[worst].errors[NESTED]:.1e}; it takes at most {most} iterations in the suite.",
        f"Of {len(outcomes)} cases, more than twice the tolerance off: "
        + ", ".join(f"{name} in {count}" for name, count in broken.items())
        + ".",
        f"Of {ordinary['good scenes']} ordinary good scenes {ordinary['flagged share']:.1%} are flagged; the residual "
        f"never understates the error by more than {ordinary['worst error over residual']:.1f} ×.",
    )


_OTHERS = {name: jax.jit(solve) for name, solve in OTHERS.items()}


def _solve(
    gap: jax.Array, force: jax.Array, gel: jax.Array, body: jax.Array, spacing_mm: float, thickness_mm: float
) -> contact.Contact:
    return contact.solve(gap, force, gel, body, spacing_mm, thickness_mm=thickness_mm)


DEFAULT = StabilityContactConfig()
SMOKE = StabilityContactConfig(
    grid=32,
    adhesion_grid=64,
    scenes=40,
    forces_n=(0.01, 1.0),
    roughness=(0.0, 2.0),
    thickness_mm=(0.3, 5.0),
)

EXPERIMENT = Experiment(name="stability_contact", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
