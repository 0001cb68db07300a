"""Headroom, the largest gain from choosing: plans of one, two and three contacts, by beliefs about every contact.

A belief is the log-probability of each level given one contact; beliefs of several contacts are added, as if their
errors were independent.  The value of a plan is its right answers minus the cost of its contacts.  A plan is chosen on
some objects and scored on others.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

RANDOM, FIXED, BY_QUESTION, BY_BELIEF, EVERY = (
    "random",
    "best fixed",
    "best by question",
    "optimum of trees",
    "every contact",
)
PLANS = (RANDOM, FIXED, BY_QUESTION, BY_BELIEF)

BELIEFS = 6
"""Classes of beliefs that a tree distinguishes: the likeliest of three levels, held with more or less than `SURE`."""

SURE = 0.6  # probability of the likeliest level from which a belief counts as sure

_DRAWS = 400  # random sequences that stand for all


@dataclasses.dataclass(frozen=True)
class Beliefs:
    """Log-probabilities of each level from one contact, the true level, and the cost of each contact (none: 0)."""

    log_probs: Float[np.ndarray, "n C A K"]
    label: Int[np.ndarray, "n A"]
    cost: Float[np.ndarray, "n C"] | None = None

    def of(self, objects: Int[np.ndarray, "n"]) -> "Beliefs":
        """Those about some objects."""
        return Beliefs(self.log_probs[objects], self.label[objects], None if self.cost is None else self.cost[objects])

    def paid(self, choices: tuple[int, ...]) -> Float[np.ndarray, "n"]:
        """Cost of some contacts with each object."""
        return np.zeros(len(self.label)) if self.cost is None else self.cost[:, list(choices)].sum(1)

    def worth(self, question: int, choices: tuple[int, ...]) -> Float[np.ndarray, "n"]:
        """Right answers less costs."""
        return self.right(question, choices) - self.paid(choices)

    def right(self, question: int, choices: tuple[int, ...]) -> Bool[np.ndarray, "n"]:
        """Where the likeliest level after some contacts is the true one."""
        return self.log_probs[:, list(choices), question].sum(1).argmax(-1) == self.label[:, question]

    @property
    def questions(self) -> range:
        """Numbers of the questions."""
        return range(self.label.shape[1])


def headroom(
    find: Beliefs, score: Beliefs, contacts: int = 3, kept: int = 12
) -> dict[tuple[str, int], Float[np.ndarray, "n A"]]:
    """Worth of every plan for every object that is scored, by plan and greatest number of contacts.

    Plans are looked up in `find`; those of several contacts consist of the `kept` choices that are best alone.
    """
    found = {(EVERY, 0): _each(score, lambda a: score.worth(a, tuple(range(score.log_probs.shape[1]))))}
    for count in range(1, contacts + 1):
        fixed = best_sequence(find, list(find.questions), count, kept)
        trees = [best_tree(find, a, best_choices(find, [a], kept), count) for a in find.questions]
        sequences = [best_sequence(find, [a], count, kept) for a in find.questions]
        found[RANDOM, count] = _random(score, count)
        found[FIXED, count] = _each(score, lambda a, fixed=fixed: score.worth(a, fixed))
        found[BY_QUESTION, count] = _each(score, lambda a, sequences=sequences: score.worth(a, sequences[a]))
        found[BY_BELIEF, count] = _each(score, lambda a, trees=trees: worth_of_tree(score, a, trees[a]))
    return found


def best_choices(beliefs: Beliefs, questions: list[int], kept: int) -> list[int]:
    """The choices that are worth most alone, the best one first."""
    cost = 0.0 if beliefs.cost is None else beliefs.cost.mean(0)
    worth = np.mean([single(beliefs, a).mean(0) for a in questions], 0) - cost
    return [int(c) for c in np.argsort(-worth, kind="stable")[:kept]]


def single(beliefs: Beliefs, question: int) -> Bool[np.ndarray, "n C"]:
    """Where the likeliest level after one contact is the true one, for every choice."""
    right: np.ndarray = beliefs.log_probs[:, :, question].argmax(-1) == beliefs.label[:, question, None]
    return right


def best_sequence(beliefs: Beliefs, questions: list[int], count: int, kept: int) -> tuple[int, ...]:
    """The contacts that are best for some questions, of all sets of the `kept` choices that are best alone."""
    choices = best_choices(beliefs, questions, kept)
    worth = lambda chosen: np.mean([beliefs.worth(a, chosen).mean() for a in questions])
    return max(itertools.combinations(choices, min(count, len(choices))), key=worth)


@dataclasses.dataclass(frozen=True)
class Tree:
    """A plan that depends on what was observed: a choice, then a tree for each class of beliefs, where it goes on."""

    choice: int
    after: Mapping[int, "Tree"] = dataclasses.field(default_factory=dict)


def best_tree(beliefs: Beliefs, question: int, choices: list[int], depth: int) -> Tree:
    """The exact optimum over all trees of at most `depth` of some choices; of equal ones that of the first choice."""
    every = np.arange(len(beliefs.label))
    start = np.zeros((len(every), beliefs.log_probs.shape[-1]))
    return _best_tree(beliefs, question, choices, depth, every, start)[0]


def worth_of_tree(beliefs: Beliefs, question: int, tree: Tree) -> Float[np.ndarray, "n"]:
    """Right answers after the contacts that a tree chooses, less their costs."""
    every, worth = np.arange(len(beliefs.label)), np.empty(len(beliefs.label))
    start = np.zeros((len(every), beliefs.log_probs.shape[-1]))
    for rows, chosen, belief in _leaves(beliefs, question, tree, every, (), start):
        right = belief.argmax(-1) == beliefs.label[rows, question]
        worth[rows] = right - beliefs.paid(chosen)[rows]
    return worth


def belief_class(log_probs: Float[np.ndarray, "n K"]) -> Int[np.ndarray, "n"]:
    """Class of beliefs, 0 … `BELIEFS` − 1."""
    p = np.exp(log_probs - log_probs.max(-1, keepdims=True))
    sure = p.max(-1) / p.sum(-1) > SURE
    return 2 * p.argmax(-1) + sure


def _best_tree(
    beliefs: Beliefs, question: int, choices: list[int], depth: int, rows: np.ndarray, before: np.ndarray
) -> tuple[Tree, float]:
    """The best tree for some objects after what was observed of them, and its worth, summed over them."""
    if depth == 1:
        belief = before[:, None] + beliefs.log_probs[rows[:, None], choices, question]
        right = (belief.argmax(-1) == beliefs.label[rows, question, None]).sum(0)
        worth_of = right - (0.0 if beliefs.cost is None else beliefs.cost[rows[:, None], choices].sum(0))
        return Tree(choices[int(worth_of.argmax())]), float(worth_of.max())
    best: tuple[Tree, float] | None = None
    for choice in choices:
        belief = before + beliefs.log_probs[rows, choice, question]
        right = belief.argmax(-1) == beliefs.label[rows, question]
        worth = -float(beliefs.paid((choice,))[rows].sum())
        after: dict[int, Tree] = {}
        classes = belief_class(belief)
        for k in range(BELIEFS):
            here = classes == k
            ended = float(right[here].sum())
            if here.any():
                tree, gone_on = _best_tree(beliefs, question, choices, depth - 1, rows[here], belief[here])
                if gone_on > ended:
                    after[k], ended = tree, gone_on
            worth += ended
        if best is None or worth > best[1]:
            best = Tree(choice, after), worth
    assert best is not None
    return best


def _leaves(
    beliefs: Beliefs, question: int, tree: Tree, rows: np.ndarray, chosen: tuple[int, ...], before: np.ndarray
) -> Iterator[tuple[np.ndarray, tuple[int, ...], np.ndarray]]:
    """The objects at each leaf of a tree, what was chosen on the way there, and what is believed of them."""
    chosen = (*chosen, tree.choice)
    belief = before + beliefs.log_probs[rows, tree.choice, question]
    classes = belief_class(belief)
    ends = ~np.isin(classes, list(tree.after))
    yield rows[ends], chosen, belief[ends]
    for k, part in tree.after.items():
        yield from _leaves(beliefs, question, part, rows[classes == k], chosen, belief[classes == k])


def _random(score: Beliefs, count: int) -> Float[np.ndarray, "n A"]:
    """Mean worth of contacts drawn at random."""
    rng = np.random.default_rng(count)
    drawn = [tuple(rng.choice(score.log_probs.shape[1], count, replace=False).tolist()) for _ in range(_DRAWS)]
    return _each(score, lambda a: np.mean([score.worth(a, choices) for choices in drawn], 0))


def _each(score: Beliefs, right: Any) -> Float[np.ndarray, "n A"]:
    """One column for each question, by a function of its number."""
    return np.stack([right(a) for a in score.questions], 1).astype(float)
