"""Contacts encoded once by a frozen encoder: the input of GRPO and of evaluation."""

import dataclasses
import functools
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from touchr1_jax.models.load import WeightsError
from touchr1_jax.models.policy import Features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.stacked import layer_by_layer
from touchr1_jax.models.tactile_vit import TactileViTConfig, statistics_of
from touchr1_jax.training.compilation import committed
from touchr1_jax.types import Params, TouchBatch

BATCH = 8
"""Contacts that are encoded at once: eight stay in cache, sixteen take twice the time each."""


def encode_contacts(fns: PolicyFns, params: Params, batches: Iterable[TouchBatch], *, blind: bool = False) -> Features:
    """Features of all contacts of some batches, in their order, on the host; a blind policy has no streams.

    Raises:
      WeightsError: features that are not finite, from which a policy would give the same answer to every question.
    """
    encode, params = encode_program(fns, blind), committed(params)
    found, done = list[Features](), 0
    for batch in batches:
        found.append(jax.device_get(encode(params, batch)))
        _require_finite(found[-1], done)
        done += len(found[-1].stream_mask)
    return jax.tree.map(lambda *x: np.concatenate(x), *found)


def _require_finite(features: Features, before: int) -> None:
    for name in ("touch", "view"):
        finite = np.isfinite(getattr(features, name).astype(np.float32)).reshape(len(features.stream_mask), -1).all(-1)
        if not finite.all():
            raise WeightsError(
                f"{name} of contact {before + np.argmin(finite)} among those to encode has numbers that are not finite:"
                " must be finite; correct its frames and force, or train the encoder again"
            )


def touch_statistics(config: TactileViTConfig, batches: Iterable[TouchBatch]) -> TouchBatch:
    """All contacts of some batches on the host, with the statistics of the stem instead of frames."""
    compute = jax.jit(functools.partial(statistics_of, c=config))
    changed = lambda batch: dataclasses.replace(batch, frames=compute(batch.frames, batch.frame_mask))
    found = [jax.device_get(changed(batch)) for batch in batches]
    return jax.tree.map(lambda *x: np.concatenate(x), *found)


def parts(touch: TouchBatch, rows: np.ndarray) -> Iterator[TouchBatch]:
    """Some contacts of a batch on the host, `BATCH` at a time."""
    for start in range(0, len(rows), BATCH):
        part = rows[start : start + BATCH]
        yield jax.tree.map(lambda x, part=part: x[part], touch)


@functools.cache
def encode_program(fns: PolicyFns, blind: bool) -> Any:
    """Compiled encoder, made once."""
    options = layer_by_layer(fns.cache_dtype)
    return jax.jit(lambda params, batch: fns.encode(params, batch, blind=blind), compiler_options=options)


def noise_bank(
    fns: PolicyFns, params: Params, batch: TouchBatch, *, seed: int, draws: int = 64
) -> Float[Array, "K S N D"]:
    """Encoded noise streams: pixels and forces drawn from N(μ, σ²) at each sensor's statistics, per channel.

    The statistics are those of the batch's recorded frames, and frame times are those of the sensor's recorded
    contacts, so that only the touch itself is unusual.

    Args:
      fns, params: of the encoder.
      batch: contacts, arrays on the host.
      seed: of the draws.
      draws: K.
    """
    recorded = np.where(batch.frame_mask, 1.0, np.nan).astype(np.float32)
    frames, force_n = np.asarray(batch.frames), np.asarray(batch.force_n)
    pixel = _statistics(frames.astype(np.float32) * recorded[..., None, None, None], (0, 2, 3, 4))
    force = _statistics(force_n * recorded[..., None], (0, 2))
    there = np.any(batch.frame_mask, -1).T
    rows = np.stack([np.resize(np.flatnonzero(x) if x.any() else np.arange(len(x)), draws) for x in there], 1)
    keys = jax.random.split(jax.random.key(seed), draws)
    times = (jnp.asarray(np.take_along_axis(x, rows[..., None], 0)) for x in (batch.frame_index, batch.frame_mask))
    return noise_program(fns, frames.shape[3:5])(params, pixel, force, (keys, *times))


@functools.cache
def noise_program(fns: PolicyFns, size: tuple[int, int]) -> Any:
    """Compiled encoder of noise, (params, pixel statistics, force statistics, (key, index, mask)) → features."""

    def draw(params: Params, pixel: Any, force: Any, x: tuple[Array, Array, Array]) -> Float[Array, "S N D"]:
        key, index, mask = x
        pixel_key, force_key = jax.random.split(key)
        (pixel_mean, pixel_std), (force_mean, force_std), shape = pixel, force, index.shape
        noise = jax.random.normal(pixel_key, (*shape, *size, 3)) * pixel_std[:, None, None, None]
        frames = jnp.clip(noise + pixel_mean[:, None, None, None], 0, 255)
        push = jax.random.normal(force_key, (*shape, 3)) * force_std[:, None] + force_mean[:, None]
        return fns.encode_streams(params, frames, push, index, mask, jnp.arange(shape[0]))

    return jax.jit(lambda params, pixel, force, x: jax.lax.map(functools.partial(draw, params, pixel, force), x))


def _statistics(x: np.ndarray, axes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the numbers that are not NaN; 0 where there is none."""
    known = ~np.isnan(x)
    n = np.maximum(known.sum(axes), 1)
    mean = np.where(known, x, 0.0).sum(axes) / n
    shape = [1 if i in axes else size for i, size in enumerate(x.shape)]
    square = np.where(known, (x - mean.reshape(shape)) ** 2, 0.0).sum(axes)
    return mean.astype(np.float32), np.sqrt(square / n).astype(np.float32)
