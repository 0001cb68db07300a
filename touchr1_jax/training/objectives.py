"""Objectives of stage 1 on arrays, which train an encoder on touch without labels.

`dynamics` computes their arguments with networks and contains its own objective, prediction of the next latent.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Real

from touchr1_jax import masked
from touchr1_jax.models.tactile_vit import force_features

Objective = Literal["dynamics", "contrast", "masked", "physics"]
"""Predict the next latent; find the contact that another sensor shares among others; predict the latents of hidden
patches; estimate force and depth."""

TEMPERATURE = 0.1
"""Cosines of embeddings are divided by it."""

DEPTH_MM = 0.01
"""Depth below which its logarithmic scale is about linear: relief of a few micrometres still counts."""

GREY = 128
"""Value of hidden pixels, the middle of their range."""


def contrast_loss(
    embedding: Float[Array, "P S W"], exists: Bool[Array, "P S"], temperature: float = TEMPERATURE
) -> Float[Array, ""]:
    """Cross-entropy of finding the same contact among those of a batch by another sensor (InfoNCE, arXiv 1807.03748).

        L = −mean_{p, s≠t} log [ exp(z_ps · z_pt / τ) / Σ_q exp(z_ps · z_qt / τ) ]

    over contacts p that both sensors recorded and contacts q that sensor t recorded; 0 where no contact is shared.

    Args:
      embedding: z, of any length; it is normalised here.
      exists: which sensors recorded a contact.
      temperature: τ.
    """
    size = jnp.sqrt(jnp.sum(embedding**2, -1, keepdims=True) + 1e-12)
    z = embedding / size
    logits = jnp.einsum("psw,qtw->stpq", z, z) / temperature
    logits = jnp.where(exists.T[None, :, None, :], logits, -1e9)
    own = jnp.diagonal(jax.nn.log_softmax(logits), axis1=-2, axis2=-1)  # s t p
    shared = exists.T[:, None] & exists.T[None] & ~jnp.eye(exists.shape[1], dtype=bool)[..., None]
    return -masked.mean(own, shared)


def hidden_loss(
    predicted: Float[Array, "*n D"], goal: Float[Array, "*n D"], hidden: Bool[Array, "*n"]
) -> Float[Array, ""]:
    """Mean |ẑ − z| over the hidden places, without gradient to z (data2vec, arXiv 2202.03555; I-JEPA, 2301.08243)."""
    return masked.mean(jnp.abs(predicted - jax.lax.stop_gradient(goal)), hidden[..., None])


def measured_loss(
    predicted: Float[Array, "*n k"], measured: Float[Array, "*n k"], known: Bool[Array, "*n k"]
) -> Float[Array, ""]:
    """Mean squared error over the known quantities."""
    return masked.mean((predicted - jnp.where(known, measured, 0.0)) ** 2, known)


def measured_targets(
    force_n: Float[Array, "*n 3"], depth_mm: Float[Array, "*n q"]
) -> tuple[Float[Array, "*n k"], Bool[Array, "*n k"]]:
    """Force and depth on scales of about unit spread, and a mask of the known ones.

    (f / 10 N, log(1 + |f_z| / .1 N) − 2, log(1 + d / .01 mm) for each measure d of depth); k = 4 + q.

    Args:
      force_n: a zero vector where it was not measured.
      depth_mm: NaN where it was not measured.
    """
    force = force_features(force_n)
    known = jnp.broadcast_to(force[..., 4:] > 0, (*force.shape[:-1], 4))
    depth = jnp.log1p(jnp.maximum(jnp.nan_to_num(depth_mm), 0.0) / DEPTH_MM)
    return jnp.concatenate([force[..., :4], depth], -1), jnp.concatenate([known, jnp.isfinite(depth_mm)], -1)


def random_patches(key: Array, shape: tuple[int, ...], share: float) -> Bool[Array, "*n patch"]:
    """True at round(share · patch) patches of every row, at least one, chosen at random."""
    rank = jnp.argsort(jnp.argsort(jax.random.uniform(key, shape), -1), -1)
    return rank < max(1, round(share * shape[-1]))


def hide_patches(frames: Real[Array, "*n F H W 3"], hidden: Bool[Array, "*n patch"]) -> Real[Array, "*n F H W 3"]:
    """Frames with the pixels of some patches grey in all frames, rows of patches first.

    Raises:
      ValueError: a number of patches that is no square, or that does not divide the frames.
    """
    height, width, side = frames.shape[-3], frames.shape[-2], round(hidden.shape[-1] ** 0.5)
    if side**2 != hidden.shape[-1] or height % side or width % side:
        raise ValueError(
            f"{hidden.shape[-1]} patches cannot be hidden in frames of {height}×{width} px: must be a square number "
            "whose root divides both; use square frames"
        )
    grid = hidden.reshape(*hidden.shape[:-1], side, side)
    pixels = jnp.repeat(jnp.repeat(grid, height // side, -2), width // side, -1)
    return jnp.where(pixels[..., None, :, :, None], jnp.asarray(GREY, frames.dtype), frames)
