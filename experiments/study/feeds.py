"""Batches for the stages: clips with answers for SFT, encoded contacts with questions for GRPO and evaluation.

A feed wraps a Grain iterator and counts what it has drawn; its own randomness is a function of (seed, count), so that
`set_state` resumes it exactly.  Batches are NumPy arrays: the step that takes one puts it on its devices, and a mesh
splits it without fetching it back.  Put there array by array, they would be held up two dozen times while the threads
that write a checkpoint hold Python's lock.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, Self

import grain
import jax
import numpy as np
from jaxtyping import Int

from experiments.core.errors import DataError
from experiments.study.assembly import Assembly
from experiments.study.dataset import Dataset
from sensors_io.augment import AugmentConfig
from sensors_io.schema import CLIP_ARRAYS
from touchr1_jax.models.policy import Features
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.text.template import answer_text, encode_answer
from touchr1_jax.training.packing import PackedRows, Packing, existing_tokens, pack_rows
from touchr1_jax.training.sft import SFTBatch
from touchr1_jax.types import TouchBatch

ONE_AT_A_TIME = grain.ReadOptions(num_threads=0, prefetch_buffer_size=0)
"""How to read an order of rows: left to itself Grain shuffles 500 batches ahead, seconds of a core at every start."""


class Feed:
    """A Grain iterator with a count; subclasses turn its elements into batches."""

    def __init__(self, elements: grain.IterDataset, seed: int) -> None:
        self._elements = iter(elements)
        self._seed = seed
        self._count = 0

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Any:
        element = next(self._elements)
        rng = np.random.default_rng((self._seed, self._count))
        self._count += 1
        return self.make(element, rng)

    def make(self, element: Any, rng: np.random.Generator) -> Any:
        """One batch from one element."""
        raise TypeError(f"{type(self).__name__} must say how it makes a batch")

    def get_state(self) -> dict[str, Any]:
        """Where the feed is, as JSON."""
        return {"count": self._count, "elements": self._elements.get_state()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go back to a state that `get_state` gave."""
        self._count = state["count"]
        self._elements.set_state(state["elements"])


def host_touch(clip: Mapping[str, Any]) -> TouchBatch:
    """The arrays of a clip batch as the JAX batch type, on the host; they must not be written to any more."""
    return TouchBatch(**{name: clip[name] for name in CLIP_ARRAYS})


def touch_batch(clip: Mapping[str, Any]) -> TouchBatch:
    """The same on the device, for whoever computes with it outside of a compiled program."""
    return jax.device_put(host_touch(clip))


def random_streams(present: np.ndarray, full_share: float, rng: np.random.Generator) -> np.ndarray:
    """Which present sensors a question may feel: all with probability `full_share`, else a random non-empty subset.

    Args:
      present: bool [n, S].
      full_share: probability of all.
      rng: source of randomness.
    """
    n, s = present.shape
    size = rng.integers(1, s + 1, (n, 1))
    rank = np.argsort(np.argsort(rng.random((n, s)), 1), 1)
    subset = present & (rank < size)
    use = (rng.random((n, 1)) >= full_share) & subset.any(1, keepdims=True)
    return np.where(use, subset, present)


FULL_SHARE = 0.5
"""Share of the questions of SFT that all present sensors feel."""


def falling_share(step: int, steps: int) -> float:
    """The same share where it falls from 1 within so many steps, 1 − (1 − `FULL_SHARE`) min(step / steps, 1)."""
    return 1 - (1 - FULL_SHARE) * min(step / steps, 1) if steps else FULL_SHARE


