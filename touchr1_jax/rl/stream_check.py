"""A check before training that every tactile stream influences the policy's answers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from touchr1_jax import masked
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.losses import exact_kl
from touchr1_jax.rl.rollout import GRPOBatch, SampleConfig, sample_group
from touchr1_jax.types import Params

ROUNDING_NAT = 1e-7
"""Influence at which a stream counts as ignored: without attention it is 0 up to the rounding of float32."""


class StreamError(ValueError):
    """A policy that would be rewarded for touch which does not reach it; the message names the stream and the fix."""


def stream_influence(
    fns: PolicyFns, params: Params, batch: GRPOBatch, noise: Float[Array, "K S N D"], key: Array, length: int
) -> tuple[Float[Array, "S"], Bool[Array, "S"]]:
    """Change of sampled answers by noise in each single stream, and the streams that any prompt has.

    KL(π(· | touch) ‖ π(· | stream s made noise)), mean over the tokens of one answer a prompt and over the prompts that
    have the stream, nat.

    Args:
      fns: policy, prompts, vocabulary.
      params: the policy's.
      batch: P prompts.
      noise: encoded noise as in `grpo.FrozenInputs`.
      key: randomness of the answers and of the noise.
      length: most tokens of an answer.
    """
    sample_key, noise_key = jax.random.split(key)
    draw = SampleConfig(group=1, length=length, end_ids=fns.end_ids, pad_id=fns.pad_id)
    rollout = sample_group(fns, params, batch, sample_key, draw)
    p, s = batch.features.stream_mask.shape
    drawn = noise[jax.random.randint(noise_key, (p, s), 0, noise.shape[0]), jnp.arange(s)]

    def log_p(touch: Float[Array, "P S N D"]) -> Float[Array, "P G T V"]:
        changed = dataclasses.replace(batch.features, touch=touch)
        each = jax.vmap(fns.group_logits, in_axes=(None, 0, 0, 0, 0))
        return jax.nn.log_softmax(each(params, changed, batch.ids, batch.mask, rollout.tokens))

    own = log_p(batch.features.touch)

    def influence(stream: Array) -> Array:
        one = jnp.where((jnp.arange(s) == stream)[:, None, None], drawn, batch.features.touch)
        per_prompt = jnp.mean(masked.mean(exact_kl(own, log_p(one)), rollout.mask, axis=-1), -1)
        return masked.mean(per_prompt, batch.features.stream_mask[:, stream])

    return jax.lax.map(influence, jnp.arange(s)), jnp.any(batch.features.stream_mask, 0)


def check_streams(influence: Float[np.ndarray, "S"], present: Bool[np.ndarray, "S"]) -> None:
    """Check that every present stream has an influence, and that there is any.

    Raises:
      StreamError: no prompt has touch; noise in a stream changes the answers by no more than the rounding of float32.
    """
    if not np.any(present):
        raise StreamError(
            "stream_mask is false for every prompt and stream: no prompt of the first batch has touch, so that rewards "
            "for touch and G_tg mean nothing; look at the masks of the records and of the encoder"
        )
    for s, (size, there) in enumerate(zip(influence, present, strict=True)):
        if there and not size > ROUNDING_NAT:
            raise StreamError(
                f"stream {s}: noise in it moves the answers by {size:.3g} nat a token, must exceed {ROUNDING_NAT:g}; "
                f"either the recordings of sensor {s} (from 0) never change: leave it out; or its touch does not reach "
                "the policy: look at its encoder, its slots in the prompt and its mask"
            )
