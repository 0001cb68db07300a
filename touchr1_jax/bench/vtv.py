"""The nine tasks of the VTV protocol over recordings with levels of four attributes, for any predictor of levels.

VTV-LLM (Xie et al., arXiv 2505.22566) asks for hardness, protrusion, elasticity and friction of a recording, for all
four at once (`combined`), which of two has more of an attribute (`sfd`), which of three has the most or the least
(`soi`), which of three recordings belongs to which of three named objects (`osc`), and which of two suits a scenario
(`tsa`).  Its questions are published without levels; these are drawn over other recordings by the same rules.

A predictor gives log p [n, A, K].  Its level is the likeliest; recordings are compared by the expected level, equal
ones by their place; recordings are matched to names by the likeliest assignment, where a name stands for the true
levels of its object.  Every pair is asked in both orders, every three in all three rotations or with each assignment
right equally often, so that a predictor that cannot distinguish recordings scores exactly at chance.
"""

import dataclasses
import itertools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from touchr1_jax.bench.averages import VTV, vtv_average
from touchr1_jax.bench.metrics import Scores
from touchr1_jax.bench.statistics import TAILS, Interval, draw_clusters, drawn_means

ATTRIBUTES = ("hardness", "protrusion", "elasticity", "friction")
LEVELS = 3

CHANCE: Mapping[str, float] = {
    **dict.fromkeys(ATTRIBUTES, 100 / LEVELS),
    "combined": 100 / LEVELS ** len(ATTRIBUTES),
    "sfd": 100 / 2,
    "soi": 100 / 3,
    "osc": 100 / 6,
    "tsa": 100 / 2,
}
"""Percent right by guessing."""

ASSIGNMENTS = tuple(itertools.permutations(range(3)))
"""Assignment k gives name j to recording `ASSIGNMENTS[k][j]`."""

RESAMPLES = 2_000
"""Resamples of each interval: the error of its ends is about a tenth of its width."""


SCENARIOS: Mapping[str, Mapping[str, int]] = {
    "to be held with wet hands": {"friction": 1},
    "to slide under a cupboard": {"friction": -1, "protrusion": -1},
    "to drive a tent peg into the ground": {"hardness": 1, "friction": 1},
    "to sit on for an hour": {"hardness": -1, "elasticity": 1},
    "to give back the push of a spring": {"elasticity": 1},
    "to be found by its relief in the dark": {"protrusion": 1},
}
"""Use of an object → attribute → +1 if it needs more of it, −1 if less; those of the benchmark are not published."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VTVTasks:
    """Questions over n recordings of different objects; every row of `pairs` and the like names recordings.

    Attributes:
      label: true levels, int [n, A].
      pairs: int [P, 2], two levels of the attribute `pair_of` [P]: which has more?
      threes: int [T, 3], three levels of the attribute `three_of` [T]: which has the most, or where `most` [T] is
        false the least?
      names: int [M, 3], recordings whose names are to be matched, in the order of the names; they are shown in the
        order of `ASSIGNMENTS[shown]`, [M].
      fits: int [F, 2], one of which suits the scenario `scenario` [F] better.
    """

    label: Int[np.ndarray, "n A"]
    pairs: Int[np.ndarray, "P 2"]
    pair_of: Int[np.ndarray, "P"]
    threes: Int[np.ndarray, "T 3"]
    three_of: Int[np.ndarray, "T"]
    most: np.ndarray
    names: Int[np.ndarray, "M 3"]
    shown: Int[np.ndarray, "M"]
    fits: Int[np.ndarray, "F 2"]
    scenario: Int[np.ndarray, "F"]


def draw_tasks(label: Int[np.ndarray, "n A"], count: int, seed: int) -> VTVTasks:
    """Draw `count` questions of each comparing task; attributes, levels, assignments and scenarios take turns.

    `count` is a multiple of 24, so that orders, rotations, assignments and attributes come equally often.

    Raises:
      ValueError: another count; an unknown level, or one that no recording has; recordings that are all alike.
    """
    if count < 1 or count % 24:
        raise ValueError(f"count is {count}: must be a positive multiple of 24, all orders of four attributes; change")
    if unknown := np.flatnonzero(np.any(label < 0, axis=1)).tolist():
        raise ValueError(f"label[{unknown[0]}] is {label[unknown[0]].tolist()}: must be ≥ 0; leave unlabelled ones out")
    for a, name in enumerate(ATTRIBUTES):
        missing = sorted(set(range(LEVELS)) - set(label[:, a].tolist()))
        if missing:
            raise ValueError(f"label lacks levels {missing} of {name}: comparisons need all; use more objects")
    rng = np.random.default_rng(seed)
    turns = lambda recordings: [np.roll(recordings, turn) for turn in range(len(recordings))]  # a pair's are its orders
    pairs = [turned for i in range(count // 2) for turned in turns(_differing(label, i, 2, rng))]
    threes = [turned for i in range(count // 3) for turned in turns(_differing(label, i, 3, rng))]
    scenario = np.arange(count) // 2 % len(SCENARIOS)
    fits = [turned for which in scenario[::2] for turned in turns(_unequal(label, int(which), rng))]
    return VTVTasks(
        label=label,
        pairs=np.array(pairs),
        pair_of=np.arange(count) // 2 % len(ATTRIBUTES),
        threes=np.array(threes),
        three_of=np.arange(count) // 3 % len(ATTRIBUTES),
        most=np.arange(count) // (3 * len(ATTRIBUTES)) % 2 == 0,
        names=np.array([_unlike(label, 3, rng) for _ in range(count)]),
        shown=np.arange(count) % len(ASSIGNMENTS),
        fits=np.array(fits),
        scenario=scenario,
    )


def _differing(label: np.ndarray, turn: int, count: int, rng: np.random.Generator) -> Int[np.ndarray, "n"]:
    """Recordings of different levels of the attribute whose turn it is, [count]."""
    column = label[:, turn % len(ATTRIBUTES)]
    levels = rng.permutation(LEVELS)[:count]
    return np.array([rng.choice(np.flatnonzero(column == level)) for level in levels])


def _unlike(label: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Recordings no two of which have the same levels, [count]."""
    _, kind = np.unique(label, axis=0, return_inverse=True)
    kinds = np.unique(kind)
    if len(kinds) < count:
        raise ValueError(f"label has {len(kinds)} different rows: must have {count}; use more objects")
    chosen = rng.choice(kinds, count, replace=False)
    return np.array([rng.choice(np.flatnonzero(kind.ravel() == k)) for k in chosen])


