"""The policy: touch and vision encoders in front of the decoder, and the prompt that joins them.

    features = encode(frames, force, view)            once per contact
    logits, prefix = prefill(features, prompt ids)    once per prompt
    states = completion_states(tokens, prefix)        per rollout, the learner; `logits` scores them
    logits, cache = decode(token, t, prefix, cache)   per rollout and token, the sampler

Every function works on a single prompt or rollout and is batched by `vmap`, but for `encode`, which takes a batch, and
`completion_states`, which also takes a group of rollouts.
"""

import dataclasses
from typing import NamedTuple, Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.blocked_attention import Segments
from touchr1_jax.models.deepstack import Levels, placed, split_levels
from touchr1_jax.models.layers import RMSNorm
from touchr1_jax.models.lm import Decoder, DecoderConfig, PrefixCache
from touchr1_jax.models.tactile_vit import TactileViTConfig, step_time
from touchr1_jax.models.token_cache import CompletionCaches
from touchr1_jax.types import Params, TouchBatch


@struct.dataclass
class Features:
    """Decoder input of one contact: tactile tokens with their frame indices, and view tokens, with their levels if the
    vision tower has any (`models.deepstack`).

    `touch_time` is the integer frame index of each tactile token, never seconds: a cast of seconds per step to integers
    would zero it and make a temporal control vacuous.  It is −1 where a time step has no frame: no such token exists.
    """

    touch: Float[Array, "*n S N D"]
    touch_time: Int[Array, "*n S N"]
    stream_mask: Bool[Array, "*n S"]
    view: Float[Array, "*n Nv E"]
    view_mask: Bool[Array, "*n"]


class Slots(NamedTuple):
    """Where a prompt keeps its embedded tokens: positions on the L axis, as static NumPy integers.

    With `step_text` words say the time of each time step, and its tokens have no time of their own.
    """

    touch: np.ndarray  # [S, N]
    view: np.ndarray  # [Nv]
    stream_text: np.ndarray  # [L]: stream whose text a token is, S for the view's marks, −1 for other tokens
    step_text: np.ndarray | None = None  # [L]: a tactile token of the step whose text a token is, −1 for other tokens


class Row(NamedTuple):
    """Examples, prompts with their completions, one after the other in W tokens.

    `feature` is the row of an array of features [n, D] that is a token's embedding, −1 for a word; at `places` the
    hidden states are wanted.
    """

    ids: Int[Array, "W"]
    feature: Int[Array, "W"]
    positions: Int[Array, "3 W"]
    segments: Segments
    places: Int[Array, "K"]


class ViewConfig(Protocol):
    """Interface of a vision tower: number of tokens, and how it is built."""

    @property
    def grid(self) -> int: ...
    def tower(self, out_width: int) -> nn.Module: ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """The three towers; `tactile.sensors` is the number S of streams."""

    tactile: TactileViTConfig
    vision: ViewConfig
    decoder: DecoderConfig
    in_order: bool = False
    """Number a prompt's tokens one by one, as a server does that is sent their embeddings alone."""

    @property
    def grid(self) -> int | None:
        """Tokens in a row of the view, where rows and columns count as positions."""
        return None if self.in_order else self.vision.grid


