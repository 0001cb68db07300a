"""Schedule of objects, motions and forces, contact by contact: presses alone, or the protocol of press and motions.

The protocol.  Every object is pressed once, all other contacts are the six exploratory motions, dealt in turn at 2, 5
and 10 N; all sensors see every contact; contacts come in a random order, so that every prefix is a fair sample.

Frames past the strain limit are left out and replaced, if `SceneConfig.past_limit` says so.  Leaving them out alone
would reveal the labels: a ramp that ends at 7 N is that of a hard, protruding object, one that reaches 20 N that of a
soft one.  What is done instead:

- Only shape decides what a contact must bear, by its rigid limit (`strength`), so hardness does not.
- Objects are matched within cells of equal protrusion and roughness level.  A press reaches the ceiling

      C(u) = min over cells of Q_cell(u),   at most 20 N,

  Q_cell the quantile function of the rigid limits in a cell and u the object's own quantile.  C(u) never passes the
  object's limit, and has the same distribution in every cell.  Its frames past C are replaced by a finer ramp below.
- A motion that its object cannot bear is replaced by the same motion at the same force on another object of the cell.

The force then reveals none of the three ordinal levels; the price is that few presses reach 20 N.

Where frames past the limit are flagged instead, every object counts as one that bears any force: all presses reach 20 N
and motions are dealt without regard to what objects bear.
"""

import collections
import dataclasses
import functools

import numpy as np

from sensors_io.scenes import motions, strength
from sensors_io.scenes.config import SceneConfig, stream
from sensors_io.schema import EXPLORATORY, FORCES_N, PRESS_FORCE_N

BANDS_N = (2.0, 5.0, 10.0, 15.0, 20.0)
"""Upper edges of the force bands in which frames are counted."""

_Task = tuple[str, float]  # motion and force
_Given = tuple[_Task, int]  # a task and its object

_SPARE = 1.15  # a motion's object bears this multiple of its force at one site, so that it does at most others
_ROUNDING = 1e-6  # N; a frame at the limit is within it


@dataclasses.dataclass(frozen=True, kw_only=True)
class Slot:
    """One contact: object, number of the site on it, motion, greatest normal force that the hand asks for."""

    object_index: int
    site: int
    motion: str
    force_n: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class StrainLimitCounts:
    """Frames that the protocol would take without regard to what objects bear, by object and force band, [n, bands].

    `asked` are all frames of one sensor, `past_limit` those past the object's strain limit on at least one sensor,
    `replaced` those that others stand for: the same, and what matching costs; none where frames are only flagged.
    """

    asked: np.ndarray
    past_limit: np.ndarray
    replaced: np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True)
class Schedule:
    """All contacts in order, what the objects bear, and what was left out."""

    slots: tuple[Slot, ...]
    limits: strength.Limits
    left_out: StrainLimitCounts


def pace(frames: int) -> motions.Pace:
    """The pace of a sequence of `frames` frames, 25 a second: what the slowest camera can follow.

    Phases keep their shares of the 90 frames that the protocol has.
    """
    whole = motions.Pace()

    def share(count: int) -> int:
        return max(1, round(count * frames / whole.frames))

    return motions.Pace(
        frames=frames,
        period_s=0.04,
        approach_frames=share(whole.approach_frames),
        load_frames=share(whole.load_frames),
        settle_frames=share(whole.settle_frames),
        unload_frames=share(whole.unload_frames),
    )


def press_slot(config: SceneConfig, index: int) -> Slot:
    """Contact `index` where only presses are made: object index // sites at its site index % sites."""
    which, site = divmod(index, config.sites)
    return Slot(object_index=which, site=site, motion="press", force_n=config.max_force_n)


def protocol(config: SceneConfig, limits: strength.Limits, cell: np.ndarray) -> Schedule:
    """The schedule of the protocol.

    Args:
      config: with `sequences`.
      limits: of every object, at the site of its press.
      cell: of every object, int [objects]: those of equal number are matched.

    Raises:
      ValueError: no object bears a motion's force.
    """
    rng = stream(config.seed, "schedule")
    bears = limits.rigid_n if config.replaces else np.full(len(cell), np.inf)
    ceiling = np.minimum(ceilings(bears, cell, rng), PRESS_FORCE_N)
    asked, given = _deal(config.contact_count - config.objects, bears, cell, rng)
    press = [Slot(object_index=i, site=0, motion="press", force_n=float(c)) for i, c in enumerate(ceiling)]
    sites = collections.Counter(dict.fromkeys(range(config.objects), 1))
    moves = []
    for (motion, force), which in given:
        moves.append(Slot(object_index=which, site=sites[which], motion=motion, force_n=force))
        sites[which] += 1
    slots = press + moves
    order = rng.permutation(len(slots))
    counts = _count(config.frame_count, limits.actual_n, bears, ceiling, asked)
    return Schedule(slots=tuple(slots[i] for i in order), limits=limits, left_out=counts)


