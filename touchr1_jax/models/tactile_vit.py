"""Tactile encoder: a vision transformer over the frames of one tactile stream, pooled to a few tokens per time step.

A stream of frames becomes a few time steps.  Each step is cut into spatial patches, every patch becomes a token, and
after the transformer each step is pooled by learned queries to `tokens_per_step` tokens that carry its frame index.
"""

import dataclasses
from typing import Literal, NamedTuple, TypeAlias

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Real

from touchr1_jax.models.frame_statistics import WIDTH, scaled_statistics
from touchr1_jax.models.layers import MASKED, RMSNorm, SizeError, check_heads, check_layers, check_sizes
from touchr1_jax.models.salience import busiest_patches, patch_change, rest_mean

Frames: TypeAlias = Real[Array, "*n F H W 3"] | Float[Array, "*n F patch statistic"]
"""Pixel values 0..255, or the statistics of the patches."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TactileViTConfig:
    """Shape of the tactile encoder.

    A frame of H × W pixels is read by `stem_px` cells first, then by patches of `patch_cells` cells; `frames_per_step`
    frames make one time step.  With the defaults 4 frames at 112² give 4 steps × 16 patches = 64 tokens, pooled to 8.

    The `energy` stem sums the energy of its filters over each patch (see `patch_tokens`).  The `linear` one is a vision
    transformer's plain patch embedding, of the pixels and of their change.  The `statistics` stem is a layer of
    `stem_width` units for each patch's fixed statistics and those of its frame, and an embedding of these.

    A `causal` encoder lets a step see itself and earlier ones alone, as the prediction of the next step needs.  With
    `patches_kept` the transformer gets only the patches of a stream that change most, the same ones in every step; the
    `rest` is dropped before its pixels are read, or kept as one mean token of each step.

    Raises:
      SizeError: a size below 1, or heads that do not share the width.
    """

    sensors: int
    width: int = 96
    num_layers: int = 2
    num_heads: int = 3
    mlp_ratio: int = 2
    stem: Literal["energy", "linear", "statistics"] = "energy"
    stem_px: int = 4
    stem_width: int = 16
    patch_cells: int = 7
    frames_per_step: int = 1
    tokens_per_step: int = 2
    use_force: bool = True
    causal: bool = False
    patches_kept: int | None = None
    rest: Literal["drop", "merge"] = "drop"

    @property
    def patch_px(self) -> int:
        """Side of a patch."""
        return self.stem_px * self.patch_cells

    def tower(self) -> nn.Module:
        """The encoder that a policy builds; another one overrides this and has the arguments of `TactileViT`."""
        return TactileViT(self)

    def __post_init__(self) -> None:
        check_sizes(self, "width", "num_heads", "mlp_ratio", "stem_px", "stem_width", "patch_cells")
        check_sizes(self, "frames_per_step", "tokens_per_step")
        check_layers(self, least=0)
        check_heads(self.width, self.num_heads)
        if self.stem == "statistics" and self.patches_kept is not None:
            raise SizeError(
                f"patches_kept is {self.patches_kept}: must be None for the statistics stem, which reads whole frames; "
                "leave it out or choose another stem"
            )


class Encoded(NamedTuple):
    """Encoding of a stream: the tokens of all its patches, and the few that they are pooled to."""

    patches: Float[Array, "*n step patch D"]
    pooled: Float[Array, "*n step token D"]


class TactileViT(nn.Module):
    """f(frames, force) → tokens, for any leading batch shape."""

    config: TactileViTConfig

    def __call__(
        self,
        frames: Frames,
        force_n: Float[Array, "*n F 3"],
        frame_index: Int[Array, "*n F"],
        frame_mask: Bool[Array, "*n F"],
        sensor: Int[Array, "*n"],
    ) -> Float[Array, "*n step token D"]:
        """`tokens_per_step` tokens of each time step; arguments as in `encode`."""
        return self.encode(frames, force_n, frame_index, frame_mask, sensor).pooled

    @nn.compact
    def encode(
        self,
        frames: Frames,
        force_n: Float[Array, "*n F 3"],
        frame_index: Int[Array, "*n F"],
        frame_mask: Bool[Array, "*n F"],
        sensor: Int[Array, "*n"],
    ) -> Encoded:
        """Encode streams.

        Args:
          frames: pixel values 0..255; for the statistics stem they may be the statistics of its patches instead, which
            have no parameters and need be computed only once (`statistics_of`).
          force_n: measured force of each frame, newton; a zero vector where it is unknown.
          frame_index: position of each frame in its recording.
          frame_mask: which frames exist.
          sensor: index of the sensor that saw them.
        """
        c = self.config
        frames = statistics_of(frames, frame_mask, c) if c.stem == "statistics" else of_frames(frame_mask, frames)
        force_n = jnp.where(frame_mask[..., None], force_n, 0.0)
        kept = None if c.patches_kept is None else kept_patches(frames, frame_mask, c, c.patches_kept)
        x = self._placed_patches(frames, kept)  # *n step patch D
        steps = x.shape[-3]
        step_mask = _group(frame_mask, c.frames_per_step).any(-1)
        time = step_time(of_frames(frame_mask, frame_index), frame_mask, c.frames_per_step)
        x = x + nn.Embed(c.sensors, c.width, name="sensor")(sensor)[..., None, None, :]
        x = x + nn.Dense(c.width, name="time")(sinusoid(time, 32))[..., None, :]
        if c.use_force:
            force = _group(force_features(force_n), c.frames_per_step)
            force = nn.Dense(c.width, name="force_in")(force.reshape(*force.shape[:-2], -1))
            x = x + nn.Dense(c.width, name="force_out")(nn.gelu(force))[..., None, :]
        seen = jnp.repeat(step_mask, x.shape[-2], -1)
        order = earlier_steps(steps, x.shape[-2]) if c.causal else None
        x = x.reshape(*x.shape[:-3], -1, c.width)
        for i in range(c.num_layers):
            x = EncoderLayer(c.width, c.num_heads, c.mlp_ratio, name=f"layer_{i}")(x, seen, order)
        x = RMSNorm(name="norm")(x).reshape(*x.shape[:-2], steps, -1, c.width)
        return Encoded(patches=x, pooled=QueryPool(c.tokens_per_step, name="pool")(x))

    def _placed_patches(self, frames: Frames, kept: Int[Array, "*n k"] | None) -> Float[Array, "*n step patch D"]:
        """Embedded patches with their positions: all, the kept ones, or the kept ones and the mean of the others."""
        c = self.config
        merge = kept is not None and c.rest == "merge"
        x = patch_tokens(frames, c, None if merge else kept)
        grid = x.shape[-2] if kept is None else frames.shape[-3] // c.patch_px * (frames.shape[-2] // c.patch_px)
        place = self.param("patch_position", nn.initializers.normal(0.02), (grid, c.width))
        if kept is None:
            return x + place
        if merge:
            return rest_mean(x + place, kept[..., None, :])
        return x + place[kept][..., None, :, :]


def step_time(
    frame_index: Int[Array, "*n F"], frame_mask: Bool[Array, "*n F"], frames_per_step: int
) -> Int[Array, "*n step"]:
    """Index of the first frame of each time step that exists; that of its first one where none does."""
    index, exists = _group(frame_index, frames_per_step), _group(frame_mask, frames_per_step)
    return jnp.take_along_axis(index, jnp.argmax(exists, -1, keepdims=True), -1)[..., 0]


def kept_patches(
    frames: Real[Array, "*n F H W 3"], frame_mask: Bool[Array, "*n F"], c: TactileViTConfig, number: int
) -> Int[Array, "*n k"]:
    """The patches of each stream that are read, in their order.

    Raises:
      ValueError: more patches to keep than there are.
    """
    grid = frames.shape[-3] // c.patch_px * (frames.shape[-2] // c.patch_px)
    if not 1 <= number <= grid:
        raise ValueError(f"patches_kept is {number}: must lie in 1..{grid}, the patches of a frame; change it")
    return busiest_patches(patch_change(frames, c.patch_px), frame_mask, number)


def earlier_steps(steps: int, tokens: int) -> Bool[np.ndarray, "N N"]:
    """Which token may look at which, [query, key]: those of its own time step and of earlier ones."""
    step = np.repeat(np.arange(steps), tokens)
    return step[:, None] >= step


def cut_patches(
    frames: Real[Array, "*n F H W 3"], c: TactileViTConfig, kept: Int[Array, "*n k"] | None = None
) -> Real[Array, "*n F patch cell pixel"]:
    """The pixels of every stem cell of every patch, or of the kept patches alone.

    Raises:
      ValueError: when the frames do not divide into the configured patches or steps.
    """
    *lead, f, h, w, _ = frames.shape
    cell = c.patch_px
    if h % cell or w % cell or f % c.frames_per_step:
        raise ValueError(
            f"frames of {h}×{w} px and {f} per stream must divide into {cell} px patches and steps of "
            f"{c.frames_per_step}; resize them or change the tactile_vit config"
        )
    rows, columns = h // cell, w // cell
    # cut while the pixels are bytes: (row, cell row, pixel row, column, cell column, pixel column) → patch, cell, pixel
    x = frames.reshape(*lead, f, rows, c.patch_cells, c.stem_px, columns, c.patch_cells, c.stem_px, 3)
    n = len(lead)
    x = x.transpose(*range(n), *(n + i for i in (0, 1, 4, 2, 5, 3, 6, 7)))
    x = x.reshape(*lead, f, rows * columns, c.patch_cells**2, -1)
    return x if kept is None else jnp.take_along_axis(x, kept[..., None, :, None, None], -3)


def patch_tokens(
    frames: Frames, c: TactileViTConfig, kept: Int[Array, "*n k"] | None = None
) -> Float[Array, "*n step patch D"]:
    """Cut frames and their change since the first frame into tubelets and embed them (called inside a compact module).

    The energy stem's nonlinearity lets a patch sum texture energy, which a single linear patch embedding averages away.

    Args:
      frames: pixel values 0..255, or the statistics of patches for their stem.
      c: shape of the encoder.
      kept: the only patches to read; all by default.

    Raises:
      ValueError: when the frames do not divide into the configured patches or steps.
    """
    embed = lambda y, name: nn.Dense(c.width, name=name)(_steps(y, c.frames_per_step))
    if c.stem == "statistics":
        return embed(nn.gelu(nn.Dense(c.stem_width, name="stem")(frames)), "patch")
    x = cut_patches(frames, c, kept)
    *lead, f, patches, _, _ = x.shape
    if c.stem == "linear":
        x = x.reshape(*lead, f, patches, -1).astype(jnp.float32) / 127.5 - 1.0
        return embed(jnp.concatenate([x, x - x[..., :1, :, :]], -1), "patch")
    # one long matrix: XLA's CPU gradient of a dense layer over many leading axes is seven times slower
    x = x.reshape(-1, 3 * c.stem_px**2).astype(jnp.float32) / 127.5 - 1.0
    x = nn.Dense(2 * c.stem_width, name="stem")(x)
    level, change = jnp.split(x.reshape(*lead, f, patches, c.patch_cells**2, -1), 2, -1)
    change = change - change[..., :1, :, :, :]
    texture = log_energy(level - level.mean(-2, keepdims=True))
    moved = log_energy(change)
    energy = jnp.concatenate([texture, texture - texture[..., :1, :, :], moved, change.mean(-2)], -1)
    x = nn.relu(level + 4.0 * change).reshape(*lead, f, patches, -1)
    return embed(x, "patch") + embed(energy, "energy")


def statistics_of(
    frames: Frames,
    frame_mask: Bool[Array, "*n F"],
    c: TactileViTConfig,
) -> Float[Array, "*n F patch statistic"]:
    """Input of the statistics stem: `scaled_statistics` of its patches unless they are given, and 0 in padding."""
    if frames.shape[-1] != WIDTH:
        frames = scaled_statistics(of_frames(frame_mask, frames), c.patch_px)
    return of_frames(frame_mask, frames)


def of_frames(frame_mask: Bool[Array, "*n F"], x: Real[Array, "*m"]) -> Real[Array, "*m"]:
    """Numbers [*n, F, …] of the frames that exist, and 0 for padding, which must hold nothing."""
    return jnp.where(frame_mask.reshape(*frame_mask.shape, *(1,) * (x.ndim - frame_mask.ndim)), x, 0)


def log_energy(x: Float[Array, "*n cell channel"]) -> Float[Array, "*n channel"]:
    """Mean size of a filter's response over a patch, on a scale of about unit spread, (log(mean |x| + 1e-3) + 3)/1.5.

    Texture and pressure act by orders of magnitude: their logarithm is what a linear layer can use.
    """
    return (jnp.log(jnp.abs(x).mean(-2) + 1e-3) + 3.0) / 1.5


def _steps(x: Float[Array, "*n F patch C"], frames_per_step: int) -> Float[Array, "*n step patch wide"]:
    """Join the frames of each time step along the channels."""
    *lead, f, patches, _ = x.shape
    x = x.reshape(*lead, f // frames_per_step, frames_per_step, patches, -1).swapaxes(-3, -2)
    return x.reshape(*x.shape[:-2], -1)


class EncoderLayer(nn.Module):
    """Pre-norm transformer layer with attention over the tokens that exist, and that `order` allows [query, key]."""

    width: int
    num_heads: int
    mlp_ratio: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "*n N D"], mask: Bool[Array, "*n N"], order: Bool[np.ndarray, "N N"] | None = None
    ) -> Float[Array, "*n N D"]:
        head = self.width // self.num_heads
        qkv = nn.Dense(3 * self.width, name="qkv")(RMSNorm(name="norm_attention")(x))
        q, k, v = jnp.split(qkv.reshape(*qkv.shape[:-1], 3 * self.num_heads, head), 3, -2)
        scores = jnp.einsum("...qhd,...khd->...hqk", q, k) * head**-0.5
        seen = mask[..., None, None, :] if order is None else mask[..., None, None, :] & order
        weights = nn.softmax(jnp.where(seen, scores, MASKED), -1)
        mixed = jnp.einsum("...hqk,...khd->...qhd", weights, v)
        x = x + nn.Dense(self.width, name="out")(mixed.reshape(x.shape))
        y = nn.gelu(nn.Dense(self.mlp_ratio * self.width, name="up")(RMSNorm(name="norm_mlp")(x)))
        return x + nn.Dense(self.width, name="down")(y)


class QueryPool(nn.Module):
    """Attention pooling of the patches of one time step by learned queries, softmax(Q kᵀ/√d) v."""

    queries: int

    @nn.compact
    def __call__(self, x: Float[Array, "*n patch D"]) -> Float[Array, "*n query D"]:
        width = x.shape[-1]
        query = self.param("query", nn.initializers.normal(0.5), (self.queries, width))
        k, v = jnp.split(nn.Dense(2 * width, name="kv")(x), 2, -1)
        weights = nn.softmax(jnp.einsum("qd,...pd->...qp", query, k) * width**-0.5, -1)
        return jnp.einsum("...qp,...pd->...qd", weights, v)


def force_features(force_n: Float[Array, "*n 3"]) -> Float[Array, "*n 5"]:
    """Force at the scale of a 20 N press: (f/10 N, log(1 + |f_z|/0.1 N) − 2, 1 where a force is known)."""
    size = jnp.abs(force_n[..., 2:])
    known = jnp.any(force_n != 0, -1, keepdims=True).astype(force_n.dtype)
    return jnp.concatenate([force_n / 10.0, (jnp.log1p(size / 0.1) - 2.0) * known, known], -1)


def sinusoid(index: Int[Array, "*n"], width: int) -> Float[Array, "*n width"]:
    """Sine and cosine of an integer at geometric frequencies 1 … 1/1000 (Vaswani et al. 2017)."""
    frequency = 1000.0 ** (-jnp.arange(width // 2) / (width // 2 - 1))
    angle = index[..., None] * frequency
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)


def _group(x: Array, size: int) -> Array:
    """Split the frame axis into (step, frame of the step): axis 1 from the end for masks, 2 for vectors."""
    axis = x.ndim - 1 if x.dtype == bool or jnp.issubdtype(x.dtype, jnp.integer) else x.ndim - 2
    return x.reshape(*x.shape[:axis], x.shape[axis] // size, size, *x.shape[axis + 1 :])
