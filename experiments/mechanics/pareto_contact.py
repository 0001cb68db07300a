"""How fast and how accurate is each contact method?

    python -m experiments pareto_contact [--scale smoke]

Measures time per frame and error of displacement and slope of every method on the same random scenes, compared with the
float64 solution on the same grid; the package's solver on grids of 24² to 256² against the finest; closed forms (Hertz)
and published solvers (Tamaas, ContactMechanics) where they are installed.  Times are medians over interleaved rounds,
so that other load on the machine affects all methods alike; the ratio to the plain solver is taken within each round.

Cost: one minute on two cores (`smoke` half a minute).

Expected: the nested, preconditioned solver at 1e-3 takes less than .65 of the plain one's time, at a slope error below
5 % in 95 of 100 scenes.
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
from experiments.core.results import Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.core.timing import interleaved, median_ms
from experiments.mechanics import contact_oracles, contact_scenes
from experiments.mechanics.contact_methods import METHODS, ContactSolver
from experiments.mechanics.contact_scenes import ContactScenes, GelKernels, displacement_error, slope_error
from sensors_io.scenes.contact import convolve
from sensors_io.scenes.sensors import GELSIGHT_MINI

SENSOR = GELSIGHT_MINI
"""The sensor whose gel needs the widest padding."""

MAIN, BASELINE, PUBLISHED_STOP = "nested 1e-3", "plain 1e-3", "plain 1e-3 as published"

Rows = Mapping[str, Mapping[str, float]]
"""Method → its figures."""


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


def run(config: ParetoContactConfig, context: Context) -> Results:
    """Measure, compare, chart."""
    context.print(f"{config.scenes} scenes at {config.grid}², float64 solutions first")
    kernels = contact_scenes.gel_kernels(SENSOR, config.grid)
    scenes = contact_scenes.sample_scenes(SENSOR, config.scenes, config.grid, config.seed)
    rows = measure(scenes, kernels, config.rounds, context)
    ladder = grid_ladder(config, context)
    oracles = contact_oracles.oracle_errors(config.oracle_scenes, config.grid // 2, config.seed, context)
    published = contact_oracles.solver_table(config.oracle_scenes, config.grid, config.seed, context)
    hertz = contact_oracles.hertz(config.grid, context)
    main, base, ratio_to_base = rows[MAIN], rows[BASELINE], rows[MAIN][f"against {BASELINE}"]
    ratio = main["time"] / rows[PUBLISHED_STOP]["time"]
    note = f"both stop on the same residual; {ratio:.2f} of the plain solver with its looser published stop"
    return Results(
        verdict=(
            f"{MAIN} takes {ratio_to_base:.2f} of the plain solver's time per frame, at a median slope error of "
            f"{main['slope median']:.1e}; springs alone err by {rows['Winkler']['slope median']:.0%}.",
        ),
        requirements=(
            at_most(f"{MAIN}: time a frame", main["time"], 2.5, "ms"),
            at_most(f"{MAIN}: time against {BASELINE}", ratio_to_base, 0.65, note=note),
            at_most(f"{MAIN}: slope error, 95th percentile", main["slope p95"], 0.05),
            at_most("Hertz exponent, off 1.5 by", hertz["exponent"], 0.002),
            at_most("Hertz peak pressure, a/dx ≥ 4", hertz["peak"], 0.01),
            *(at_most(f"pressure against {name}", error, 1e-3) for name, error in oracles.items()),
        ),
        tables=(*_tables(rows, ladder, config), contact_oracles.oracle_table(oracles), published),
        pictures=_pictures(rows, ladder),
        settings={
            "sensor": SENSOR.name,
            "grid": config.grid,
            "padded grid": kernels.gel.shape[0],
            "oracles installed": ", ".join(s.package for s in contact_oracles.installed().values()) or "none",
            "convolutions a frame": f"{main['convolutions']:.1f} of {MAIN}, {base['convolutions']:.1f} of {BASELINE}",
            "floor": f"{main['convolutions']:.1f} pruned convolutions of {convolution_ms(kernels, config.grid):.3f} ms",
        },
    )


def measure(scenes: ContactScenes, kernels: GelKernels, rounds: int, context: Context) -> dict[str, dict[str, float]]:
    """Time (ms per frame), ratio to the baseline, convolutions and relative errors of every method."""
    true = contact_scenes.exact(context.each("exact scenes", zip(*scenes, strict=True)), kernels)
    calls = {name: _solve_all(method.solve, scenes, kernels) for name, method in METHODS.items()}
    found = {name: jax.device_get(call()) for name, call in context.each("compiling methods", calls.items())}
    seconds = interleaved(calls, context.rounds("timing methods", rounds))
    return {
        name: {
            "time": 1e3 * float(np.median(seconds[name])) / len(scenes.force_n),
            f"against {BASELINE}": float(np.median(seconds[name] / seconds[BASELINE])),
            "convolutions": float(np.mean(convolutions)),
            **_median_and_p95("u", displacement_error(u, true)),
            **_median_and_p95("slope", slope_error(u, true)),
        }
        for name, (u, convolutions) in found.items()
    }


def _median_and_p95(name: str, errors: np.ndarray) -> dict[str, float]:
    return {f"{name} median": float(np.median(errors)), f"{name} p95": float(np.quantile(errors, 0.95))}


def grid_ladder(config: ParetoContactConfig, context: Context) -> dict[int, dict[str, float]]:
    """Time and error of the package's solver on every grid, compared with its solution at 1e-4 on the finest one."""
    finest = max(config.ladder)
    tiers = {n: ("nested 1e-3", n) for n in config.ladder} | {0: ("nested 1e-4", finest)}
    calls, found = {}, {}
    for key, (method, n) in context.each("compiling grids", tiers.items()):
        scenes = contact_scenes.sample_scenes(SENSOR, config.ladder_scenes, n, config.seed + 1)
        calls[key] = _solve_all(METHODS[method].solve, scenes, contact_scenes.gel_kernels(SENSOR, n))
        found[key] = np.asarray(calls[key]()[0], np.float64)
    seconds = interleaved({str(n): calls[n] for n in config.ladder}, context.rounds("timing grids", config.rounds))
    ladder = {}
    for n in context.each("comparing grids", config.ladder):
        up = np.stack([zoom(u, finest / n, order=3, mode="nearest", grid_mode=True) for u in found[n]])
        slope = slope_error(up, found[0])
        ladder[n] = {
            "time": 1e3 * float(np.median(seconds[str(n)])) / config.ladder_scenes,
            "u": float(np.median(displacement_error(up, found[0]))),
            "slope": float(np.median(slope)),
            "slope p95": float(np.quantile(slope, 0.95)),
        }
    return ladder


