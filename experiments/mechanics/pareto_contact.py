"""What does a contact cost, and how wrong is it?

    python -m experiments pareto_contact [--scale smoke]

Every tier of the contact ladder over the same random scenes: time a frame against the error of displacement and slope,
by the float64 solution on the same grid; the package's solver on grids of 24² to 256² against the finest; closed forms
(Hertz) and published solvers (Tamaas, ContactMechanics) where they are installed.  Times are medians over rounds that
visit every method in turn, so that a load on the machine strikes all alike; the ratio to the plain solver is taken
within each round.  One minute on two cores (`smoke` half a minute).  Expected: the nested, preconditioned solver at
1e-3 takes less than .65 of the plain one's time, at a slope error below 5 % in 95 of 100 scenes.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import zoom

from experiments.core.charts import Point, speed_against_error
from experiments.core.context import Context
from experiments.core.results import Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.core.timing import interleaved
from experiments.mechanics import contact_checks
from experiments.mechanics import oracles as contact_oracles
from experiments.mechanics.contact_methods import (
    ContactMethod,
    blur,
    polonsky_keer,
    spg_nested,
    spg_plain,
    winkler_and_response,
    winkler_only,
)
from experiments.mechanics.contact_scenes import (
    ContactScenes,
    GelKernels,
    displacement_error,
    exact,
    gel_kernels,
    sample,
    slope_error,
)
from sensors_io.scenes.contact import convolve
from sensors_io.scenes.sensors import GELSIGHT_MINI, SensorModel

SENSOR: SensorModel = GELSIGHT_MINI
"""The one whose gel asks for most padding."""

MAIN, BASELINE = "nested 1e-3", "plain 1e-3"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParetoContactConfig:
    """Scenes and side of the main grid; sides of the ladder of grids and its scenes; rounds of timing."""

    scenes: int = 48
    grid: int = 128
    ladder: tuple[int, ...] = (24, 32, 48, 64, 96, 128, 192, 256)
    ladder_scenes: int = 16
    rounds: int = 9
    oracle_scenes: int = 6
    seed: int = 3


def methods() -> tuple[ContactMethod, ...]:
    """The tiers, cheapest first within each kind."""
    nested = [ContactMethod(name=f"nested {t}", kind="nested SPG", solve=spg_nested(float(t))) for t in _TOLERANCES]
    plain = [ContactMethod(name=f"plain {t}", kind="plain SPG", solve=spg_plain(float(t), False)) for t in _TOLERANCES]
    return (
        ContactMethod(name="Winkler", kind="no iteration", solve=winkler_only),
        ContactMethod(name="blur", kind="no iteration", solve=blur),
        ContactMethod(name="Winkler + response", kind="no iteration", solve=winkler_and_response),
        *nested,
        *plain,
        ContactMethod(name="plain 1e-3 as published", kind="published stop", solve=spg_plain(1e-3, True)),
        ContactMethod(name="PK-25", kind="Polonsky–Keer", solve=polonsky_keer(25)),
    )


def run(config: ParetoContactConfig, context: Context) -> Results:
    """Measure, compare, chart."""
    context.print(f"{config.scenes} scenes at {config.grid}², float64 solutions first")
    kernels, scenes = gel_kernels(SENSOR, config.grid), sample(SENSOR, config.scenes, config.grid, config.seed)
    rows = measure(methods(), scenes, kernels, config.rounds, context)
    ladder = grid_ladder(config, context)
    drawn = context.each("other solvers' scenes", range(config.oracle_scenes))
    oracles = contact_checks.against_oracles(drawn, config.grid // 2, config.seed)
    published = contact_checks.published(config.oracle_scenes, config.grid, config.seed, context)
    hertz = contact_checks.hertz(config.grid, context)
    main = rows[MAIN]
    return Results(
        verdict=verdict(rows, hertz),
        requirements=requirements(rows, oracles, hertz),
        tables=(_tier_table(rows, config), _ladder_table(ladder), contact_checks.oracle_table(oracles), published),
        pictures=(_picture(rows), _ladder_picture(ladder)),
        settings={
            "sensor": SENSOR.name,
            "grid": config.grid,
            "padded grid": kernels.gel.shape[0],
            "oracles installed": ", ".join(contact_oracles.installed()) or "none",
            "convolutions a frame": f"{main['convolutions']:.1f} of {MAIN}, {rows[BASELINE]['convolutions']:.1f} of "
            f"{BASELINE}",
            "floor": f"{main['convolutions']:.1f} pruned convolutions of "
            f"{_convolution_ms(kernels, config.grid):.3f} ms",
        },
    )


def measure(
    tiers: tuple[ContactMethod, ...], scenes: ContactScenes, kernels: GelKernels, rounds: int, context: Context
) -> dict[str, dict[str, Any]]:
    """Time, ratio to the baseline, convolutions and errors of every method."""
    true = exact(context.each("exact scenes", scenes), kernels)
    calls = {m.name: _call(m, scenes, kernels) for m in tiers}
    found = {name: jax.device_get(call()) for name, call in context.each("compiling methods", calls.items())}
    seconds = interleaved(calls, context.rounds("timing methods", rounds))
    baseline = seconds[BASELINE]
    rows: dict[str, dict[str, Any]] = {}
    for method in tiers:
        u, convolutions = found[method.name]
        errors = {"u": displacement_error(u, true), "slope": slope_error(u, true)}
        rows[method.name] = {
            "kind": method.kind,
            "ms": 1e3 * float(np.median(seconds[method.name])) / len(scenes),
            "ratio": float(np.median(seconds[method.name] / baseline)),
            "convolutions": float(np.mean(convolutions)),
            **{f"{k} median": float(np.median(e)) for k, e in errors.items()},
            **{f"{k} p95": float(np.quantile(e, 0.95)) for k, e in errors.items()},
            "worst u": float(errors["u"].max()),
        }
    return rows


def grid_ladder(config: ParetoContactConfig, context: Context) -> dict[int, dict[str, float]]:
    """The package's solver on every grid, by its solution on the finest one."""
    finest = max(config.ladder)
    tiers = {str(n): (1e-3, n) for n in config.ladder} | {_EXACT: (1e-4, finest)}
    calls, found = {}, {}
    for name, (tolerance, n) in context.each("compiling grids", tiers.items()):
        calls[name] = _on_grid(tolerance, n, config)
        found[name] = np.asarray(calls[name]()[0], np.float64)
    true = found[_EXACT]
    del calls[_EXACT]
    seconds = interleaved(calls, context.rounds("timing grids", config.rounds))
    ladder = {}
    for n in context.each("comparing grids", config.ladder):
        up = np.stack([zoom(u, finest / n, order=3, mode="nearest", grid_mode=True) for u in found[str(n)]])
        slope, displacement = slope_error(up, true), displacement_error(up, true)
        ladder[n] = {
            "ms": 1e3 * float(np.median(seconds[str(n)])) / config.ladder_scenes,
            "u": float(np.median(displacement)),
            "slope": float(np.median(slope)),
            "slope p95": float(np.quantile(slope, 0.95)),
        }
    return ladder


