"""The chooser at work: on measured scenes against the best setting in hindsight, and on generated sequences."""

import dataclasses
import functools
import operator
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array

from experiments.core.timing import median_ms
from experiments.mechanics import chooser_measure as measured
from experiments.mechanics.chooser_measure import REFERENCE_GRID, REFERENCE_PADDING, REFERENCE_TOLERANCE, SceneBatch
from sensors_io.scenes import chooser, contact, effort, nested, protocol
from sensors_io.scenes.chooser_law import MENU, SLACK, Setting
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.draws import Draw, draw
from sensors_io.scenes.press import GridSizes, Kernels, Path, Press, Scene, make_kernels
from sensors_io.scenes.readout import Unit
from sensors_io.scenes.sensors import MODELS, SensorModel

SHARE = 0.95
"""Share of the promises that must be kept."""

FRAMES = 6
"""Frames of a sequence that are compared."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ChooserTrial:
    """One requested error, over S scenes: index of the setting in `MENU`, whether it is promised to be met, error [S].

    `best` is the index of the cheapest setting that meets the error in hindsight, −1 where none does.  `seconds` and
    `hindsight` are times of the chooser and of the settings in hindsight, from scratch, over the `possible` scenes of
    each batch, those with such a setting, [B].
    """

    asked: float
    index: np.ndarray
    met: np.ndarray
    error: np.ndarray
    best: np.ndarray
    seconds: np.ndarray
    hindsight: np.ndarray
    possible: np.ndarray


def in_hindsight(errors: np.ndarray, cost: np.ndarray, asked: float) -> np.ndarray:
    """Index of the cheapest setting that meets the error, −1 where none does, [S]."""
    enough = errors <= asked
    return np.where(enough.any(1), np.where(enough, cost, np.inf).argmin(1), -1)


def try_out(
    batch: SceneBatch, menu: tuple[Setting, ...], errors: np.ndarray, cost: np.ndarray, asked: float, true: Array
) -> ChooserTrial:
    """Let the chooser solve all scenes, then time it against hindsight on those that some setting meets."""
    best = in_hindsight(errors, cost, asked)
    solved = chooser.solve_many(asked, batch.gaps, batch.force_n, batch.modulus_mpa, batch.stage)
    achieved = np.empty(len(best))
    for bucket in solved.buckets:
        achieved[bucket.rows] = measured.errors_of(bucket.contacts.displacement_mm, true[bucket.rows])
    possible = np.nonzero(best >= 0)[0]
    ms = _race(batch, menu, best, possible, asked) if len(possible) else {"chooser": 0.0, "hindsight": 0.0}
    settings = [Setting(grid=c.grid, padded=c.padded, tolerance=c.tolerance) for c in solved.choices]
    return ChooserTrial(
        asked=asked,
        index=np.array([MENU.index(s) for s in settings]),
        met=np.array([c.met for c in solved.choices]),
        error=achieved,
        best=best,
        seconds=np.array([ms["chooser"] / 1e3]),
        hindsight=np.array([ms["hindsight"] / 1e3]),
        possible=np.array([len(possible)]),
    )


def _race(
    batch: SceneBatch, menu: tuple[Setting, ...], best: np.ndarray, possible: np.ndarray, asked: float
) -> dict[str, float]:
    """Milliseconds of the chooser and of hindsight over the same scenes, medians of interleaved rounds."""
    some = lambda grid, rows: batch.gaps(grid, possible[rows])
    given = batch.force_n[possible], batch.modulus_mpa[possible]
    work = [(menu[i], possible[best[possible] == i]) for i in np.unique(best[possible])]
    calls = {
        "chooser": lambda: chooser.solve_many(asked, some, *given, batch.stage).buckets[0].contacts.residual,
        "hindsight": lambda: [measured.from_scratch(batch, setting, rows) for setting, rows in work],
    }
    return median_ms(calls, range(measured.ROUNDS))


def summary(trial: ChooserTrial, errors: np.ndarray, cost: np.ndarray) -> dict[str, float | None]:
    """The figures of a trial by column; times are ms a scene, `None` where no single setting serves all scenes."""
    kept = trial.error <= SLACK * trial.asked
    possible, reachable = trial.best >= 0, (errors <= SLACK * trial.asked).any(1)
    scenes = max(int(trial.possible.sum()), 1)
    serves_all = (errors <= SLACK * trial.asked).mean(0) >= SHARE
    return {
        "asked": trial.asked,
        "kept": float(kept[trial.met].mean()) if trial.met.any() else 1.0,
        "kept of all": float(kept.mean()),
        "flagged": float(1 - trial.met.mean()),
        "unreachable": float(1 - possible.mean()),
        "flagged in vain": float((~trial.met & possible).mean()),
        "beyond promise": float(1 - reachable.mean()),
        "median error": float(np.median(trial.error)),
        "p95": float(np.quantile(trial.error, 0.95)),
        "time": 1e3 * float(trial.seconds.sum()) / scenes,
        "hindsight": 1e3 * float(trial.hindsight.sum()) / scenes,
        "ratio": float(trial.seconds.sum() / trial.hindsight.sum()) if possible.any() else 1.0,
        "fixed": float(cost[serves_all].min()) if serves_all.any() else None,
    }


# Generated sequences with a requested error (`SceneConfig.error`) ----------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class SequenceTrial:
    """One requested error, over S sequences: grid [S], whether it is promised [S], error of frames [S, FRAMES]."""

    asked: float
    grid: np.ndarray
    met: np.ndarray
    error: np.ndarray

    @property
    def kept(self) -> np.ndarray:
        """Bool [S, FRAMES], frames within the promised multiple of the requested error."""
        return np.asarray(self.error <= SLACK * self.asked)

    @property
    def kept_share(self) -> float:
        """Share of these frames in the sequences that are promised to be met."""
        return float(self.kept[self.met].mean()) if self.met.any() else 1.0


def try_sequences(order: int, count: int, asked: Sequence[float], seed: int) -> list[SequenceTrial]:
    """Choose and solve `count` sequences of sensor `order` at every requested error, presses and motions in turn.

    Frames are drawn from those that touch, so most are not among the few that `effort.choose` looks at, and are solved
    as `press.record` solves them.
    """
    config = SceneConfig(objects=count, sequences=2 * count * len(MODELS), frames=20, seed=seed)
    rng = np.random.default_rng([seed, order])
    chosen = range(0, config.contact_count, 2)
    drawn = [draw(config, index, protocol.slot(config, index), order) for index in chosen]
    sides, paths, true = GridSizes(contact_grid=REFERENCE_GRID, image_px=REFERENCE_GRID), [], []
    for each in drawn:
        touching = np.nonzero(np.asarray(each.press.path.force_n) > 0)[0]
        frames = np.sort(rng.choice(touching, FRAMES, replace=len(touching) < FRAMES))
        path = jax.tree.map(operator.itemgetter(frames), each.press.path)
        kernels = _reference_kernels(each.sensor)
        found = _solve(each.press, path, each.unit, kernels, REFERENCE_TOLERANCE, each.sensor, sides)
        paths.append(path)
        true.append(jax.vmap(lambda u: nested.coarsen(u, 2))(found))  # on half the reference's grid, [FRAMES, K, K]
    return [_solve_at(error, drawn, paths, true) for error in asked]


def _solve_at(asked: float, drawn: Sequence[Draw], paths: Sequence[Path], true: Sequence[Array]) -> SequenceTrial:
    efforts = [effort.choose(asked, d.press, d.unit.modulus_factor, d.sensor) for d in drawn]
    errors = []
    for each, path, how, exact in zip(drawn, paths, efforts, true, strict=True):
        grid = GridSizes(contact_grid=how.grid, image_px=how.grid)
        found = _solve(each.press, path, each.unit, make_kernels(each.sensor, grid), how.tolerance, each.sensor, grid)
        errors.append(measured.errors_of(found, exact))
    return SequenceTrial(
        asked=asked,
        grid=np.array([e.grid for e in efforts]),
        met=np.array([e.met for e in efforts]),
        error=np.stack(errors),
    )


@functools.lru_cache(maxsize=2)
def _reference_kernels(sensor: SensorModel) -> Kernels:
    """Kernels of the normal contact alone, with the padding of the reference solution."""
    padded, spacing = round(REFERENCE_GRID * REFERENCE_PADDING), sensor.window_mm / REFERENCE_GRID
    gel, body = measured.spectra(sensor, padded, spacing)
    coarse = make_kernels(sensor, GridSizes(contact_grid=effort.GRIDS[0], image_px=effort.GRIDS[0]))
    return dataclasses.replace(coarse, gel=gel, body=body)


@functools.partial(jax.jit, static_argnames=("sensor", "grid"))
def _solve(
    press: Press, path: Path, unit: Unit, kernels: Kernels, tolerance: float, sensor: SensorModel, grid: GridSizes
) -> Array:
    """Displacement of every frame of a path, [F, n, n]."""
    scene = Scene(press, unit, kernels, sensor, grid, (tolerance, contact.MAX_ITERATIONS))
    return jax.lax.map(lambda at: scene.solve(scene.gap(at), at.force_n).displacement_mm, path)
