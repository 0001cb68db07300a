"""Batches of GRPO and of evaluation: encoded contacts, each with the question for one attribute."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import grain
import numpy as np
from jaxtyping import Int

from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.training.feeds import ONE_AT_A_TIME, Feed, random_streams, take, verified_answer


class NoLabelsError(ValueError):
    """Contacts without any known label, so that no question can be asked about them."""


class QuestionFeed(Feed):
    """GRPO batches: encoded contacts in random order, each with the question for one attribute.

    If several processes share a batch, each makes its rows `own`.  Questions ask about levels of `label`; rewards see
    all known levels, `truth` [n, A], by default those of `label`.  With `evidence` [n, S, A, K] of the sensors' probes,
    each question has its verified answer (`feeds.verified_answer`).
    """

    def __init__(
        self,
        policy: TouchPolicy,
        features: Features,
        label: np.ndarray,
        *,
        batch_size: int,
        seed: int,
        full_share: float = 0.75,
        own: np.ndarray | None = None,
        truth: np.ndarray | None = None,
        evidence: np.ndarray | None = None,
    ) -> None:
        contact, attribute = labelled_questions(label)
        order = (
            grain.MapDataset.range(len(contact)).seed(seed).shuffle().repeat().batch(batch_size, drop_remainder=True)
        )
        super().__init__(order.to_iter_dataset(ONE_AT_A_TIME), seed)
        self._policy, self._features, self._truth = policy, features, label if truth is None else truth
        self._contact, self._attribute, self._full_share = contact, attribute, full_share
        self._own, self._evidence = np.arange(batch_size) if own is None else own, evidence

    def make(self, element: np.ndarray, rng: np.random.Generator) -> GRPOBatch:
        """Gather the features of one batch of questions."""
        contact, attribute = self._contact[element], self._attribute[element]
        streams = random_streams(np.asarray(self._features.stream_mask)[contact], self._full_share, rng)
        contact, attribute, streams = contact[self._own], attribute[self._own], streams[self._own]
        batch = question_batch(self._policy, self._features, self._truth, contact, attribute, streams)
        if self._evidence is None:
            return batch
        of_rows = zip(self._evidence[contact], attribute, self._truth[contact], streams, strict=True)
        pairs = [verified_answer(self._policy, *row) for row in of_rows]
        answers: dict[str, Any] = dict(
            zip(("answer", "answer_mask"), map(np.stack, zip(*pairs, strict=True)), strict=True)
        )
        return dataclasses.replace(batch, **answers)


def labelled_questions(label: Int[np.ndarray, "n A"]) -> tuple[np.ndarray, np.ndarray]:
    """Contact and attribute of every question that has an answer.

    Raises:
      NoLabelsError: no label is known.
    """
    contact, attribute = np.nonzero(label >= 0)
    if not len(contact):
        raise NoLabelsError(
            f"label has {len(label)} rows and none is known (≥ 0): label some objects of this part, as with "
            "`python -m sensors_io label RECORDS --labels LABELS.csv --annotator NAME`"
        )
    return contact, attribute


def question_batch(
    policy: TouchPolicy,
    features: Features,
    label: np.ndarray,
    contact: np.ndarray,
    attribute: np.ndarray,
    streams: np.ndarray,
) -> GRPOBatch:
    """One question per row: row i asks attribute[i] about contact[i], shown streams[i]; rewards see all its labels."""
    chosen = take(features, contact)
    asked: dict[str, Any] = {
        "ids": policy.layout.ids[attribute],
        "mask": policy.layout.mask[attribute],
        "ordered": policy.ordered[attribute],
    }
    return GRPOBatch(
        features=dataclasses.replace(chosen, stream_mask=chosen.stream_mask & streams),
        target=policy.target(attribute, label[contact], streams),
        **asked,
    )


def equal_blocks(total: int, size: int) -> Iterator[tuple[np.ndarray, int]]:
    """Index blocks of one fixed size over 0 … total − 1, the last padded by repeats, with the number of real rows."""
    for start in range(0, total, size):
        rows = np.arange(start, start + size)
        yield np.minimum(rows, total - 1), min(size, total - start)