class AnswerFeed(Feed):
    """SFT batches: each contact with Q questions, for different attributes at random, and the verified answers to them.

    `evidence` [contact, S, A, K] are out-of-fold log-probabilities of each sensor's probe: `perceive` says the level
    most likely to each sensor alone, `compare` the one most likely to the present sensors together, `conclude` the
    label.  `augment` changes what is felt at random; the evidence stays that of the unchanged contact.  In the
    first `easy_steps` batches more questions than later are felt by all sensors.  With `packing` the tokens are put
    into rows.  Where several processes share a batch, each reads the rows `own` of it.
    """

    def __init__(
        self,
        assembly: Assembly,
        data: Dataset,
        evidence: np.ndarray,
        *,
        batch_size: int,
        questions: int,
        seed: int,
        blind: bool = False,
        augment: AugmentConfig | None = None,
        easy_steps: int = 0,
        packing: Packing | None = None,
        own: np.ndarray | None = None,
    ) -> None:
        clips = data.batches(
            data.parts["sft"], batch_size=batch_size, seed=seed, own=own, felt=not blind, augment=augment
        )
        super().__init__(clips, seed)
        self._batch_size, self._own = batch_size, np.arange(batch_size) if own is None else own
        self._assembly, self._evidence, self._blind = assembly, evidence, blind
        self._questions, self._packing, self._easy_steps = questions, packing, easy_steps

    def make(self, element: dict[str, np.ndarray], rng: np.random.Generator) -> SFTBatch:
        """Write the answers of one batch of clips; what is drawn for them is drawn for the whole batch."""
        layout, (p, a), q = self._assembly.layout, element["label"].shape, self._questions
        chosen = np.argsort(rng.random((self._batch_size, a)), 1)[self._own, :q]
        present = np.ones((self._batch_size, element["stream_mask"].shape[1]), bool)
        present[self._own] = element["stream_mask"]
        present = np.repeat(present, q, 0)
        full_share = falling_share(self._count - 1, self._easy_steps)
        streams = np.zeros_like(present) if self._blind else random_streams(present, full_share, rng)
        streams = streams.reshape(self._batch_size, q, -1)[self._own]
        pairs = [
            self._answer(element["contact"][i], chosen[i, j], element["label"][i], streams[i, j])
            for i in range(p)
            for j in range(q)
        ]
        tokens, masks = (np.stack(x).reshape(p, q, -1) for x in zip(*pairs, strict=True))
        written: dict[str, Any] = {
            "ids": layout.ids[chosen],
            "mask": layout.mask[chosen],
            "streams": streams,
            "tokens": tokens,
            "token_mask": masks,
        }
        touch = host_touch(element)
        return SFTBatch(touch=touch, rows=self._rows(touch, written), **written)

    def _rows(self, touch: TouchBatch, written: dict[str, np.ndarray]) -> PackedRows | None:
        if self._packing is None:
            return None
        fns, token_mask = self._assembly.fns, written["token_mask"]
        exists = existing_tokens(fns.module, fns.slots, touch, written["mask"], written["streams"], token_mask)
        return pack_rows(exists, token_mask, self._packing)

    def _answer(
        self, contact: int, question: int, label: np.ndarray, streams: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        assembly, asked = self._assembly, self._assembly.layout.asked[question]
        length = assembly.model.completion_tokens
        if np.any(label[asked] < 0):  # nobody annotated it: the question has no answer and no loss
            return np.full(length, assembly.tokenizer.pad_id, np.int32), np.zeros(length, bool)
        log_prob = self._evidence[contact]
        together = label if not streams.any() else log_prob[streams].sum(0).argmax(-1)
        text = answer_text(
            assembly.language,
            asked=asked,
            streams=streams,
            perceive=log_prob.argmax(-1),
            compare=together,
            conclude=label,
        )
        return encode_answer(assembly.tokenizer, text, length)


class QuestionFeed(Feed):
    """GRPO batches: encoded contacts in random order, each with the question for one attribute.

    Where several processes share a batch, each makes the rows `own` of it.
    """

    def __init__(
        self,
        assembly: Assembly,
        features: Features,
        label: np.ndarray,
        *,
        batch_size: int,
        seed: int,
        full_share: float = 0.75,
        own: np.ndarray | None = None,
    ) -> None:
        contact, attribute = labelled(label)
        order = grain.MapDataset.range(len(contact)).seed(seed).shuffle().repeat().batch(batch_size)
        super().__init__(order.to_iter_dataset(ONE_AT_A_TIME), seed)
        self._assembly, self._features, self._label = assembly, features, label
        self._contact, self._attribute, self._full_share = contact, attribute, full_share
        self._own = np.arange(batch_size) if own is None else own

    def make(self, element: np.ndarray, rng: np.random.Generator) -> GRPOBatch:
        """Gather the features of one batch of questions."""
        contact, attribute = self._contact[element], self._attribute[element]
        streams = random_streams(np.asarray(self._features.stream_mask)[contact], self._full_share, rng)
        own = self._own
        return question_batch(self._assembly, self._features, self._label, contact[own], attribute[own], streams[own])


def labelled(label: Int[np.ndarray, "n A"]) -> tuple[np.ndarray, np.ndarray]:
    """Contact and attribute of every question that has an answer.

    Raises:
      DataError: no label is known.
    """
    contact, attribute = np.nonzero(label >= 0)
    if not len(contact):
        raise DataError(f"label has {len(label)} rows and none is known (≥ 0): annotate some contacts of this part")
    return contact, attribute


def question_batch(
    assembly: Assembly,
    features: Features,
    label: np.ndarray,
    contact: np.ndarray,
    attribute: np.ndarray,
    streams: np.ndarray,
) -> GRPOBatch:
    """One question per row: row i asks attribute[i] about contact[i], felt by streams[i]."""
    chosen = take(features, contact)
    asked: dict[str, Any] = {
        "ids": assembly.layout.ids[attribute],
        "mask": assembly.layout.mask[attribute],
        "ordered": assembly.ordered[attribute],
    }
    return GRPOBatch(
        features=dataclasses.replace(chosen, stream_mask=chosen.stream_mask & streams),
        target=assembly.target(attribute, label[contact], streams),
        **asked,
    )


def take(features: Features, rows: np.ndarray) -> Features:
    """Rows of encoded contacts, on the host as these are."""
    return jax.tree.map(lambda x: x[rows], features)


def each(total: int, size: int) -> Iterator[tuple[np.ndarray, int]]:
    """Index blocks of one fixed size over 0 … total − 1, the last padded by repeats, with the number of real rows."""
    for start in range(0, total, size):
        rows = np.arange(start, start + size)
        yield np.minimum(rows, total - 1), min(size, total - start)
