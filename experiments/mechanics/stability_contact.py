"""Where does each contact method break, and does it say so?

    python -m experiments stability_contact [--scale smoke]

The failure suite, a map of the error over force and roughness and one over force and thickness for every method, and
ordinary scenes by the hundreds; and the force up to which adhesion matters, which no scene models, compared with the
force up to which the generator flags it.  The error is that of the gel's displacement, compared with the float64
solution on the same grid; a frame that errs by more than twice the tolerance must be flagged, and so must a scene to
which small-strain theory does not apply; an ordinary good scene must not be.

Cost: half a minute on two cores (`smoke` ten seconds).

Expected: springs err by tens of per cent everywhere, the loosely stopped plain solver errs by more than it reports in
every third case, and the package's solver nowhere without a flag.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.pictures import Heatmap, heatmaps
from experiments.core.results import Cell, Picture, Requirement, Results, Table, named_table
from experiments.core.runner import Experiment
from experiments.mechanics import adhesion, contact_scenes
from experiments.mechanics.contact_methods import polonsky_keer, spg_plain, winkler_and_response
from experiments.mechanics.contact_scenes import GEL, SIDE_MM, ContactScenes, FailureCase, displacement_error, exact
from sensors_io.scenes import contact
from sensors_io.scenes.sensors import GELSIGHT_MINI
from sensors_io.scenes.validity import STRAIN_LIMIT

SENSOR = GELSIGHT_MINI
NESTED = "nested SPG"
OTHERS = {
    "Winkler + response": jax.jit(winkler_and_response),
    "PK-25": jax.jit(polonsky_keer(25)),
    "plain SPG, published stop": jax.jit(spg_plain(contact.TOLERANCE, True)),
}
MOST_ERROR = 2 * contact.TOLERANCE
"""Error above which a frame must be flagged."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityContactConfig:
    """Scenes of the study.

    Args:
      grid: side of the contact grids.
      adhesion_grid: side of the grids of the adhesive presses.
      scenes: number of ordinary ones.
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
    """Error of every method on one scene; validity and convergence that the package's solver reports."""

    errors: Mapping[str, float]
    finite: bool
    flagged: bool
    reason: str
    residual: float
    iterations: int
    strain: float