def requirements(
    rows: Mapping[str, Mapping[str, Any]], oracles: Mapping[str, float], hertz: Mapping[str, float]
) -> tuple[Requirement, ...]:
    """The figures that must be kept."""
    main = rows[MAIN]
    published = main["ms"] / rows["plain 1e-3 as published"]["ms"]
    return (
        Requirement(name=f"{MAIN}: time a frame", measured=main["ms"], bound=2.5, better="lower", unit="ms"),
        Requirement(
            name=f"{MAIN}: time against {BASELINE}",
            measured=main["ratio"],
            bound=0.65,
            better="lower",
            note=f"both stop on the same residual; {published:.2f} of the plain solver with its looser published stop",
        ),
        Requirement(
            name=f"{MAIN}: slope error, 95th percentile", measured=main["slope p95"], bound=0.05, better="lower"
        ),
        Requirement(name="Hertz exponent, off 1.5 by", measured=hertz["exponent"], bound=0.002, better="lower"),
        Requirement(name="Hertz peak pressure, a/dx ≥ 4", measured=hertz["peak"], bound=0.01, better="lower"),
        *(
            Requirement(name=f"pressure against {name}", measured=error, bound=1e-3, better="lower")
            for name, error in oracles.items()
        ),
    )


def verdict(rows: Mapping[str, Mapping[str, Any]], hertz: Mapping[str, float]) -> tuple[str, ...]:
    """The answer in sentences."""
    main, base, cheap = rows[MAIN], rows[BASELINE], rows["Winkler"]
    return (
        f"{MAIN} takes {main['ms']:.2f} ms a frame with {main['convolutions']:.1f} convolutions, {main['ratio']:.2f} "
        f"of the plain solver's time ({base['ms']:.2f} ms, {base['convolutions']:.1f} convolutions), and errs by "
        f"{main['u median']:.1e} in displacement and {main['slope median']:.1e} in slope (median).",
        f"Springs alone take {cheap['ms']:.2f} ms and err by {cheap['u median']:.0%} and {cheap['slope median']:.0%}: "
        "no cheap tier is a step of a useful ladder; grid and tolerance are.",
        f"Against Hertz the force grows with depth to the power 1.5 within {hertz['exponent']:.4f}, and the peak "
        f"pressure is right within {hertz['peak']:.2%} from four pixels per contact radius on.",
    )


