"""Controls: a rule chooses the contacts, and a policy that never learned to choose answers."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from experiments.active.headroom import Beliefs, best_choices, best_sequence
from touchr1_jax.rl.environment import TouchBank
from touchr1_jax.training.exploration import NO_CHOICE

Answer = Callable[[Int[np.ndarray, "n"], Int[np.ndarray, "n"], Int[np.ndarray, "n k"]], Float[np.ndarray, "n K"]]
"""(objects, questions, choices in order) → log-probabilities of the levels, by one policy; `NO_CHOICE` ends a row."""


@dataclasses.dataclass(frozen=True)
class Played:
    """Outcome of a plan for every object and question, [O, A], and its choices in order [O, A, k]."""

    right: Float[np.ndarray, "O A"]
    seconds: Float[np.ndarray, "O A"]
    harm: Float[np.ndarray, "O A"]
    choices: Int[np.ndarray, "O A k"]

    @property
    def contacts(self) -> Int[np.ndarray, "O A"]:
        """Number of contacts."""
        return (self.choices != NO_CHOICE).sum(-1)


def play(bank: TouchBank, objects: Int[np.ndarray, "n"], choices: Int[np.ndarray, "n A k"], answer: Answer) -> Played:
    """Make the chosen contacts with objects of a bank and answer; the same for every plan.

    A contact that is not available takes its time and does no harm.
    """
    n, questions, count = choices.shape
    flat = choices.reshape(n * questions, count)
    rows, asked = np.repeat(objects, questions), np.tile(np.arange(questions), n)
    level = answer(rows, asked, flat).argmax(-1)
    label = np.asarray(bank.label)[rows, asked]
    made = flat != NO_CHOICE
    total = lambda x: (
        (np.asarray(x, np.float64)[rows[:, None], np.maximum(flat, 0)] * made).sum(-1).reshape(n, questions)
    )
    right = (level == label).astype(float).reshape(n, questions)
    harm = total(np.where(bank.available, bank.harm, 0))
    return Played(right=right, seconds=total(bank.seconds), harm=harm, choices=choices)


@dataclasses.dataclass(frozen=True)
class LookUps:
    """Choices that were looked up on validation objects, for up to `contacts` contacts.

    `fixed[k]` and `press[k]` are k contacts in order, `by_question[k][a]` those of question a, `order[a]` the choices
    of a question by their accuracy alone.
    """

    press: Mapping[int, tuple[int, ...]]
    fixed: Mapping[int, tuple[int, ...]]
    by_question: Mapping[int, Sequence[tuple[int, ...]]]
    order: Sequence[tuple[int, ...]]


def look_up(bank: TouchBank, beliefs: Beliefs, contacts: int, kept: int) -> LookUps:
    """Look plans up in the beliefs about validation objects."""
    questions = list(beliefs.questions)
    presses = [c for c, kind in enumerate(bank.kinds) if kind == "press"]
    of_presses = Beliefs(beliefs.log_probs[:, presses], beliefs.label)
    counts = range(1, contacts + 1)
    return LookUps(
        press={k: tuple(presses[c] for c in best_sequence(of_presses, questions, k, kept)) for k in counts},
        fixed={k: best_sequence(beliefs, questions, k, kept) for k in counts},
        by_question={k: [best_sequence(beliefs, [a], k, kept) for a in questions] for k in counts},
        order=[tuple(best_choices(beliefs, [a], kept)) for a in questions],
    )


def same_for_all(choices: tuple[int, ...], objects: int, questions: int) -> Int[np.ndarray, "O A k"]:
    """One sequence for every object and question."""
    return np.broadcast_to(np.array(choices, np.int32), (objects, questions, len(choices)))


def same_for_question(choices: Sequence[tuple[int, ...]], objects: int) -> Int[np.ndarray, "O A k"]:
    """One sequence for every question."""
    rows = np.array(choices, np.int32)
    return np.broadcast_to(rows, (objects, *rows.shape))


def at_random(shape: tuple[int, int, int], count: int, rng: np.random.Generator) -> Int[np.ndarray, "O A k"]:
    """Different ones of C choices, drawn for every object and question; `shape` is (O, A, C)."""
    return np.argsort(-rng.random(shape), axis=-1)[..., :count].astype(np.int32)


def until_sure(
    objects: Int[np.ndarray, "n"], order: Sequence[tuple[int, ...]], contacts: int, threshold: float, answer: Answer
) -> Int[np.ndarray, "n A k"]:
    """Contacts in the order of the look-up, until the likeliest level has more than a probability."""
    questions = len(order)
    rows, asked = np.repeat(objects, questions), np.tile(np.arange(questions), len(objects))
    planned = np.tile(np.array([o[:contacts] for o in order], np.int32), (len(objects), 1))
    chosen = np.full_like(planned, NO_CHOICE)
    open_ = np.ones(len(rows), bool)
    for k in range(contacts):
        chosen[open_, k] = planned[open_, k]
        belief = np.exp(answer(rows, asked, chosen[:, : k + 1]))
        open_ &= belief.max(-1) <= threshold
    return chosen.reshape(len(objects), questions, contacts)
