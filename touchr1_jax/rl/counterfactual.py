"""Counterfactual touch: perturbations for the grounding term and for the controls of R_tu.

Every perturbation maps the encoded features of P prompts to changed ones, inside the compiled step.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.policy import Features


class Perturbed(NamedTuple):
    """Changed features, and the prompts in which anything could be changed."""

    features: Features
    applies: Bool[Array, "P"]


def drop_touch(features: Features) -> Perturbed:
    """Remove every stream, its tokens and its name."""
    touched = jnp.any(features.stream_mask, -1)
    return Perturbed(dataclasses.replace(features, stream_mask=jnp.zeros_like(features.stream_mask)), touched)


def noise_touch(features: Features, noise: Float[Array, "K S N D"], key: Array) -> Perturbed:
    """Replace every present stream by an encoded noise draw of its sensor; streams draw independently.

    Args:
      noise: encoded draws of N(μ, σ²) at each sensor's statistics, a bank of K for each sensor.
    """
    p, s = features.stream_mask.shape
    draw = jax.random.randint(key, (p, s), 0, noise.shape[0])
    changed = dataclasses.replace(features, touch=noise[draw, jnp.arange(s)])
    return Perturbed(changed, jnp.any(features.stream_mask, -1))


def shuffle_touch(features: Features, key: Array) -> Perturbed:
    """Permute the time steps of every stream, never by the identity; the time ids stay.

    A step is a run of tokens with one frame index.  A stream with fewer than two steps cannot be shuffled, and the
    control does not apply to a prompt that has only such streams.  Departure from R_tu's definition, which permutes
    frames: here encoded steps are permuted, because the encoder is frozen in GRPO and contacts are encoded once.  Both
    are equal for an encoder that reads each step alone.  If steps attend to each other, they contain traces of the
    original order, and this control is weaker.
    """
    keys = jax.random.split(key, features.stream_mask.shape)
    source, moved = jax.vmap(jax.vmap(_shuffled_tokens))(features.touch_time, keys)
    touch = jnp.take_along_axis(features.touch, source[..., None], -2)
    return Perturbed(dataclasses.replace(features, touch=touch), jnp.any(moved & features.stream_mask, -1))


def swap_touch(features: Features, key: Array) -> Perturbed:
    """Replace touch by that of another prompt of the batch, at a random distance 1 … P − 1; never its own.

    Swapped touch has all statistics of touch, so a policy that only detects noise does not pass this control.  Only
    streams that both prompts have are exchanged.  The control does not apply where the other prompt is about the same
    contact, whose touch is no other.
    """
    p = features.stream_mask.shape[0]
    other = (jnp.arange(p) + jax.random.randint(key, (), 1, max(p, 2))) % p
    both = features.stream_mask & features.stream_mask[other]
    take = lambda x: jnp.where(both.reshape(*both.shape, *(1,) * (x.ndim - 2)), x[other], x)
    changed = dataclasses.replace(features, touch=take(features.touch), touch_time=take(features.touch_time))
    return Perturbed(changed, jnp.any(changed.touch != features.touch, (1, 2, 3)))


def mask_one_stream(
    features: Features, noise: Float[Array, "K S N D"], key: Array
) -> tuple[Float[Array, "P S N D"], Int[Array, "P"]]:
    """T_mask: replace one present stream of each prompt, uniformly chosen, by an encoded noise draw of its sensor.

    Returns:
      The touch and the index of the replaced stream; a prompt without streams does not change.
    """
    p = features.stream_mask.shape[0]
    stream_key, draw_key = jax.random.split(key)
    stream = jax.random.categorical(stream_key, jnp.where(features.stream_mask, 0.0, -jnp.inf))
    draw = jax.random.randint(draw_key, (p,), 0, noise.shape[0])
    replaced = features.touch.at[jnp.arange(p), stream].set(noise[draw, stream])
    any_stream = jnp.any(features.stream_mask, -1)[:, None, None, None]
    return jnp.where(any_stream, replaced, features.touch), stream


def _shuffled_tokens(time: Int[Array, "N"], key: Array) -> tuple[Int[Array, "N"], Bool[Array, ""]]:
    """Source of each token when the steps of one stream are shuffled, and true if any moves.

    Steps must be of one length; a stream whose steps differ in length keeps its order.
    """
    n = time.shape[0]
    first = jnp.concatenate([jnp.ones(1, bool), time[1:] != time[:-1]]) & (time >= 0)
    step, exists = jnp.cumsum(first) - 1, time >= 0
    begin = jnp.sort(jnp.where(first, jnp.arange(n), n))  # of step k, n past the last one
    count = jnp.sum(first)
    size = jnp.bincount(jnp.where(exists, step, n), length=n + 1)[:n]
    even = jnp.all((size == size[0]) | (jnp.arange(n) >= count))
    order, moved = _another_order((jnp.arange(n) < count) & even, key)
    here = jnp.maximum(step, 0)
    source = begin[order[here]] + jnp.arange(n) - begin[here]
    return jnp.where(exists & moved, source, jnp.arange(n)), moved


def _another_order(member: Bool[Array, "n"], key: Array) -> tuple[Int[Array, "n"], Bool[Array, ""]]:
    """A random permutation of the members that is not the identity; false where there are fewer than two.

    A drawn identity becomes a rotation by one, so that all other orders are equally likely.
    """
    n = member.shape[0]
    place, last = jnp.arange(n), jnp.sum(member) - 1
    rank = jnp.maximum(jnp.cumsum(member) - 1, 0)
    members = jnp.argsort(jnp.where(member, place, n))  # places of the members, in order
    drawn = jnp.argsort(jnp.where(member, jax.random.uniform(key, (n,)), jnp.inf))
    order = jnp.where(member, drawn[rank], place)
    rotated = jnp.where(member, members[jnp.where(rank == last, 0, rank + 1)], place)
    return jnp.where(jnp.all(order == place), rotated, order), last >= 1