def _on_grid(tolerance: float, grid: int, config: ParetoContactConfig) -> Callable[[], Any]:
    """The scenes of the ladder of grids on one of them, by the package's solver."""
    method = ContactMethod(name="nested", kind="", solve=spg_nested(tolerance))
    return _call(method, sample(SENSOR, config.ladder_scenes, grid, config.seed + 1), gel_kernels(SENSOR, grid))


_EXACT = "finest"  # by which the others are judged
_TOLERANCES = ("1e-2", "1e-3", "1e-4", "1e-5")


def _call(method: ContactMethod, scenes: ContactScenes, kernels: GelKernels) -> Callable[[], Any]:
    """All scenes of a method, compiled, one after the other."""
    gel, body = jnp.asarray(kernels.gel, jnp.float32), jnp.asarray(kernels.body, jnp.float32)
    inputs = tuple(map(jnp.asarray, (scenes.gap_mm, scenes.force_n, scenes.modulus_mpa)))

    def solve(scene: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        gap, force, modulus = scene
        return method.solve(gap, force, gel, gel + body / modulus, kernels.spacing_mm)

    every = jax.jit(lambda scenes: jax.lax.map(solve, scenes))
    return lambda: every(inputs)


def _convolution_ms(kernels: GelKernels, grid: int, repeats: int = 50) -> float:
    """Time of one pruned convolution, the floor's unit."""
    spectrum = jnp.asarray(kernels.gel / kernels.gel.max(), jnp.float32)
    field = jnp.ones((grid, grid), jnp.float32)
    chain = jax.jit(lambda p: jax.lax.fori_loop(0, repeats, lambda _, q: convolve(q, spectrum), p))
    jax.block_until_ready(chain(field))
    return 1e3 / repeats * float(np.median(interleaved({"": lambda: chain(field)}, range(7))[""]))


def _tier_table(rows: Mapping[str, Mapping[str, Any]], config: ParetoContactConfig) -> Table:
    names = ("ms", "ratio", "convolutions", "u median", "u p95", "slope median", "slope p95")
    return Table(
        title=f"Tiers at {config.grid}², {config.scenes} random scenes",
        columns=(
            Column(name="method"),
            Column(name="time", unit="ms", format=".2f"),
            Column(name="against plain 1e-3", format=".2f", meaning="median over rounds of the ratio within a round"),
            Column(name="convolutions", format=".1f", meaning="padded, on this grid, mean over scenes"),
            *(Column(name=n, format=".1e") for n in names[3:]),
        ),
        rows=tuple((name, *(row[n] for n in names)) for name, row in rows.items()),
        note="Errors are relative L₂, by the float64 solution on the same grid.",
    )


def _ladder_table(ladder: Mapping[int, Mapping[str, float]]) -> Table:
    return Table(
        title="The package's solver at 1e-3 on every grid",
        columns=(
            Column(name="grid"),
            Column(name="time", unit="ms", format=".2f"),
            *(Column(name=n, format=".1e") for n in ("u", "slope", "slope p95")),
        ),
        rows=tuple((f"{n}²", r["ms"], r["u"], r["slope"], r["slope p95"]) for n, r in ladder.items()),
        note=f"Errors by the solution on {max(ladder)}², to which the others are interpolated by cubic splines.",
    )


def _picture(rows: Mapping[str, Mapping[str, Any]]) -> Picture:
    groups: dict[str, list[Point]] = {}
    for name, row in rows.items():
        label = name.removeprefix("nested ").removeprefix("plain ")
        groups.setdefault(row["kind"], []).append((label, row["ms"], row["slope median"], row["slope p95"]))
    return Picture(
        name="pareto_contact",
        title="Speed against error",
        caption="Slope error by the float64 solution on the same grid; bars reach from median to 95th percentile; the "
        "dotted corner is what is required of tolerance 1e-3.",
        content=speed_against_error(groups, "slope error", (2.5, 0.05)),
    )


def _ladder_picture(ladder: Mapping[int, Mapping[str, float]]) -> Picture:
    points = [(f"{n}²", r["ms"], max(r["slope"], 1e-4), max(r["slope p95"], 1e-4)) for n, r in ladder.items()]
    return Picture(
        name="pareto_grid",
        title="The ladder that is useful: the grid",
        caption="Slope error by the finest grid's solution at 1e-4; bars reach from median to 95th percentile. The "
        "finest grid shows its tolerance alone.",
        content=speed_against_error({"nested 1e-3": points}, "slope error", None),
    )


DEFAULT = ParetoContactConfig()
SMOKE = ParetoContactConfig(scenes=8, grid=64, ladder=(24, 32, 64), ladder_scenes=4, rounds=3, oracle_scenes=2)

EXPERIMENT = Experiment(name="pareto_contact", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
