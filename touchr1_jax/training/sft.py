"""Stage 2, supervised fine-tuning: imitate verified answers, with a loss on the answers' tokens only.

Every contact is encoded once and answers Q questions, so the encoder's cost is shared.  A batch of encoded
contacts trains only the decoder, with the same loss.  The gradient is summed over
micro-batches of contacts, and logits of a large vocabulary exist for some tokens at a time only.  Questions with their
answers are padded to one length, or packed into rows (`packing`), which gives the same gradient.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.chunked_logits import MAX_LOGITS, Rows, by_blocks
from touchr1_jax.models.policy import Features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.gradient import batches_of
from touchr1_jax.rl.losses import token_log_probs
from touchr1_jax.training.packing import PackedRows, Tokens, padded_tokens, row_of
from touchr1_jax.types import Params, TouchBatch


@struct.dataclass
class SFTBatch:
    """P contacts with Q question–answer pairs each; `streams` says which sensors a question may feel.

    `touch` is a `TouchBatch`, or its encoded features; then no gradient reaches the encoder.  For trajectories, `touch`
    is their `Explored` observations, and Q = 1.
    """

    touch: Any
    ids: Int[Array, "P Q L"]
    mask: Bool[Array, "P Q L"]
    streams: Bool[Array, "P Q S"]
    tokens: Int[Array, "P Q T"]
    token_mask: Bool[Array, "P Q T"]
    rows: PackedRows | None = None
    """Where the tokens stand in rows; `None` pads every question and answer."""
    weight: Float[Array, "P Q T"] | None = None
    """Weight of each answer token in the loss; `None` weighs all alike."""


@struct.dataclass
class SFTState:
    """Training state."""

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]


def make_sft_step(
    fns: PolicyFns,
    optimizer: optax.GradientTransformation,
    *,
    blind: bool = False,
    max_logits: int = MAX_LOGITS,
    micro_contacts: int | None = None,
) -> Callable[[SFTState, SFTBatch], tuple[SFTState, dict[str, Array]]]:
    """Build the jitted step, (state, batch) → (state, metrics).

    Args:
      fns: policy, prompts, vocabulary.
      optimizer: applied to the gradient of `sft_loss`.
      blind: train without touch.
      max_logits: most logits that exist at once (see `models.chunked_logits`).
      micro_contacts: contacts of a micro-batch, whose working set stays in cache; `None` takes all at once.
    """

    def step(state: SFTState, batch: SFTBatch) -> tuple[SFTState, dict[str, Array]]:
        (value, right), grads = sft_gradient(
            fns, state.params, batch, blind=blind, max_logits=max_logits, micro_contacts=micro_contacts
        )
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics = {"loss": value, "token_accuracy": right, "grad_norm": optax.tree.norm(grads)}
        return SFTState(params=params, opt_state=opt_state, step=state.step + 1), metrics

    return jax.jit(step, donate_argnums=0)


def sft_gradient(
    fns: PolicyFns,
    params: Params,
    batch: SFTBatch,
    *,
    blind: bool = False,
    max_logits: int = MAX_LOGITS,
    micro_contacts: int | None = None,
) -> tuple[tuple[Float[Array, ""], Float[Array, ""]], Params]:
    """Result of `sft_loss` for the batch, and the gradient of the loss, summed over micro-batches.

    Neighbours are in different micro-batches, so if devices share the contacts, each has some of every micro-batch.  A
    packed batch is computed by rows: groups in parallel, and the rows of a group one after the other.

    Raises:
      ValueError: contacts that do not divide into micro-batches, or rows that were packed for others.
    """
    contacts = batch.tokens.shape[0]
    micro = contacts if micro_contacts is None else micro_contacts
    if micro < 1 or contacts % micro:
        raise ValueError(
            f"micro_contacts is {micro_contacts}: must divide the {contacts} contacts of a batch; change either"
        )
    if batch.rows is not None and batch.rows.micro_batches != contacts // micro:
        raise ValueError(
            f"rows were packed for {batch.rows.micro_batches} micro-batches: must be as many as the gradient's, "
            f"{contacts // micro}; pack with that number"
        )
    sizes = _sizes(batch)

    def share(params: Params, chunk: SFTBatch) -> tuple[Array, Array]:
        cost, right = sft_sums(fns, params, chunk, blind=blind, max_logits=max_logits)
        return cost / sizes[0], right / sizes[1]

    def body(total: Any, chunk: SFTBatch) -> tuple[Any, None]:
        if (rows := chunk.rows) is not None:
            return _add_rows(fns, params, chunk, rows, total, sizes, blind=blind, max_logits=max_logits), None
        return jax.tree.map(jnp.add, total, jax.value_and_grad(share, has_aux=True)(params, chunk)), None

    zero = jnp.zeros(())
    start = (zero, zero), jax.tree.map(jnp.zeros_like, params)
    return jax.lax.scan(body, start, batches_of(micro, batch))[0]


def sft_loss(
    fns: PolicyFns, params: Params, batch: SFTBatch, *, blind: bool = False, max_logits: int = MAX_LOGITS
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cross-entropy of the answer's tokens, −Σ w_t log π(o_t | q, touch, o_<t) / Σ w_t, and the share predicted right.

    Questions and answers are padded here, even those of a packed batch.
    """
    weights, tokens = _sizes(batch)
    cost, right = sft_sums(fns, params, batch, blind=blind, max_logits=max_logits)
    return cost / weights, right / tokens


