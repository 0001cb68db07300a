"""Baselines without a policy: each a pure function from training contacts to levels of others.

Every one answers about all streams together and about each alone, so that it stands in the
same tables as a policy.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from experiments.paper.features import Seen
from touchr1_jax.bench.metrics import BOTTOM
from touchr1_jax.training.evidence import ProbeConfig, probe_log_probs

NEIGHBOURS = 15
"""Contacts that vote; fixed beforehand, about the square root of a level's training contacts."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Known:
    """Training contacts: what was seen of them, and their labels, −1 where nobody annotated."""

    seen: Seen
    label: Int[np.ndarray, "n A"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Levels:
    """Levels of m contacts by all streams together, [m, A], and by each stream alone, [m, S, A]."""

    together: Int[np.ndarray, "m A"]
    alone: Int[np.ndarray, "m S A"]


def nearest(known: Known, asked: Seen, levels: tuple[int, ...], neighbours: int = NEIGHBOURS) -> Levels:
    """The vote of the k nearest training contacts, each weighing 1/d.

        d² = mean over streams that both have of mean_D ((x − x′)/σ)²

    Args:
      known: training contacts; features without spread among them do not count.
      asked: contacts to answer for.
      levels: K of each attribute.
      neighbours: k; fewer where fewer are annotated.

    Raises:
      ValueError: an attribute that no training contact is annotated for.
    """
    return _both(lambda k, a: _vote(k, a, levels, neighbours), known, asked)


def probed(known: Known, asked: Seen, levels: tuple[int, ...], config: ProbeConfig) -> Levels:
    """The likeliest level by a multinomial probe on the streams side by side; one probe for each stream alone.

    Args:
      known: training contacts.
      asked: contacts to answer for.
      levels: K of each attribute.
      config: penalty and iterations of the probes.

    Raises:
      ValueError: an attribute that no training contact is annotated for.
    """
    return _both(lambda k, a: _probe(k, a, levels, config), known, asked)


def _both(answer: Callable[[Known, Seen], np.ndarray], known: Known, asked: Seen) -> Levels:
    """By all streams, and by each alone; ⊥ where none of them was recorded."""

    def levels(k: Known, a: Seen) -> np.ndarray:
        return np.where(np.any(a.present, axis=1, keepdims=True), answer(k, a), BOTTOM)

    streams = range(asked.x.shape[1])
    alone = [levels(dataclasses.replace(known, seen=known.seen.only(s)), asked.only(s)) for s in streams]
    together = alone[0] if len(alone) == 1 else levels(known, asked)
    return Levels(together=together, alone=np.stack(alone, 1))


def _vote(known: Known, asked: Seen, levels: tuple[int, ...], neighbours: int) -> Int[np.ndarray, "m A"]:
    distance = _distances(known.seen, asked)
    out = np.zeros((len(asked.x), len(levels)), int)
    for a, count in enumerate(levels):
        rows = _annotated(known.label[:, a], a)
        near = np.argsort(distance[:, rows], axis=1, kind="stable")[:, :neighbours]
        weight = 1 / np.maximum(np.take_along_axis(distance[:, rows], near, 1), np.finfo(np.float32).tiny)
        said = known.label[rows, a][near]
        out[:, a] = np.stack([(weight * (said == k)).sum(1) for k in range(count)], 1).argmax(1)
    return out


def _distances(known: Seen, asked: Seen) -> Float[np.ndarray, "m n"]:
    """Root mean square difference in units of the training spread; infinite where no stream is shared."""
    total = np.zeros((len(asked.x), len(known.x)))
    shared = np.zeros_like(total)
    for s in range(known.x.shape[1]):
        x, mine = known.x[:, s].astype(float), known.present[:, s]
        if not mine.any():
            continue
        centre, spread = x[mine].mean(0), x[mine].std(0)
        varies = spread > 0
        z, q = ((v[:, varies] - centre[varies]) / spread[varies] for v in (x, asked.x[:, s].astype(float)))
        square = (q**2).sum(1)[:, None] + (z**2).sum(1) - 2 * q @ z.T
        both = asked.present[:, s, None] & mine
        total += np.where(both, np.maximum(square, 0) / max(varies.sum(), 1), 0)
        shared += both
    return np.sqrt(np.where(shared > 0, total / np.maximum(shared, 1), np.inf))


def _probe(known: Known, asked: Seen, levels: tuple[int, ...], config: ProbeConfig) -> Int[np.ndarray, "m A"]:
    n = len(known.label)
    x = np.concatenate([seen.x.reshape(len(seen.x), -1) for seen in (known.seen, asked)])
    columns = []
    for a, count in enumerate(levels):
        rows = _annotated(known.label[:, a], a)
        weight = np.isin(np.arange(len(x)), rows)[None]
        label = np.concatenate([known.label[:, a], np.full(len(asked.x), -1)])
        columns.append(probe_log_probs(x, label, weight, count, config)[0, n:].argmax(-1))
    return np.stack(columns, 1)


def _annotated(label: np.ndarray, attribute: int) -> np.ndarray:
    rows = np.flatnonzero(label >= 0)
    if not len(rows):
        raise ValueError(f"label[:, {attribute}] is −1 throughout: a baseline needs annotated contacts; leave it out")
    return rows
