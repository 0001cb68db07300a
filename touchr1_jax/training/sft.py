"""Stage 2, supervised fine-tuning: imitate verified answers, the loss on the answer's tokens alone.

Every contact is encoded once and answers Q questions, so the encoder's cost is shared.  Logits of a large vocabulary
exist for some tokens at a time only.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.agent import Agent
from touchr1_jax.models.chunked import MAX_LOGITS, Rows, by_blocks
from touchr1_jax.rl.losses import token_log_probs
from touchr1_jax.types import Params, TouchBatch


@struct.dataclass
class SFTBatch:
    """P contacts with Q question–answer pairs each; `streams` says which sensors a question may feel."""

    touch: TouchBatch
    ids: Int[Array, "P Q L"]
    mask: Bool[Array, "P Q L"]
    streams: Bool[Array, "P Q S"]
    tokens: Int[Array, "P Q T"]
    token_mask: Bool[Array, "P Q T"]


@struct.dataclass
class SFTState:
    """What a step changes."""

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]


def make_sft_step(
    agent: Agent, optimizer: optax.GradientTransformation, *, blind: bool = False, max_logits: int = MAX_LOGITS
) -> Callable[[SFTState, SFTBatch], tuple[SFTState, dict[str, Array]]]:
    """Build the jitted step, (state, batch) → (state, metrics); a blind policy is trained without touch.

    `max_logits` may exist at once (see `models.chunked`).
    """

    def step(state: SFTState, batch: SFTBatch) -> tuple[SFTState, dict[str, Array]]:
        loss = lambda p: sft_loss(agent, p, batch, blind=blind, max_logits=max_logits)
        (value, right), grads = jax.value_and_grad(loss, has_aux=True)(state.params)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics = {"loss": value, "token_accuracy": right, "grad_norm": optax.tree.norm(grads)}
        return SFTState(params=params, opt_state=opt_state, step=state.step + 1), metrics

    return jax.jit(step, donate_argnums=0)


def sft_loss(
    agent: Agent, params: Params, batch: SFTBatch, *, blind: bool = False, max_logits: int = MAX_LOGITS
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cross-entropy of the answer's tokens, −mean log π(o_t | q, touch, o_<t), and the share predicted right."""
    features = agent.encode(params, batch.touch, blind=blind)

    def answer(features, ids, mask, streams, tokens):
        seen = dataclasses.replace(features, stream_mask=features.stream_mask & streams)
        return agent.group_states(params, seen, ids, mask, tokens[None])[0][0]

    def score(rows: Rows) -> Rows:
        logits = agent.logits(params, rows["state"])
        log_prob = token_log_probs(jax.nn.log_softmax(logits), rows["token"])
        return {"log_prob": log_prob, "right": jnp.argmax(logits, -1) == rows["token"]}

    per_question = jax.vmap(answer, in_axes=(None, 0, 0, 0, 0))
    states = jax.vmap(per_question)(features, batch.ids, batch.mask, batch.streams, batch.tokens)
    rows = {"state": states.reshape(-1, states.shape[-1]), "token": batch.tokens.ravel()}
    found = by_blocks(score, rows, width=len(agent.banned), most=max_logits)
    log_prob, right = (found[name].reshape(batch.tokens.shape) for name in ("log_prob", "right"))
    return -masked.mean(log_prob, batch.token_mask), masked.mean(right, batch.token_mask)