def _sizes(batch: SFTBatch) -> tuple[Array, Array]:
    """Sum of the weights of the tokens that count, and their number; 1 where none counts."""
    number = jnp.maximum(jnp.sum(batch.token_mask), 1)
    if batch.weight is None:
        return number, number
    weights = masked.total(batch.weight, batch.token_mask)
    return jnp.where(weights > 0, weights, 1.0), number


def sft_sums(
    fns: PolicyFns, params: Params, batch: SFTBatch, *, blind: bool = False, max_logits: int = MAX_LOGITS
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """−Σ w_t log π(o_t | q, touch, o_<t) over the answer's tokens, and how many of them are predicted right."""
    features = encoded(fns, params, batch, blind=blind)

    def answer(features, ids, mask, streams, tokens):
        seen = dataclasses.replace(features, stream_mask=features.stream_mask & streams)
        return fns.group_states(params, seen, ids, mask, tokens[None])[0][0]

    per_question = jax.vmap(answer, in_axes=(None, 0, 0, 0, 0))
    states = jax.vmap(per_question)(features, batch.ids, batch.mask, batch.streams, batch.tokens)
    contacts = len(batch.tokens)
    rows = {"state": states.reshape(contacts, -1, states.shape[-1]), "token": batch.tokens.reshape(contacts, -1)}
    # contact by contact, each its share of the bound: blocks over all of them would cut across the devices
    most = max(1, max_logits // contacts)
    found = jax.vmap(lambda r: _scored(fns, params, r, most))(rows)
    log_prob, right = (found[name].reshape(batch.tokens.shape) for name in ("log_prob", "right"))
    log_prob = log_prob if batch.weight is None else batch.weight * log_prob
    return -masked.total(log_prob, batch.token_mask), masked.total(right, batch.token_mask).astype(jnp.float32)


def _scored(fns: PolicyFns, params: Params, rows: Rows, max_logits: int) -> Rows:
    """Log-probability of each token after its state, and whether it is the likeliest."""

    def score(rows: Rows) -> Rows:
        logits = fns.logits(params, rows["state"])
        log_prob = token_log_probs(jax.nn.log_softmax(logits), rows["token"])
        return {"log_prob": log_prob, "right": jnp.argmax(logits, -1) == rows["token"]}

    return by_blocks(score, rows, width=len(fns.banned), most=max_logits)


def row_scores(
    fns: PolicyFns,
    params: Params,
    seen: Float[Array, "n E"],
    tokens: Tokens,
    source: Int[Array, "W"],
    predicts: Int[Array, "K"],
    max_logits: int = MAX_LOGITS,
) -> Rows:
    """Log-probability `log_prob` [K] of the token after each predicting place of a row, and whether it is `right`.

    Args:
      fns, params, max_logits: as in `sft_gradient`.
      seen: encoded touch and view of the contacts of a group.
      tokens: of the examples of the group.
      source, predicts: the row, as in `PackedRows`; results for places −1 have no meaning.
    """
    row, following = row_of(tokens, source, predicts)
    states = fns.packed_states(params, seen, row)
    return _scored(fns, params, {"state": states, "token": following}, max_logits)


def encoded(fns: PolicyFns, params: Params, batch: SFTBatch, *, blind: bool = False) -> Any:
    """The features of a batch's contacts, encoded if necessary."""
    return fns.encode(params, batch.touch, blind=blind) if isinstance(batch.touch, TouchBatch) else batch.touch


def encoded_group(
    fns: PolicyFns, params: Params, batch: SFTBatch, *, blind: bool = False
) -> tuple[Float[Array, "P n E"], Features]:
    """Tokens of each contact's streams and view, one after the other, and their features."""
    features = encoded(fns, params, batch, blind=blind)
    touch = features.touch.reshape(len(features.touch), -1, features.touch.shape[-1])
    levels = features.view.shape[-1] - touch.shape[-1]  # of a vision tower with DeepStack; touch has none
    touch = jnp.pad(touch, [(0, 0), (0, 0), (0, levels)])
    return jnp.concatenate([touch, features.view.astype(touch.dtype)], 1), features


def _add_rows(
    fns: PolicyFns,
    params: Params,
    chunk: SFTBatch,
    rows: PackedRows,
    total: Any,
    sizes: tuple[Array, Array],
    *,
    blind: bool,
    max_logits: int,
) -> Any:
    """`total`, values with their gradient, and what the rows of a micro-batch add to them.

    As many rows are computed as the fullest group has.  Their gradients with respect to the encoded contacts are
    summed, and go through the encoder once.
    """
    encode = lambda p: encoded_group(fns, p, chunk, blind=blind)
    encoded, back, features = jax.vjp(encode, params, has_aux=True)
    groups = len(encoded) // rows.contacts
    by_group = lambda x: x.reshape(groups, -1, *x.shape[2:])
    prompt = chunk.ids, chunk.mask, chunk.streams, chunk.tokens
    made = padded_tokens(fns.module, fns.slots, features, *prompt, rows.contacts)
    source, predicts, tokens = jax.tree.map(by_group, (rows.source, rows.predicts, made))
    of_group = functools.partial(row_scores, fns, max_logits=max(1, max_logits // groups))
    prompts = jnp.ones(chunk.ids.shape)
    weight = None if chunk.weight is None else by_group(jnp.concatenate([prompts, chunk.weight], -1))

    def share(params: Params, seen: Array, i: Array) -> tuple[Array, Array]:
        found = jax.vmap(of_group, in_axes=(None, 0, 0, 0, 0))(params, seen, tokens, source[:, i], predicts[:, i])
        if weight is not None:
            found["log_prob"] *= _following(weight, source[:, i], predicts[:, i])
        log_prob, right = (masked.total(found[name], predicts[:, i] >= 0) for name in ("log_prob", "right"))
        return -log_prob / sizes[0], right.astype(jnp.float32) / sizes[1]

    def body(i: Array, carry: Any) -> Any:
        sums, to_encoder = carry
        values, (grads, to_seen) = jax.value_and_grad(share, argnums=(0, 1), has_aux=True)(params, by_group(encoded), i)
        return jax.tree.map(jnp.add, (sums, to_encoder), ((values, grads), to_seen))

    used = jnp.max(jnp.sum(jnp.any(source >= 0, -1), -1))
    (values, grads), to_seen = jax.lax.fori_loop(0, used, body, (total, jnp.zeros_like(by_group(encoded))))
    return values, jax.tree.map(jnp.add, grads, back(to_seen.reshape(encoded.shape))[0])


def _following(
    values: Float[Array, "group E n"], source: Int[Array, "group W"], predicts: Int[Array, "group K"]
) -> Float[Array, "group K"]:
    """Of the tokens of each group's examples, the value of the one that follows each predicting place of a row."""
    after = jnp.clip(predicts + 1, 0, source.shape[-1] - 1)
    token = jnp.maximum(jnp.take_along_axis(source, after, -1), 0)
    return jnp.take_along_axis(values.reshape(len(values), -1), token, -1)
