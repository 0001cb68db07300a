"""Metrics of questions about several objects: which of two has more of a property, and the order of three.

N questions.  An answer of −1 is ⊥, unparsable, and counts against the policy.
"""

import itertools

import numpy as np

from touchr1_jax.bench.metrics import BOTTOM, Scores, accuracy, check_same_shape, keep_scored

ORDERS: tuple[tuple[int, ...], ...] = tuple(itertools.permutations(range(3)))
"""Answer k of an ordering question names the objects of `ORDERS[k]` from the least to the most."""


def which_has_more(answer: np.ndarray, label: np.ndarray) -> Scores:
    """SFD, 100·mean 1[the object named has more of it]; two objects that differ, so chance is 50.

    Args:
      answer: int [N], 0 for the first object, 1 for the second.
      label: int [N], the one that has more.
    """
    return accuracy(answer, label)


def swap_consistency(answer: np.ndarray, pair: np.ndarray, swapped: np.ndarray) -> Scores:
    """100·mean over pairs of 1[the same object is named in both orders]; always answering "first" scores 0.

    Args:
      answer: int [N], 0 for the first object, 1 for the second.
      pair: [N], the pair that each question is about; every pair has one question in each order.
      swapped: bool [N], true where the question shows the pair in its second order.

    Returns:
      One value per pair, belonging to the question in the first order.

    Raises:
      ValueError: a pair without a question in each order.
    """
    check_same_shape(answer=answer, pair=pair, swapped=swapped)
    forth, back = np.flatnonzero(~swapped), np.flatnonzero(swapped)
    forth, back = (rows[np.argsort(pair[rows], kind="stable")] for rows in (forth, back))
    whole = len(forth) == len(back) and np.array_equal(pair[forth], pair[back])
    if not whole or len(np.unique(pair)) != len(forth):
        odd = next(p for p in np.unique(pair) if sorted(swapped[pair == p]) != [False, True])
        raise ValueError(f"pair {odd.tolist()!r} must have one question in each order; ask both, or leave the pair out")
    same = (answer[forth] == 1 - answer[back]) & (answer[forth] != BOTTOM) & (answer[back] != BOTTOM)
    return Scores(values=100.0 * same, items=forth, strata=np.zeros(len(forth), int))


def order_correlation(answer: np.ndarray, label: np.ndarray) -> Scores:
    """SOI-ρ, the mean over lists of Spearman's ρ = 1 − 6 Σ d² / (n³ − n), n = 3: 1, ½, −½ or −1; ⊥ counts 0.

    Args:
      answer, label: int [N], positions in `ORDERS`.

    Raises:
      ValueError: an answer or label that is no position in `ORDERS`.
    """
    check_same_shape(answer=answer, label=label)
    for name, orders in (("answer", answer), ("label", label)):
        if np.any((orders < BOTTOM) | (orders >= len(ORDERS))):
            raise ValueError(f"{name} holds {int(np.max(orders))}: must lie in −1..{len(ORDERS) - 1}; correct it")
    ranks = np.argsort(np.array(ORDERS), axis=1)
    rho = 1 - 6 * ((ranks[answer] - ranks[label]) ** 2).sum(axis=1) / (3**3 - 3)
    return keep_scored(np.where(answer == BOTTOM, 0.0, rho), label != BOTTOM)
