"""Batches of SFT: clips with questions and verified answers.  Batches of GRPO are in `questions`.

A feed wraps a Grain iterator and counts the batches that it made; its own randomness is a function of (seed, count), so
that `set_state` resumes it exactly.  Batches are NumPy arrays: the step puts a batch on its devices, and a mesh
splits it without fetching it back.  If the feed put each array on a device, it would wait while threads that write a
checkpoint hold Python's lock.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, Self

import grain
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.text.template import answer_text, encode_answer
from touchr1_jax.training.packing import PackedRows, Packing, existing_tokens, pack_rows
from touchr1_jax.training.sft import SFTBatch
from touchr1_jax.types import TouchBatch

ONE_AT_A_TIME = grain.ReadOptions(num_threads=0, prefetch_buffer_size=0)
"""Reading options of a feed of row numbers: by default Grain shuffles 500 batches ahead, seconds of a core."""


class Feed:
    """A Grain iterator with a count; subclasses turn its elements into batches."""

    def __init__(self, elements: Iterable[Any], seed: int) -> None:
        self._elements: Any = iter(elements)
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
        raise TypeError(f"{type(self).__name__}.make is not defined: a feed must make batches; define it")

    def get_state(self) -> dict[str, Any]:
        """Position of the feed, as JSON."""
        return {"count": self._count, "elements": self._elements.get_state()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go back to a state that `get_state` gave."""
        self._count = state["count"]
        self._elements.set_state(state["elements"])


def host_touch(clip: Mapping[str, Any]) -> TouchBatch:
    """The arrays of a clip batch as the JAX batch type, on the host; do not change them afterwards."""
    return TouchBatch(**{field.name: clip[field.name] for field in dataclasses.fields(TouchBatch)})


def touch_batch(clip: Mapping[str, Any]) -> TouchBatch:
    """The same on the device, for computation outside a compiled program."""
    return jax.device_put(host_touch(clip))


def take(features: Features, rows: np.ndarray) -> Features:
    """Rows of encoded contacts on the host."""
    return jax.tree.map(lambda x: x[rows], features)


def encoded_clips(
    features: Features,
    contact: np.ndarray,
    label: np.ndarray,
    *,
    batch_size: int,
    seed: int,
    own: np.ndarray | None = None,
) -> grain.IterDataset:
    """Endless batches of encoded contacts in random order, instead of the clips of an `AnswerFeed`.

    Args:
      features: of n contacts.
      contact: [n], their numbers.
      label: [n, A].
      batch_size, seed, own: as in `AnswerFeed`.
    """
    own = np.arange(batch_size) if own is None else own

    def gather(rows: np.ndarray) -> dict[str, Any]:
        encoded = take(features, rows[own])
        stream_mask = np.asarray(encoded.stream_mask)
        return {"contact": contact[rows[own]], "label": label[rows[own]], "stream_mask": stream_mask, ENCODED: encoded}

    order = grain.MapDataset.range(len(contact)).seed(seed).shuffle().repeat().batch(batch_size, drop_remainder=True)
    return order.map(gather).to_iter_dataset(ONE_AT_A_TIME)


ENCODED = "encoded"
"""Entry of a batch of clips that holds `Features` in the place of pictures."""