def ceilings(limit: np.ndarray, cell: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """C(u) of every object: u is random within its rank in the cell, Q_cell(u) = sorted limits[⌊u n⌋]."""
    u = np.empty(len(limit))
    quantiles = []
    for name in np.unique(cell):
        rows = np.flatnonzero(cell == name)
        order = rows[np.argsort(limit[rows])]
        u[order] = (np.arange(len(rows)) + rng.random(len(rows))) / len(rows)
        quantiles.append(limit[order])
    at = [q[np.minimum((u * len(q)).astype(int), len(q) - 1)] for q in quantiles]
    return np.min(at, 0)


def _deal(
    count: int, limit: np.ndarray, cell: np.ndarray, rng: np.random.Generator
) -> tuple[list[_Given], list[_Given]]:
    """Motions first asked of objects in turn, and those given to objects that bear them.

    A cell gets its share of the tasks, in a run of the cycle of all motions and forces.
    """
    cycle = [(m, f) for f in FORCES_N for m in EXPLORATORY]
    names, sizes = np.unique(cell, return_counts=True)
    edges = np.round(np.cumsum(sizes) * count / len(cell)).astype(int)
    start = 0
    asked: list[_Given] = []
    given: list[_Given] = []
    for name, end in zip(names, edges, strict=True):
        tasks = [cycle[i % len(cycle)] for i in range(start, end)]
        rows = rng.permutation(np.flatnonzero(cell == name))
        asked += [(tasks[i], int(rows[i % len(rows)])) for i in rng.permutation(len(tasks))]
        given += _assign(tasks, rows, limit)
        start = end
    return asked, given


def _assign(tasks: list[_Task], rows: np.ndarray, limit: np.ndarray) -> list[_Given]:
    """The strongest forces first, each to the least used object of the cell that bears it, else of all."""
    uses: collections.Counter[int] = collections.Counter()
    given = []
    for task in sorted(tasks, key=lambda task: -task[1]):
        able = [int(i) for i in rows if limit[i] >= _SPARE * task[1]]
        if not able:
            able = [int(i) for i in np.flatnonzero(limit >= _SPARE * task[1])]
        if not able:
            raise ValueError(
                f"objects is {len(limit)}: none of them bears {task[1]:g} N within the strain limit; raise objects"
            )
        which = min(able, key=lambda i: uses[i])
        uses[which] += 1
        given.append((task, which))
    return given


def _count(
    frames: int, limit: np.ndarray, bears: np.ndarray, ceiling: np.ndarray, asked: list[_Given]
) -> StrainLimitCounts:
    """Count the frames that would have been taken of every object without regard to what it bears.

    Args:
      frames: of a sequence.
      limit: force at the strain limit, N, [n].
      bears: force up to which motions are given to an object, [n].
      ceiling: force that its press ends at, [n].
      asked: motions, each of the object that it was first asked of.
    """
    shape = (len(ceiling), len(BANDS_N))
    total, past, replaced = (np.zeros(shape, np.int64) for _ in range(3))
    presses = [(("press", PRESS_FORCE_N), which, most) for which, most in enumerate(ceiling)]
    moves = [(task, i, task[1] if bears[i] >= _SPARE * task[1] else 0.0) for task, i in asked]
    for (motion, force), which, kept in presses + moves:
        load = _load(motion, force, frames)
        for counts, most in ((total, 0.0), (past, limit[which]), (replaced, kept)):
            beyond = load[load > most + _ROUNDING]
            counts[which] += np.bincount(np.searchsorted(BANDS_N, beyond - _ROUNDING), minlength=len(BANDS_N))
    return StrainLimitCounts(asked=total, past_limit=past, replaced=replaced)


@functools.lru_cache(maxsize=64)
def _load(motion: str, force_n: float, frames: int) -> np.ndarray:
    """Normal force of every frame."""
    return motions.plan(motion, force_n, pace(frames)).force_n