class Policy(nn.Module):
    """Parameters and forward passes of the policy; see the module docstring for the order of the calls."""

    config: PolicyConfig
    remat: bool = False  # of the decoder's layers

    def setup(self) -> None:
        c = self.config
        self.tactile = c.tactile.tower()
        self.tactile_norm = RMSNorm()
        self.tactile_in = nn.Dense(2 * c.decoder.hidden_size)
        self.tactile_out = nn.Dense(c.decoder.hidden_size)
        self.vision = c.vision.tower(c.decoder.hidden_size)
        self.decoder = Decoder(c.decoder, self.remat)

    def encode_streams(self, frames, force_n, frame_index, frame_mask, sensor) -> Float[Array, "*n N D"]:
        """Tactile tokens of any batch of streams, at the decoder's width; arguments as in `TactileViT`."""
        x = self.tactile(frames, force_n, frame_index, frame_mask, sensor)
        return self.project(x.reshape(*x.shape[:-3], -1, x.shape[-1]))

    def project(self, x: Float[Array, "*n W"]) -> Float[Array, "*n D"]:
        """Tokens of the tactile encoder, or of another one, at the decoder's width."""
        return self.tactile_out(nn.gelu(self.tactile_in(self.tactile_norm(x))))

    def encode(self, batch: TouchBatch) -> Features:
        """Encode all streams and the view of each contact of a batch."""
        sensors = jnp.broadcast_to(jnp.arange(batch.frames.shape[1]), batch.frames.shape[:2])
        touch = self.encode_streams(batch.frames, batch.force_n, batch.frame_index, batch.frame_mask, sensors)
        return self._features(batch, touch)

    def encode_blind(self, batch: TouchBatch) -> Features:
        """The same contacts for a policy without touch: no stream is present, only the view is encoded."""
        shape = (*self.token_time(batch.frame_index, batch.frame_mask).shape, self.config.decoder.hidden_size)
        return self._features(
            dataclasses.replace(batch, stream_mask=jnp.zeros_like(batch.stream_mask)), jnp.zeros(shape)
        )

    def _features(self, batch: TouchBatch, touch: Float[Array, "P S N D"]) -> Features:
        return Features(
            touch=touch,
            touch_time=self.token_time(batch.frame_index, batch.frame_mask),
            stream_mask=batch.stream_mask,
            view=self.vision(batch.view),
            view_mask=batch.view_mask,
        )

    def token_time(self, frame_index: Int[Array, "*n F"], frame_mask: Bool[Array, "*n F"]) -> Int[Array, "*n N"]:
        """Frame index of each pooled token: that of the first frame of its time step, −1 where the step has none."""
        c = self.config.tactile
        first = step_time(jnp.where(frame_mask, frame_index, -1), frame_mask, c.frames_per_step)
        return jnp.repeat(first, c.tokens_per_step, -1)

    def prefill(
        self,
        features: Features,
        ids: Int[Array, "L"],
        mask: Bool[Array, "L"],
        slots: Slots,
        banned: Bool[Array, "V"],
        known: PrefixCache | None = None,
        start: int = 0,
    ) -> tuple[Float[Array, "V"], PrefixCache]:
        """Encode one prompt: the logits of the first completion token, and the cache of the prefix.

        Where `known` encodes a prompt that is the same before `start`, only what follows is computed.
        """
        hidden, prefix = self.prefill_state(features, ids, mask, slots, known, start)
        return self.decoder.logits(hidden, banned), prefix

    def prefill_state(
        self,
        features: Features,
        ids: Int[Array, "L"],
        mask: Bool[Array, "L"],
        slots: Slots,
        known: PrefixCache | None = None,
        start: int = 0,
    ) -> tuple[Float[Array, "D"], PrefixCache]:
        """As `prefill`, but the hidden state that the first token's logits are made of."""
        x, levels = with_features(self.decoder.embed(ids), features, slots)
        mask = prompt_mask(features, mask, slots)
        positions = prompt_positions(features.touch_time, mask, slots, self.config.grid)
        return self.decoder.prefill(x, positions, mask, known, start, levels)

    def completion_states(
        self, tokens: Int[Array, "*g T"], first: Float[Array, "D"], prefix: PrefixCache
    ) -> Float[Array, "*g T D"]:
        """Hidden states that predict each token of a completion, or of a group of completions of one prompt.

        The first is predicted from the prefix, others from what precedes.
        """
        first = jnp.broadcast_to(first, (*tokens.shape[:-1], 1, *first.shape))
        return jnp.concatenate([first, self.decoder.extend(tokens[..., :-1], prefix)], -2)

    def explored_states(
        self,
        tokens: Int[Array, "T"],
        exists: Bool[Array, "T"],
        touch: Float[Array, "B N W"],
        observed: Bool[Array, "B N"],
        first: Float[Array, "D"],
        prefix: PrefixCache,
    ) -> Float[Array, "T D"]:
        """Hidden states that predict each token of B + 1 turns, after each of which but the last stands an observation.

        Each token is predicted from the last row before it that exists, the first from the prompt.
        """
        turns, width = len(touch) + 1, len(tokens) // (len(touch) + 1)
        text = self.decoder.embed(tokens).reshape(turns, width, -1)
        seen = self.project(touch).astype(text.dtype)
        with_last = lambda x: jnp.pad(x, [(0, 1)] + [(0, 0)] * (x.ndim - 1))
        rows = turns * (width + touch.shape[1]) - touch.shape[1]  # no observation follows the last turn
        in_rows = lambda x, y: jnp.concatenate([x, with_last(y)], 1).reshape(-1, *x.shape[2:])[:rows]
        there = in_rows(exists.reshape(turns, width), observed)
        hidden = self.decoder.extend_embedded(in_rows(text, seen), there, prefix)
        latest = jax.lax.cummax(jnp.where(there, 1 + jnp.arange(len(there)), 0))
        before = jnp.pad(latest, (1, touch.shape[1] - 1)).reshape(turns, -1)[:, :width]
        return jnp.concatenate([first[None], hidden])[before.reshape(-1)]

    def packed_states(self, features: Float[Array, "n E"], row: Row) -> Float[Array, "K D"]:
        """Hidden states at the places of a row that ask for them; `features` as in `Row`."""
        x = self.decoder.embed(row.ids)
        embedded = (row.feature >= 0)[:, None]
        seen, levels = split_levels(features[jnp.maximum(row.feature, 0)].astype(x.dtype), x.shape[-1])
        levels = None if levels is None else jnp.where(embedded, levels, 0)
        x = jnp.where(embedded, seen, x)
        return self.decoder.packed_states(x, row.positions, row.segments, row.places, levels)

    def logits(self, states: Float[Array, "*n D"], banned: Bool[Array, "V"]) -> Float[Array, "*n V"]:
        """Scores of the token that each hidden state predicts."""
        return self.decoder.logits(states, banned)

    def embed(self, tokens: Int[Array, "*n"]) -> Float[Array, "*n D"]:
        """Embedded words."""
        return self.decoder.embed(tokens)

    def advance(self, x, exists, t, prefix: PrefixCache, caches: CompletionCaches, seen):
        """Append embedded tokens to a trajectory; see `Decoder.advance`."""
        return self.decoder.advance(x, exists, t, prefix, caches, seen)

    def decode(self, token, t, prefix: PrefixCache, caches: CompletionCaches, banned: Bool[Array, "V"]):
        """Logits of completion token t + 1 after token t, and the grown caches."""
        hidden, caches = self.decoder.decode(token, t, prefix, caches)
        return self.decoder.logits(hidden, banned), caches

    def initialise(self, batch: TouchBatch, ids: Int[Array, "L"], mask: Bool[Array, "L"], slots: Slots) -> Array:
        """Touch every parameter once; `init_policy` calls it."""
        features = jax.tree.map(lambda x: x[0], self.encode(batch))
        banned = jnp.zeros(self.config.decoder.vocab_size, bool)
        return self.logits(self.completion_states(ids, *self.prefill_state(features, ids, mask, slots)), banned)


