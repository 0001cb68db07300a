"""Packing of question–answer pairs of different lengths into rows of one width, with little padding.

    P contacts × Q questions, each L prompt and T answer tokens, some of which exist  →  rows of W tokens, mostly full

A row holds whole examples, one after the other; in the decoder, no example sees another.  A packed batch states only
the source of each token of a row: ids, embeddings and positions are those of the padded batch.  `pack_rows` makes it on
the host, in NumPy, from the batch only; `row_of` reads it in the compiled step.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Int

from touchr1_jax.models.blocked_attention import Segments
from touchr1_jax.models.policy import Features, Policy, Row, Slots, prompt_mask, prompt_positions
from touchr1_jax.types import TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class Packing:
    """Rows of `width` tokens, shared by the questions about `contacts` contacts.

    These contacts belong to one device and to one of the `micro_batches` micro-batches of the gradient.

    Raises:
      ValueError: a number below 1.
    """

    width: int
    contacts: int
    micro_batches: int = 1

    def __post_init__(self) -> None:
        for field in ("width", "contacts", "micro_batches"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field} is {getattr(self, field)}: must be at least 1; raise it")


@struct.dataclass
class PackedRows:
    """Rows of W tokens, of which at most K states predict a token of an answer.

    The rows of a group of contacts are at the places of its contacts, r for each contact, nonempty rows first.  There
    are enough rows for all examples of any group; a step computes only nonempty rows.

    Attributes:
      source: number of the token among the L + T of every example of its group, example by example; −1 is padding.
      predicts: places in the row whose hidden states predict a token that counts; −1 for none.
      contacts, micro_batches: as in `Packing`.
    """

    source: Int[Array, "P r W"]
    predicts: Int[Array, "P r K"]
    contacts: int = struct.field(pytree_node=False)
    micro_batches: int = struct.field(pytree_node=False)


def existing_tokens(
    policy: Policy,
    slots: Slots,
    touch: TouchBatch,
    mask: Bool[np.ndarray, "P Q L"],
    streams: Bool[np.ndarray, "P Q S"],
    token_mask: Bool[np.ndarray, "P Q T"],
) -> Bool[np.ndarray, "P Q n"]:
    """Which tokens of each example exist: those of `prompt_mask`, and the answer up to the last token that counts.

    An example without an answer teaches nothing, and none of its tokens exists.

    Args:
      policy: defines the frames of a time step.
      slots: of the prompt.
      touch: on the host.
      mask, streams, token_mask: as in `SFTBatch`.
    """
    c = policy.config.tactile
    frames = np.asarray(touch.frame_mask)
    steps = frames.reshape(*frames.shape[:-1], -1, c.frames_per_step).any(-1).repeat(c.tokens_per_step, -1)
    shown = np.asarray(touch.stream_mask)[:, None] & streams
    prompt = np.array(mask)
    prompt[..., slots.touch] = shown[..., None] & steps[:, None]
    prompt[..., slots.view] = touch.view_mask[:, None, None]
    viewed = np.broadcast_to(touch.view_mask[:, None, None], (*shown.shape[:2], 1))
    named = np.concatenate([shown, viewed], -1)[..., np.maximum(slots.stream_text, 0)]
    prompt &= np.where(slots.stream_text >= 0, named, True)
    if slots.step_text is not None:
        prompt &= np.where(slots.step_text >= 0, prompt[..., np.maximum(slots.step_text, 0)], True)
    answer = np.logical_or.accumulate(token_mask[..., ::-1], -1)[..., ::-1]
    return np.concatenate([prompt & token_mask.any(-1, keepdims=True), answer], -1)


def pack_rows(exists: Bool[np.ndarray, "P Q n"], token_mask: Bool[np.ndarray, "P Q T"], packing: Packing) -> PackedRows:
    """Put the examples of each group into rows, the longest first, each into the first row that has room.

    Contact p is number p // micro_batches of micro-batch p % micro_batches, as `sft_gradient` takes them; `contacts`
    neighbours of a micro-batch are a group.  A row has room for W tokens and, so that the last layer computes little
    else, for K = ⌈W T / (L + T)⌉ that are predicted, at least T.

    Args:
      exists: from `existing_tokens`.
      token_mask: answer tokens that count.
      packing: width and groups.

    Raises:
      ValueError: contacts that make no whole groups, or an example longer than a row.
    """
    (p, q, n), t = exists.shape, token_mask.shape[-1]
    if p % (packing.micro_batches * packing.contacts):
        raise ValueError(
            f"contacts is {packing.contacts}: {packing.micro_batches} micro-batches of such groups must divide the {p} "
            "contacts of a batch; change either"
        )
    sizes, width = exists.sum(-1), packing.width
    if sizes.max(initial=0) > width:
        at = tuple(int(i) for i in np.unravel_index(sizes.argmax(), sizes.shape))
        raise ValueError(
            f"width is {width}: contact {at[0]}, question {at[1]} has {sizes[at]} tokens and must fit into a row; "
            f"{n} are always enough"
        )
    most = max(t, -(-width * t // n))
    surely = max(1, min(width // n, most // t))  # so many examples fit into a row, however long they are
    rows = -(-packing.contacts * q // surely)
    grouped = lambda x: _by_group(x, packing)
    source, predicts = _filled(grouped(exists), grouped(token_mask), width, most, rows)
    placed = lambda x: _by_contact(x, packing, -(-rows // packing.contacts))
    made: dict[str, Any] = {"source": placed(source), "predicts": placed(predicts)}
    return PackedRows(**made, contacts=packing.contacts, micro_batches=packing.micro_batches)


def first_fit(sizes: Int[np.ndarray, "E k"], room: Sequence[int]) -> Int[np.ndarray, "E"]:
    """Row of each example, the largest first, each into the first row that has room of every kind.

    If any m examples fit into a row, E examples take at most ⌈E/m⌉ rows.  Examples of no size get row −1.

    Args:
      sizes: of each example, of k kinds; the first decides which is larger.
      room: of a row, of each kind; every example must fit.
    """
    left: list[list[int]] = []
    found = np.full(len(sizes), -1)
    for example in np.argsort(-sizes[:, 0], kind="stable"):
        size = sizes[example].tolist()
        if not any(size):
            continue
        fits = (i for i, free in enumerate(left) if all(a <= b for a, b in zip(size, free, strict=True)))
        row = next(fits, len(left))
        if row == len(left):
            left.append(list(room))
        left[row] = [b - a for a, b in zip(size, left[row], strict=True)]
        found[example] = row
    return found


def filled(rows: PackedRows) -> tuple[int, int]:
    """Number of existing tokens, and of computed tokens if one group is computed at a time."""
    source = np.asarray(rows.source)
    return int((source >= 0).sum()), int((source >= 0).any(-1).sum()) * source.shape[-1]


class Tokens(NamedTuple):
    """All tokens of examples, n = L + T each, existing or not.

    `feature` is the number of a tactile or view token among those of a group's contacts, −1 for a word.
    """

    ids: Int[Array, "*e n"]
    positions: Int[Array, "*e 3 n"]
    feature: Int[Array, "*e n"]


def padded_tokens(
    policy: Policy,
    slots: Slots,
    features: Features,
    ids: Int[Array, "P Q L"],
    mask: Bool[Array, "P Q L"],
    streams: Bool[Array, "P Q S"],
    tokens: Int[Array, "P Q T"],
    contacts: int,
) -> Tokens:
    """The tokens of Q examples about each of P contacts, [P Q]; the answer's positions follow the prompt's.

    Args:
      policy, slots: of the prompt.
      features: encoded contacts; the tokens of a contact are those of its streams, then those of its view.
      ids, mask, streams, tokens: as in `SFTBatch`.
      contacts: of a group, which are neighbours.
    """
    touch_tokens, t = features.touch.shape[-3] * features.touch.shape[-2], tokens.shape[-1]

    def positions(seen: Features, mask: Array, streams: Array) -> Array:
        seen = dataclasses.replace(seen, stream_mask=seen.stream_mask & streams)
        exists = prompt_mask(seen, mask, slots)
        prompt = prompt_positions(seen.touch_time, exists, slots, policy.config.grid)
        after = jnp.max(jnp.where(exists, prompt, -1)) + 1 + jnp.arange(t)
        return jnp.concatenate([prompt, jnp.broadcast_to(after, (3, t))], -1)

    place = np.full(ids.shape[-1] + t, -1)
    place[slots.touch] = np.arange(touch_tokens).reshape(slots.touch.shape)
    place[slots.view] = touch_tokens + np.arange(len(slots.view))
    before = (touch_tokens + len(slots.view)) * (jnp.arange(len(ids)) % contacts)
    feature = jnp.where(place >= 0, before[:, None, None] + place, -1)
    return Tokens(
        ids=jnp.concatenate([ids, tokens], -1),
        positions=jax.vmap(jax.vmap(positions, in_axes=(None, 0, 0)))(features, mask, streams),
        feature=jnp.broadcast_to(feature, (*ids.shape[:2], len(place))),
    )


def row_of(tokens: Tokens, source: Int[Array, "W"], predicts: Int[Array, "K"]) -> tuple[Row, Int[Array, "K"]]:
    """One row of a group, and the tokens that follow its predicting places.

    Args:
      tokens: of the examples of the group, [E].
      source, predicts: as in `PackedRows`; place 0 if there is none.
    """
    n = tokens.ids.shape[-1]
    example, slot = jnp.maximum(source, 0) // n, jnp.maximum(source, 0) % n
    ids, places = tokens.ids[example, slot], jnp.maximum(predicts, 0)
    row = Row(
        ids=ids,
        feature=jnp.where(source >= 0, tokens.feature[example, slot], -1),
        positions=tokens.positions[example, :, slot].T,
        segments=Segments(number=jnp.where(source >= 0, example, -1), reach=n),
        places=places,
    )
    return row, ids[jnp.minimum(places + 1, len(ids) - 1)]


def _filled(
    exists: Bool[np.ndarray, "group E n"], counted: Bool[np.ndarray, "group E T"], width: int, most: int, rows: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sources [group, rows, width] and predicting places [group, rows, most]."""
    groups, _, n = exists.shape
    source = np.full((groups, rows, width), -1, np.int32)
    predicts = np.full((groups, rows, most), -1, np.int32)
    sizes = np.stack([exists.sum(-1), counted.sum(-1)], -1)
    for g in range(groups):
        used = np.zeros((rows, 2), int)
        for e, row in enumerate(first_fit(sizes[g], (width, most))):
            if row < 0:
                continue
            (begin, said), (length, answers) = used[row], sizes[g, e]
            tokens = np.flatnonzero(exists[g, e])
            source[g, row, begin : begin + length] = e * n + tokens
            answer = np.flatnonzero(counted[g, e]) + n - counted.shape[-1]
            predicts[g, row, said : said + answers] = begin + np.searchsorted(tokens, answer) - 1
            used[row] += length, answers
    return source, predicts


def _by_group(x: np.ndarray, packing: Packing) -> np.ndarray:
    """[P, Q, …] as the examples of each group, [group, contacts · Q, …]: groups of a micro-batch stand together."""
    micro, size = packing.micro_batches, packing.contacts
    grouped = x.reshape(-1, size, micro, *x.shape[1:]).swapaxes(1, 2)
    return grouped.reshape(-1, size * x.shape[1], *x.shape[2:])


def _by_contact(x: np.ndarray, packing: Packing, rows: int) -> np.ndarray:
    """[group, …] as [P, rows, …], where −1 fills up what a group has too few of; undoes `_by_group`."""
    micro, size = packing.micro_batches, packing.contacts
    padded = np.full((len(x), rows * size, *x.shape[2:]), -1, x.dtype)
    padded[:, : x.shape[1]] = x
    by_contact = padded.reshape(-1, micro, size, rows, *x.shape[2:]).swapaxes(1, 2)
    return by_contact.reshape(-1, rows, *x.shape[2:])