def convolution_ms(kernels: GelKernels, grid: int, repeats: int = 50) -> float:
    """Time of one pruned convolution."""
    spectrum = jnp.asarray(kernels.gel / kernels.gel.max(), jnp.float32)
    field = jnp.ones((grid, grid), jnp.float32)
    chain = jax.jit(lambda p: jax.lax.fori_loop(0, repeats, lambda _, q: convolve(q, spectrum), p))
    return median_ms({"": lambda: chain(field)}, range(7))[""] / repeats


def _solve_all(solve: ContactSolver, scenes: ContactScenes, kernels: GelKernels) -> Callable[[], Any]:
    by_total = lambda gap, force, gel, body: solve(gap, force, gel, gel + body, kernels.spacing_mm)
    return contact_scenes.batch_solver(by_total, scenes, kernels)


# Report --------------------------------------------------------------------------------------------------------------


def _tables(rows: Rows, ladder: Mapping[int, Mapping[str, float]], config: ParetoContactConfig) -> tuple[Table, ...]:
    ratio, errors = f"against {BASELINE}", ("u median", "u p95", "slope median", "slope p95")
    return (
        named_table(
            f"Tiers at {config.grid}², {config.scenes} random scenes",
            [{"method": name, **row} for name, row in rows.items()],
            formats={"time": ".2f", ratio: ".2f", "convolutions": ".1f", **dict.fromkeys(errors, ".1e")},
            units={"time": "ms"},
            meanings={
                ratio: "median over rounds of the ratio within a round",
                "convolutions": "padded, on this grid, mean over scenes",
            },
            note="Errors are relative L₂, compared with the float64 solution on the same grid.",
        ),
        named_table(
            "The package's solver at 1e-3 on every grid",
            [{"grid": f"{n}²", **row} for n, row in ladder.items()],
            formats={"time": ".2f", **dict.fromkeys(("u", "slope", "slope p95"), ".1e")},
            units={"time": "ms"},
            note=f"Errors compared with the solution on {max(ladder)}², to which the others are interpolated by cubic "
            "splines.",
        ),
    )


def _pictures(rows: Rows, ladder: Mapping[int, Mapping[str, float]]) -> tuple[Picture, Picture]:
    groups: dict[str, list[Point]] = {}
    for name, row in rows.items():
        label = name.removeprefix("nested ").removeprefix("plain ")
        groups.setdefault(METHODS[name].kind, []).append((label, row["time"], row["slope median"], row["slope p95"]))
    points = [(f"{n}²", r["time"], max(r["slope"], 1e-4), max(r["slope p95"], 1e-4)) for n, r in ladder.items()]
    return (
        Picture(
            name="pareto_contact",
            title="Speed against error",
            caption="Slope error compared with the float64 solution on the same grid; bars reach from the median to "
            "the 95th percentile; the dotted corner is the requirement for tolerance 1e-3.",
            content=speed_against_error(groups, "slope error", (2.5, 0.05)),
        ),
        Picture(
            name="pareto_grid",
            title="Speed against error by grid",
            caption="Slope error compared with the finest grid's solution at 1e-4; bars reach from the median to the "
            "95th percentile. The error of the finest grid comes from its tolerance alone.",
            content=speed_against_error({MAIN: points}, "slope error", None),
        ),
    )


SMOKE = ParetoContactConfig(scenes=8, grid=64, ladder=(24, 32, 64), ladder_scenes=4, rounds=3, oracle_scenes=2)

EXPERIMENT = Experiment(name="pareto_contact", config=ParetoContactConfig(), scales={"smoke": SMOKE}, run=run)