def init_policy(
    policy: Policy,
    key: Array,
    batch: TouchBatch,
    ids: Int[np.ndarray, "L"],
    mask: Bool[np.ndarray, "L"],
    slots: Slots,
) -> Params:
    """Fresh parameters, float32, from one key and the shapes of a batch and a prompt."""
    prompt = jnp.asarray(ids), jnp.asarray(mask)
    init = jax.jit(lambda k, b: policy.init(k, b, *prompt, slots, method=Policy.initialise))
    return init(key, jax.tree.map(lambda x: x[:1], batch))["params"]


def with_features(x: Float[Array, "L D"], features: Features, slots: Slots) -> tuple[Float[Array, "L D"], Levels]:
    """Embedded words of a prompt, with tactile and view tokens in their places, and the levels of all tokens."""
    view, levels = split_levels(features.view.astype(x.dtype), x.shape[-1])
    x = x.at[slots.touch].set(features.touch.astype(x.dtype)).at[slots.view].set(view)
    return x, placed(levels, slots.view, len(x))


def prompt_mask(features: Features, mask: Bool[Array, "L"], slots: Slots) -> Bool[Array, "L"]:
    """Which prompt tokens exist: real text, names of present streams, tokens of their recorded steps, any view."""
    exists = features.stream_mask[:, None] & (features.touch_time >= 0)
    mask = jnp.asarray(mask).at[slots.touch].set(exists)
    mask = mask.at[slots.view].set(features.view_mask)
    named = jnp.append(features.stream_mask, features.view_mask)[np.maximum(slots.stream_text, 0)]
    mask = mask & jnp.where(slots.stream_text >= 0, named, True)
    step = slots.step_text
    return mask if step is None else mask & jnp.where(step >= 0, mask[np.maximum(step, 0)], True)


def prompt_positions(
    touch_time: Int[Array, "S N"], mask: Bool[Array, "L"], slots: Slots, grid: int | None
) -> Int[Array, "3 L"]:
    """(time, row, column) id of each prompt token, block by block as Qwen2.5-VL counts them.

    A text token advances all three by one.  A view token keeps the time of its block and adds its row and column.  A
    tactile token adds its frame index to the time of its block and its number within the step to the column; where text
    says the time, each step is a block and adds none, as Qwen3-VL counts the frames of a video.  A block starts after
    the largest id before it, and tokens that do not exist advance nothing, so padding changes no position.  Without a
    grid all tokens count as text.
    """
    owner = np.full(mask.shape[0], -1)
    if grid is not None:
        owner[slots.view] = 0
        owner[slots.touch] = 1 + np.arange(len(slots.touch))[:, None]
    number = np.zeros(mask.shape[0], int)
    number[slots.touch] = np.arange(slots.touch.shape[1])
    starts = np.flatnonzero(np.diff(owner, prepend=-2))
    base, blocks = jnp.zeros((), jnp.int32), []
    for begin, end in zip(starts, [*starts[1:], len(owner)], strict=True):
        here = mask[begin:end]
        if owner[begin] < 0:
            index = jnp.cumsum(here) - 1
            local = jnp.stack([index, index, index])
        elif owner[begin] == 0:
            cell = np.arange(end - begin)
            local = jnp.stack([jnp.zeros_like(cell), cell // (grid or 1), cell % (grid or 1)])
        else:
            time = touch_time[owner[begin] - 1, number[begin:end]]
            time = time if slots.step_text is None else jnp.zeros_like(time)
            local = jnp.stack([time, jnp.zeros_like(time), jnp.arange(end - begin) - _run_start(time)])
        blocks.append(base + local)
        base = base + jnp.max(jnp.where(here, local, -1), initial=-1) + 1
    return jnp.concatenate(blocks, 1)


def _run_start(time: Int[Array, "N"]) -> Int[Array, "N"]:
    """Index of the first token with the same time, for tokens in order of time."""
    fresh = jnp.concatenate([jnp.ones(1, bool), time[1:] != time[:-1]])
    return jax.lax.cummax(jnp.where(fresh, jnp.arange(time.shape[0]), 0))