def random_streams(present: np.ndarray, full_share: float, rng: np.random.Generator) -> np.ndarray:
    """Sensors whose touch a question shows: all present ones with probability `full_share`, else a random subset ≠ ∅.

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
"""Share of the questions of SFT that show all present sensors."""


def falling_share(step: int, steps: int) -> float:
    """Curriculum: the share falls from 1 within some steps, 1 − (1 − `FULL_SHARE`) min(step / steps, 1)."""
    return 1 - (1 - FULL_SHARE) * min(step / steps, 1) if steps else FULL_SHARE


class AnswerFeed(Feed):
    """SFT batches: each contact with Q questions about different attributes at random, and the verified answers.

    Args:
      policy: prompts and vocabulary.
      clips: batches of clips, mappings with the arrays of `TouchBatch` and the number `contact` of each, or
        `encoded_clips`.
      evidence: [contact, S, A, K], out-of-fold log-probabilities of each sensor's probe.  `perceive` gives the level
        most likely to each sensor alone, `compare` the one most likely to the shown sensors together, `conclude` the
        label.
      batch_size: contacts of a whole batch.
      questions: Q, at most one about each attribute.
      seed: of the questions.
      blind: show no touch.
      easy_steps: batches within which the share of questions that show all sensors falls to `FULL_SHARE`.
      conclusion_weight: of a concluded level in the loss, where that of every other token is 1.
      packing: put tokens into rows; `None` pads.
      own: rows of a batch that this process reads; all by default.

    Raises:
      ValueError: more questions than the policy has; a weight of the conclusion where a level is several tokens.
    """

    def __init__(
        self,
        policy: TouchPolicy,
        clips: Iterable[Any],
        evidence: np.ndarray,
        *,
        batch_size: int,
        questions: int,
        seed: int,
        blind: bool = False,
        easy_steps: int = 0,
        conclusion_weight: float = 1.0,
        packing: Packing | None = None,
        own: np.ndarray | None = None,
    ) -> None:
        if questions > len(policy.layout.ids):
            raise ValueError(
                f"questions is {questions}: must be at most {len(policy.layout.ids)}, one for each attribute; lower it"
            )
        super().__init__(clips, seed)
        self._batch_size, self._own = batch_size, np.arange(batch_size) if own is None else own
        self._policy, self._evidence, self._blind = policy, evidence, blind
        self._questions, self._packing, self._easy_steps = questions, packing, easy_steps
        self._conclusion_weight = conclusion_weight
        self._levels = None if conclusion_weight == 1 else policy.level_tokens

    def make(self, element: Mapping[str, Any], rng: np.random.Generator) -> SFTBatch:
        """Write the answers of one batch of clips; random numbers are drawn for the whole batch, not for `own`."""
        layout, (p, a), q = self._policy.layout, element["label"].shape, self._questions
        chosen = np.argsort(rng.random((self._batch_size, a)), 1)[self._own, :q]
        present = np.ones((self._batch_size, element["stream_mask"].shape[1]), bool)
        present[self._own] = element["stream_mask"]
        present = np.repeat(present, q, 0)
        full_share = falling_share(self._count - 1, self._easy_steps)
        streams = np.zeros_like(present) if self._blind else random_streams(present, full_share, rng)
        streams = streams.reshape(self._batch_size, q, -1)[self._own]
        pairs = [
            verified_answer(
                self._policy, self._evidence[element["contact"][i]], chosen[i, j], element["label"][i], streams[i, j]
            )
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
        if self._levels is not None:
            written["weight"] = np.where(self._levels.concluded(tokens), np.float32(self._conclusion_weight), 1)
        touch: TouchBatch | Features = element[ENCODED] if ENCODED in element else host_touch(element)
        return SFTBatch(touch=touch, rows=self._rows(touch, written), **written)

    def _rows(self, touch: TouchBatch | Features, written: dict[str, np.ndarray]) -> PackedRows | None:
        if self._packing is None:
            return None
        if isinstance(touch, Features):
            raise ValueError("packing is set, but the contacts are encoded: must be None for them; set pack to 0")
        fns, token_mask = self._policy.fns, written["token_mask"]
        exists = existing_tokens(fns.module, fns.slots, touch, written["mask"], written["streams"], token_mask)
        return pack_rows(exists, token_mask, self._packing)


def verified_answer(
    policy: TouchPolicy,
    log_prob: Float[np.ndarray, "S A K"],
    question: int | np.integer,
    label: Int[np.ndarray, "A"],
    streams: Bool[np.ndarray, "S"],
) -> tuple[Int[np.ndarray, "T"], Bool[np.ndarray, "T"]]:
    """Tokens of the answer that SFT imitates, and which of them count: none if the label is unknown.

    A sensor without evidence, equal log-probabilities as of a probe that was never fitted, repeats `compare`, what the
    others show together; `compare` repeats the label if none has any.

    Args:
      policy: prompts and vocabulary.
      log_prob: each sensor's evidence about this contact.
      question: its number in the layout.
      label: of the contact.
      streams: sensors that the question shows.
    """
    asked, length = policy.layout.asked[question], policy.model.completion_tokens
    if np.any(label[asked] < 0):
        return np.full(length, policy.tokenizer.pad_id, np.int32), np.zeros(length, bool)
    lowest = np.where(np.isneginf(log_prob), np.inf, log_prob).min(-1)  # of the levels that an attribute has
    informed = streams[:, None] & (log_prob.max(-1) > lowest)
    together = np.where(informed.any(0), np.where(informed[..., None], log_prob, 0).sum(0).argmax(-1), label)
    text = answer_text(
        policy.language,
        asked=asked,
        streams=streams,
        perceive=np.where(informed, log_prob.argmax(-1), together),
        compare=together,
        conclude=label,
    )
    return encode_answer(policy.tokenizer, text, length)
