"""Video prediction: x_{t+s} of a tactile stream from its frames up to t, and from the object's picture if wanted.

    L = mean |x̂_{t+s} − x_{t+s}|, pixels in [0, 1]

One network serves all skips s and sensors.  In training every stream of a batch is asked about one t, drawn at random.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.frame_decoder import FrameDecoder, FrameDecoderConfig
from touchr1_jax.models.tactile_vit import TactileViT, TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.types import Params, TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoConfig:
    """Networks, and the skips they are asked about; without `vision` the picture is not read."""

    encoder: TactileViTConfig
    decoder: FrameDecoderConfig = FrameDecoderConfig()
    vision: VisionConfig | None = None
    skips: tuple[int, ...] = (3, 5)

    def __post_init__(self) -> None:
        e = self.encoder
        if not e.causal or e.frames_per_step != 1 or e.patches_kept is not None:
            raise ValueError(
                f"encoder is causal={e.causal}, frames_per_step={e.frames_per_step}, patches_kept={e.patches_kept}: "
                "must be True, 1, None, or future frames leak in and patches have no place; change it"
            )
        if not self.skips or min(self.skips) < 1:
            raise ValueError(f"skips is {self.skips}: must hold numbers ≥ 1; correct them")


@struct.dataclass
class Asked:
    """One question per stream: the frame t that is last seen, and which of the skips is asked about."""

    last: Int[Array, "P S"]
    skip: Int[Array, "P S"]


class VideoPredictor(nn.Module):
    """Encoder, picture tower and decoder."""

    config: VideoConfig

    @nn.compact
    def __call__(self, batch: TouchBatch, asked: Asked) -> Float[Array, "P S H W 3"]:
        """Predicted frames t + s; only frames up to t reach them."""
        c = self.config
        p, s, f = batch.frame_index.shape
        sensors = jnp.broadcast_to(jnp.arange(s), (p, s))
        past = batch.frame_mask & (jnp.arange(f) <= asked.last[..., None])
        encoder = TactileViT(c.encoder, name="encoder")
        encoded = encoder.encode(batch.frames, batch.force_n, batch.frame_index, past, sensors)
        patches = jnp.take_along_axis(encoded.patches, asked.last[..., None, None, None], 2)[:, :, 0]
        pooled = jnp.take_along_axis(encoded.pooled, asked.last[..., None, None, None], 2)[:, :, 0]
        known = [pooled.reshape(p, s, -1), jax.nn.one_hot(asked.skip, len(c.skips)), jax.nn.one_hot(sensors, s)]
        if c.vision is not None:
            view = c.vision.tower(c.encoder.width)(batch.view).reshape(p, 1, -1) * batch.view_mask[:, None, None]
            known.append(jnp.broadcast_to(view, (p, s, view.shape[-1])))
        last, first = frame_at(batch, asked.last), unit_pixels(batch.frames[:, :, 0])
        flat = lambda x: x.reshape(p * s, *x.shape[2:])
        decoder = FrameDecoder(c.decoder, name="decoder")
        frames = decoder(flat(last), flat(first), flat(patches), flat(jnp.concatenate(known, -1)))
        return frames.reshape(last.shape)


def predict_frames(config: VideoConfig, params: Params, batch: TouchBatch, asked: Asked) -> Float[Array, "P S H W 3"]:
    """The network's answers, not cut to [0, 1]."""
    frames: Any = VideoPredictor(config).apply({"params": params}, batch, asked)
    return frames


def unit_pixels(frames: Array) -> Float[Array, "..."]:
    """Bytes as numbers in [0, 1]."""
    return frames.astype(jnp.float32) / 255.0


def frame_at(batch: TouchBatch, position: Int[Array, "P S"]) -> Float[Array, "P S H W 3"]:
    """One frame of each stream, pixels in [0, 1]."""
    return unit_pixels(jnp.take_along_axis(batch.frames, position[..., None, None, None, None], 2)[:, :, 0])


def draw_asked(key: Array, batch: TouchBatch, skips: tuple[int, ...]) -> Asked:
    """A random skip of each stream, and a random t with t + s among its frames.

    Raises:
      ValueError: a skip that the clips are too short for.
    """
    p, s, f = batch.frame_index.shape
    if max(skips) >= f:
        raise ValueError(f"skips is {skips}: must be < {f}, the frames of a clip; use longer clips or shorter skips")
    skip_key, last_key = jax.random.split(key)
    skip = jax.random.randint(skip_key, (p, s), 0, len(skips))
    room = f - jnp.asarray(skips)[skip]
    return Asked(last=jnp.floor(jax.random.uniform(last_key, (p, s)) * room).astype(jnp.int32), skip=skip)


def target_of(batch: TouchBatch, asked: Asked, skips: tuple[int, ...]) -> tuple[Array, Bool[Array, "P S"]]:
    """The frames that are asked about, and whether both they and the last seen ones exist."""
    later = asked.last + jnp.asarray(skips)[asked.skip]
    there = lambda t: jnp.take_along_axis(batch.frame_mask, t[..., None], 2)[..., 0]
    return frame_at(batch, later), batch.stream_mask & there(later) & there(asked.last)


def every_question(frames: int, skips: tuple[int, ...]) -> list[tuple[int, int]]:
    """All (t, number of the skip) that clips of that many frames can be asked about."""
    return [(t, k) for k, s in enumerate(skips) for t in range(frames - s)]


@struct.dataclass
class VideoState:
    """Training state."""

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]
    key: Array


VideoStep = Callable[[VideoState, TouchBatch], tuple[VideoState, dict[str, Array]]]


def start_video(
    config: VideoConfig, optimizer: optax.GradientTransformation, key: Array, batch: TouchBatch
) -> VideoState:
    """Fresh state from one key and the shapes of a batch."""
    one = jax.tree.map(lambda x: x[:1], batch)
    zero = np.zeros(batch.stream_mask[:1].shape, np.int32)
    init_key, key = jax.random.split(key)
    params = VideoPredictor(config).init(init_key, one, Asked(last=jnp.asarray(zero), skip=jnp.asarray(zero)))["params"]
    return VideoState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32), key=key)


def make_video_step(config: VideoConfig, optimizer: optax.GradientTransformation) -> VideoStep:
    """Build the jitted step, (state, batch) → (state, metrics)."""

    def step(state: VideoState, batch: TouchBatch) -> tuple[VideoState, dict[str, Array]]:
        asked = draw_asked(jax.random.fold_in(state.key, state.step), batch, config.skips)
        loss = lambda p: video_loss(config, p, batch, asked)
        (value, metrics), grads = jax.value_and_grad(loss, has_aux=True)(state.params)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        return dataclasses.replace(state, params=params, opt_state=opt_state, step=state.step + 1), {
            "l1": value,
            **metrics,
        }

    return jax.jit(step, donate_argnums=0)


def video_loss(
    config: VideoConfig, params: Params, batch: TouchBatch, asked: Asked
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Mean |x̂ − x| over the streams that exist, and the skill 1 − L1/L1 of copying the last frame."""
    predicted = predict_frames(config, params, batch, asked)
    target, exists = target_of(batch, asked, config.skips)
    error = masked.mean(jnp.abs(predicted - target), exists[..., None, None, None])
    copied = masked.mean(jnp.abs(frame_at(batch, asked.last) - target), exists[..., None, None, None])
    return error, {"skill": 1.0 - error / jnp.where(copied > 0, copied, 1.0)}