def _unequal(label: np.ndarray, scenario: int, rng: np.random.Generator) -> Int[np.ndarray, "2"]:
    """Two recordings of which one suits a scenario better."""
    worth = _worth(label)[:, scenario]
    one = int(rng.integers(len(label)))
    others = np.flatnonzero(worth != worth[one])
    if not len(others):
        raise ValueError(f"label suits {list(SCENARIOS)[scenario]!r} alike throughout: it must not; use more objects")
    return np.array([one, rng.choice(others)])


def score(tasks: VTVTasks, log_probs: Float[np.ndarray, "n A K"]) -> dict[str, Scores]:
    """Percent right in every task, keyed as `averages.VTV`.

    `Scores.items` names a recording of each question, the same one in all orders.
    """
    label = tasks.label
    right = log_probs.argmax(-1) == label
    probs = np.exp(log_probs - log_probs.max(-1, keepdims=True))
    expected = (probs / probs.sum(-1, keepdims=True) * np.arange(log_probs.shape[-1])).sum(-1)
    own = np.arange(len(label))
    sign = np.where(tasks.most, 1, -1)
    found = {name: (right[:, a], own) for a, name in enumerate(ATTRIBUTES)}
    found["combined"] = right.all(1), own
    second = lambda value, rows, column: value[rows[:, 1], column] >= value[rows[:, 0], column]
    same_more = lambda predicted, true, rows, column: second(predicted, rows, column) == second(true, rows, column)
    found["sfd"] = same_more(expected, label, tasks.pairs, tasks.pair_of), tasks.pairs.min(1)
    extreme = lambda value: (sign[:, None] * value[tasks.threes, tasks.three_of[:, None]]).argmax(1)
    found["soi"] = extreme(expected) == extreme(label), tasks.threes.min(1)
    found["osc"] = _matched(log_probs, tasks) == tasks.shown, tasks.names.min(1)
    found["tsa"] = same_more(_worth(expected), _worth(label), tasks.fits, tasks.scenario), tasks.fits.min(1)
    scores = lambda values, items: Scores(values=100.0 * values, items=items, strata=np.zeros(len(values), int))
    return {name: scores(*found[name]) for name in VTV}


def _worth(levels: np.ndarray) -> Float[np.ndarray, "n scenario"]:
    """Suitability of recordings for each scenario; a matrix product would not give equal numbers for equal rows."""
    weights = np.array([[wants.get(name, 0) for name in ATTRIBUTES] for wants in SCENARIOS.values()], float)
    return np.stack([(levels * w).sum(-1) for w in weights], 1)


def _matched(log_probs: np.ndarray, tasks: VTVTasks) -> np.ndarray:
    """The likeliest assignment of three names to three recordings, as a position in `ASSIGNMENTS`."""
    order = np.argsort(np.array(ASSIGNMENTS), axis=1)[tasks.shown]
    recordings = np.take_along_axis(tasks.names, order, 1)  # place p shows the recording of name order[p]
    levels = tasks.label[tasks.names]  # [M, name, A]
    attributes = np.arange(len(ATTRIBUTES))
    fit = log_probs[recordings[:, None, :, None], attributes, levels[:, :, None, :]].sum(-1)  # [M, name, place]
    total = [sum(fit[:, name, place] for name, place in enumerate(given)) for given in ASSIGNMENTS]
    return np.argmax(total, axis=0)


def averaged(scores: Mapping[str, Scores], objects: np.ndarray) -> dict[str, Interval]:
    """Means of every task and of "average", with 95 % intervals from the same resamples of whole objects [n]."""
    cluster, weights = draw_clusters(objects, resamples=RESAMPLES)
    drawn = {name: drawn_means(s.values, cluster[s.items], s.strata, weights) for name, s in scores.items()}
    means = {name: s.mean() for name, s in scores.items()}
    drawn["average"] = np.mean([drawn[name] for name in VTV], axis=0)
    means["average"] = vtv_average(means)
    spans = {name: np.nanquantile(values, TAILS) for name, values in drawn.items()}
    return {name: Interval(mean=means[name], low=float(low), high=float(high)) for name, (low, high) in spans.items()}


def prior_log_probs(label: Int[np.ndarray, "n A"]) -> Float[np.ndarray, "n A K"]:
    """The predictor that knows only how common each level is: the same for every recording."""
    shares = np.stack([np.bincount(label[:, a], minlength=LEVELS) / len(label) for a in range(label.shape[1])])
    floor = np.finfo(float).tiny  # of a level that does not occur
    return np.tile(np.log(np.maximum(shares, floor)), (len(label), 1, 1))
