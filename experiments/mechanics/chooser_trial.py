"""The chooser at work on measured scenes: what it keeps, what it flags, its time against that of hindsight."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array

from experiments.core.timing import interleaved
from experiments.mechanics import chooser_measure as measured
from experiments.mechanics.chooser_draw import SceneBatch
from sensors_io.scenes import chooser
from sensors_io.scenes.chooser_law import MENU, SLACK, Setting

SHARE = 0.95
"""Of the promises, how many must be kept."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ChooserTrial:
    """One error asked for, over S scenes: index of the setting in `MENU`, whether it is promised to be met, error [S].

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

    def to_json(self) -> dict[str, Any]:
        """Lists of numbers."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in fields.items()}


def join(parts: Sequence[Mapping[str, Any]]) -> ChooserTrial:
    """The trials of several batches at one error, each as `Trial.to_json` gives it."""
    arrays = {name: np.concatenate([np.asarray(p[name]) for p in parts]) for name in parts[0] if name != "asked"}
    return ChooserTrial(asked=parts[0]["asked"], **arrays)


def in_hindsight(errors: np.ndarray, cost: np.ndarray, asked: float) -> np.ndarray:
    """Index of the cheapest setting that meets the error, −1 where none does, [S]."""
    enough = errors <= asked
    return np.where(enough.any(1), np.where(enough, cost, np.inf).argmin(1), -1)


def try_out(
    batch: SceneBatch, menu: tuple[Setting, ...], errors: np.ndarray, cost: np.ndarray, asked: float, true: Array
) -> ChooserTrial:
    """Let the chooser solve all scenes, then time it against hindsight on those that some setting meets."""
    stage, best = measured.stage_of(batch.sensor), in_hindsight(errors, cost, asked)
    solved = chooser.solve_many(asked, batch.gaps, batch.force_n, batch.modulus_mpa, stage)
    achieved = np.empty(len(best))
    for bucket in solved.buckets:
        achieved[bucket.rows] = measured.errors_of(bucket.contacts.displacement_mm, true[bucket.rows])
    possible = np.nonzero(best >= 0)[0]
    seconds = _race(batch, menu, best, possible, asked) if len(possible) else {"chooser": 0.0, "hindsight": 0.0}
    settings = [Setting(grid=c.grid, padded=c.padded, tolerance=c.tolerance) for c in solved.choices]
    return ChooserTrial(
        asked=asked,
        index=np.array([MENU.index(s) for s in settings]),
        met=np.array([c.met for c in solved.choices]),
        error=achieved,
        best=best,
        seconds=np.array([seconds["chooser"]]),
        hindsight=np.array([seconds["hindsight"]]),
        possible=np.array([len(possible)]),
    )


def summary(trial: ChooserTrial, errors: np.ndarray, cost: np.ndarray) -> dict[str, float]:
    """The figures of a trial; times are ms a scene."""
    kept = trial.error <= SLACK * trial.asked
    possible, reachable = trial.best >= 0, (errors <= SLACK * trial.asked).any(1)
    scenes = max(int(trial.possible.sum()), 1)
    return {
        "asked": trial.asked,
        "share": float(kept[trial.met].mean()) if trial.met.any() else 1.0,
        "share of all": float(kept.mean()),
        "flagged": float(1 - trial.met.mean()),
        "unreachable": float(1 - possible.mean()),
        "flagged in vain": float((~trial.met & possible).mean()),
        "beyond promise": float(1 - reachable.mean()),
        "median": float(np.median(trial.error)),
        "p95": float(np.quantile(trial.error, 0.95)),
        "ms": 1e3 * float(trial.seconds.sum()) / scenes,
        "hindsight": 1e3 * float(trial.hindsight.sum()) / scenes,
        "ratio": float(trial.seconds.sum() / trial.hindsight.sum()) if possible.any() else 1.0,
        "fixed": cheapest_fixed(errors, cost, trial.asked),
    }


def cheapest_fixed(errors: np.ndarray, cost: np.ndarray, asked: float) -> float:
    """Time of the cheapest single setting that keeps the promise as often as it must; NaN where none does."""
    enough = (errors <= SLACK * asked).mean(0) >= SHARE
    return float(cost[enough].min()) if enough.any() else float("nan")


def _race(
    batch: SceneBatch, menu: tuple[Setting, ...], best: np.ndarray, possible: np.ndarray, asked: float
) -> dict[str, float]:
    """Seconds of the chooser and of hindsight over the same scenes, medians of visits in turn."""
    stage = measured.stage_of(batch.sensor)
    some = lambda grid, rows: batch.gaps(grid, possible[rows])
    given = batch.force_n[possible], batch.modulus_mpa[possible]
    work = [(menu[i], possible[best[possible] == i]) for i in np.unique(best[possible])]
    calls = {
        "chooser": lambda: chooser.solve_many(asked, some, *given, stage).buckets[0].contacts.residual,
        "hindsight": lambda: [measured.from_scratch(batch, setting, rows) for setting, rows in work],
    }
    for call in calls.values():
        call()
    return {name: float(np.median(s)) for name, s in interleaved(calls, range(measured.ROUNDS)).items()}