def run(config: StabilityContactConfig, context: Context) -> Results:
    """Suite, maps, ordinary scenes, adhesion."""
    cases = contact_scenes.failure_suite(config.grid)
    suite = {case.name: attempt(case) for case in context.each("cases", cases)}
    maps = {name: sweep(name, cells, context) for name, cells in swept_cases(config).items()}
    ordinary = ordinary_scenes(config, context)
    adhesive = adhesion.thresholds(config.adhesion_grid, context)
    every = [*suite.values(), *(outcome for outcomes in maps.values() for row in outcomes for outcome in row)]
    silent = sum(o.errors[NESTED] > MOST_ERROR and not o.flagged for o in every)
    missed = sum(case.must_flag and not suite[case.name].flagged for case in cases)
    adhesion_ratio = max(row["counts over flagged"] for row in adhesive)
    measured = {
        "frames with a NaN": (sum(not o.finite for o in every) + ordinary["not finite"], 0),
        "frames off by > 2 × tolerance and not flagged": (silent + ordinary["silent"], 0),
        "scenes beyond the theory and not flagged": (missed, 0),
        "force up to which adhesion counts, over that up to which it is flagged": (adhesion_ratio, 1.0),
        "ordinary good scenes flagged": (ordinary["flagged share"], 0.02),
    }
    return Results(
        verdict=_verdict(suite, ordinary),
        requirements=tuple(
            Requirement(name=name, measured=float(found), bound=bound, better="lower")
            for name, (found, bound) in measured.items()
        ),
        tables=(_suite_table(cases, suite), adhesion.threshold_table(adhesive)),
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
    fields = {name: solve(gap, force[0], gel, gel, spacing)[0] for name, solve in OTHERS.items()}
    fields |= {NESTED: found.displacement_mm}
    valid = found.validity
    failed = {"not converged": valid.converged, "strain": valid.small_strain, "unresolved": valid.resolved}
    return FailureOutcome(
        errors={name: float(displacement_error(np.asarray(u)[None], true)[0]) for name, u in fields.items()},
        finite=all(bool(np.all(np.isfinite(leaf))) for leaf in jax.tree.leaves(found)),
        flagged=not bool(valid.all),
        reason=", ".join(name for name, ok in failed.items() if not ok) or "–",
        residual=float(found.residual),
        iterations=int(found.iterations),
        strain=float(found.strain),
    )


def swept_cases(config: StabilityContactConfig) -> dict[str, list[list[FailureCase]]]:
    """Cases of the maps, parameter × force: a rough sphere of other roughness, and on gels of other thickness."""
    x = (np.arange(config.grid) + 0.5) * SIDE_MM / config.grid - SIDE_MM / 2
    smooth = (x[None] ** 2 + x[:, None] ** 2) / 40
    rough = contact_scenes.rough_sphere(np.random.default_rng(config.seed), config.grid)
    gaps = [smooth + factor * (rough - smooth) for factor in config.roughness]
    gels = [dataclasses.replace(GEL, thickness_mm=h) for h in config.thickness_mm]
    case = lambda force, gap=rough, gel=GEL: FailureCase(name="", gap_mm=gap, force_n=force, gel=gel)
    return {
        "roughness": [[case(force, gap=gap) for force in config.forces_n] for gap in gaps],
        "thickness": [[case(force, gel=gel) for force in config.forces_n] for gel in gels],
    }


def sweep(title: str, cells: list[list[FailureCase]], context: Context) -> list[list[FailureOutcome]]:
    """Outcomes of the cases of a map."""
    done = iter([attempt(case) for case in context.each(title, itertools.chain(*cells))])
    return [[next(done) for _ in row] for row in cells]


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


# Report --------------------------------------------------------------------------------------------------------------


def _verdict(suite: Mapping[str, FailureOutcome], ordinary: Mapping[str, float]) -> tuple[str, ...]:
    worst = max(suite, key=lambda name: suite[name].errors[NESTED])
    broken = {name: sum(o.errors[name] > MOST_ERROR for o in suite.values()) for name in OTHERS}
    return (
        f"The package's solver deviates most from the float64 solution at '{worst}', by "
        f"{suite[worst].errors[NESTED]:.1e}; it takes at most {max(o.iterations for o in suite.values())} iterations "
        "in the suite.",
        f"Number of the {len(suite)} cases in which a method errs by more than twice the tolerance: "
        + ", ".join(f"{name} {count}" for name, count in broken.items())
        + ".",
        f"Of {ordinary['good scenes']} ordinary good scenes {ordinary['flagged share']:.1%} are flagged; the error is "
        f"at most {ordinary['worst error over residual']:.1f} × the residual.",
    )


def _suite_table(cases: Sequence[FailureCase], suite: Mapping[str, FailureOutcome]) -> Table:
    rows: list[dict[str, Cell]] = [
        {
            "case": case.name,
            "error": o.errors[NESTED],
            "residual": o.residual,
            "iterations": o.iterations,
            "u/h": o.strain,
            "flagged for": o.reason,
            "must be flagged": case.must_flag,
            **{f"error of {name}": o.errors[name] for name in OTHERS},
        }
        for case, o in zip(cases, suite.values(), strict=True)
    ]
    errors = dict.fromkeys(("error", "residual", *(f"error of {name}" for name in OTHERS)), ".1e")
    return named_table(
        "The failure suite",
        rows,
        formats={"iterations": "d", "u/h": ".2f", **errors},
        meanings={"error": "relative, of the displacement"},
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
                    np.nan_to_num([[o.errors[method] for o in row] for row in cells], nan=1.0, posinf=1.0),
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


DEFAULT = StabilityContactConfig()
SMOKE = StabilityContactConfig(
    grid=32, adhesion_grid=64, scenes=40, forces_n=(0.01, 1.0), roughness=(0.0, 2.0), thickness_mm=(0.3, 5.0)
)

EXPERIMENT = Experiment(name="stability_contact", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
