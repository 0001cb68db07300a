"""Decoder language model of Qwen2.5 and Qwen3: grouped-query attention, RMSNorm, SwiGLU, multimodal rotary positions.

Every method works on one sequence, the learner's `extend` also on a group; the callers batch by `vmap`.  A group of G
rollouts shares one prompt, so the keys of the prompt (`PrefixCache`) are an argument of their own, which a group, or
`vmap` over it, leaves as it is.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.blocked_attention import LayerCache, Segments, attend_causally, attend_in_segments
from touchr1_jax.models.decoder_config import DecoderConfig
from touchr1_jax.models.deepstack import Levels, add_level
from touchr1_jax.models.layers import MASKED, GatedMLP, KeySource, RMSNorm, Rotation, attend, mrope, rotate
from touchr1_jax.models.stacked import ADAPTERS, before_the_loop, scan_layers
from touchr1_jax.models.token_cache import CompletionCaches, TokenCache, grown, layer_of, turned, write_rows
from touchr1_jax.models.vmappable_dense import Dense, Embed, product_with_weights


class Caches(NamedTuple):
    """Keys and values of a prompt: those of the layers before the last stacked along a first axis, as their parameters
    are."""

    layers: LayerCache | None  # none in a decoder of one layer
    last: LayerCache


class PrefixCache(NamedTuple):
    """An encoded prompt: its keys and values, which of them may be seen, and the position that follows it."""

    caches: Caches
    mask: Bool[Array, "L"]
    next_position: Int[Array, ""]


class DecoderLayer(nn.Module):
    """Pre-norm transformer layer, split in two so that each caller attends to the keys that it has."""

    config: DecoderConfig

    def setup(self) -> None:
        c = self.config
        self.norm_attention, self.norm_mlp = RMSNorm(c.norm_epsilon), RMSNorm(c.norm_epsilon)
        self.q_proj = Dense(c.num_heads * c.head_dim, use_bias=c.qkv_bias)
        self.k_proj = Dense(c.num_kv_heads * c.head_dim, use_bias=c.qkv_bias)
        self.v_proj = Dense(c.num_kv_heads * c.head_dim, use_bias=c.qkv_bias)
        if c.qk_norm:
            self.q_norm, self.k_norm = RMSNorm(c.norm_epsilon), RMSNorm(c.norm_epsilon)
        self.o_proj = Dense(c.hidden_size, use_bias=False)
        self.mlp = GatedMLP(c.intermediate_size)

    def project(self, x: Float[Array, "*g T D"], rotation: Rotation) -> tuple[Float[Array, "*g T KV R d"], LayerCache]:
        """Queries of each token, and its keys and values head-major."""
        c, y = self.config, self.norm_attention(x)
        heads = lambda z: z.reshape(*z.shape[:-1], -1, c.head_dim)
        q, k, v = heads(self.q_proj(y)), heads(self.k_proj(y)), heads(self.v_proj(y))
        if c.qk_norm:
            q, k = self.q_norm(q), self.k_norm(k)
        q, k = rotate(q, rotation), rotate(k, rotation)
        major = lambda z: jnp.moveaxis(z, -2, 0)
        return q.reshape(*x.shape[:-1], c.num_kv_heads, -1, c.head_dim), LayerCache(major(k), major(v))

    def finish(self, x: Float[Array, "*g T D"], attended: Float[Array, "*g T hd"]) -> Float[Array, "*g T D"]:
        """Residual sums after attention and after the MLP."""
        x = x + self.o_proj(attended)
        return x + self.mlp(self.norm_mlp(x))

    def over_prompt(
        self, x: Float[Array, "n D"], rotation: Rotation, mask: Bool[Array, "L"], before: LayerCache | None = None
    ) -> tuple[Float[Array, "n D"], LayerCache]:
        """The last n of L prompt tokens, and the keys of all L; `before` holds those of the first L − n."""
        q, own = self.project(x, rotation)
        cache = _joined(before, own)
        return self.finish(x, attend_causally(q, cache, mask)), cache

    def over_end(
        self, x: Float[Array, "n D"], rotation: Rotation, mask: Bool[Array, "L"], before: LayerCache | None = None
    ) -> tuple[Float[Array, "1 D"], LayerCache]:
        """As `over_prompt`, but the last token alone is answered."""
        q, own = self.project(x, rotation)
        cache = _joined(before, own)
        return self.finish(x[-1:], attend(q[-1:], [KeySource(cache.k, cache.v, mask)])), cache

    def over_completion(
        self,
        x: Float[Array, "*g T D"],
        rotation: Rotation,
        past: LayerCache,
        mask: Bool[Array, "L"],
        exists: Bool[Array, "T"] | None = None,
    ) -> Float[Array, "*g T D"]:
        """All tokens of a completion, or of a group of them, under the prompt whose keys are `past`; by default all
        tokens exist."""
        q, own = self.project(x, rotation)
        causal = jnp.tri(x.shape[-2], dtype=bool)
        causal = causal if exists is None else causal & exists
        return self.finish(x, attend(q, [KeySource(past.k, past.v, mask), KeySource(own.k, own.v, causal)]))

    def over_row(self, x: Float[Array, "W D"], rotation: Rotation, segments: Segments) -> Float[Array, "W D"]:
        """A row of examples, of which none sees another."""
        q, own = self.project(x, rotation)
        return self.finish(x, attend_in_segments(q, own, segments))

    def over_places(
        self, x: Float[Array, "W D"], rotation: Rotation, segments: Segments, places: Int[Array, "K"]
    ) -> Float[Array, "K D"]:
        """As `over_row`, but the tokens at some places alone are answered."""
        x_K, at_K = x[places], Rotation(rotation.cos[places], rotation.sin[places])
        q, own = self.project(x_K, at_K)[0], self.project(x, rotation)[1]
        own_segment = segments.number[places, None] == segments.number
        seen = own_segment & (jnp.arange(x.shape[0]) <= places[:, None])
        return self.finish(x_K, attend(q, [KeySource(own.k, own.v, seen)]))


Rematerialised = nn.remat(
    DecoderLayer,
    policy=product_with_weights,
    methods=("over_prompt", "over_end", "over_completion", "over_row", "over_places"),
)
"""A layer of which the backward pass keeps matrix products with weights alone.  Layer by layer: the recomputation waits
for the gradient of its layer, where that of all layers at once may begin with all of them and hold what it makes."""


class Decoder(nn.Module):
    """Causal language model with an explicit cache: `prefill` a prompt, then `extend` it or `decode` token by token.

    The layers before the last are one layer with stacked parameters, scanned, so that a program does not grow with
    depth; the last stands alone, for often only some of its tokens are answered.  With `remat` the backward passes keep
    less and compute more; values, gradients and parameters are the same.
    """

    config: DecoderConfig
    remat: bool = False

    def setup(self) -> None:
        c = self.config
        layer = Rematerialised if self.remat else DecoderLayer
        self.embedding = Embed(c.vocab_size, c.hidden_size, embedding_init=nn.initializers.normal(0.02))
        if c.num_layers > 1:
            self.layers = layer(c)
        self.last_layer = layer(c)
        self.norm = RMSNorm(c.norm_epsilon)
        if not c.tie_embedding:
            self.head = Dense(c.vocab_size, use_bias=False)

    def embed(self, tokens: Int[Array, "*n"]) -> Float[Array, "*n D"]:
        """Rows of the embedding table."""
        return self.embedding(tokens)

    def logits(self, x: Float[Array, "*n D"], banned: Bool[Array, "V"]) -> Float[Array, "*n V"]:
        """Scores of the next token in float32, with banned ids (placeholders, padding) out of reach for good."""
        y = self.norm(x)
        scores = self.embedding.attend(y) if self.config.tie_embedding else self.head(y)
        return jnp.where(banned, MASKED, scores.astype(jnp.float32))

    def prefill(
        self,
        x: Float[Array, "L D"],
        positions: Int[Array, "3 L"],
        mask: Bool[Array, "L"],
        known: PrefixCache | None = None,
        start: int = 0,
        levels: Levels = None,
    ) -> tuple[Float[Array, "D"], PrefixCache]:
        """Encode a prompt once.

        Args:
          x: embedded prompt; its last token must be a real one.
          positions: (time, row, column) of each token.
          mask: which tokens exist; the others are never attended to.
          known: an earlier encoding of a prompt that is the same before `start`, whose keys are taken over.
          start: first token that is computed.
          levels: added to the tokens after each of the first layers, which the last is not among.

        Returns:
          The hidden state of the last token and the cache that `extend` and `decode` read.
        """
        x, rotation = x[start:], self._rotation(positions[:, start:])
        old: Any = Caches(None, None) if known is None else known.caches  # type: ignore[arg-type]
        before = jax.tree.map(lambda rows: rows[..., :start, :], old)
        each = lambda layer, y, rows: layer.over_prompt(y, rotation, mask, rows)
        x, layers = self._scan(each, x, before.layers, levels=None if levels is None else levels[:, start:])
        # the completion needs all keys of the last layer, but only the last token's answer
        x, last = self.last_layer.over_end(x, rotation, mask, before.last)
        return x[0], PrefixCache(Caches(layers, last), mask, _after(positions, mask))

    def states(
        self, x: Float[Array, "L D"], positions: Int[Array, "3 L"], mask: Bool[Array, "L"], levels: Levels = None
    ) -> tuple[Float[Array, "L D"], PrefixCache]:
        """As `prefill`, with the hidden states of all tokens."""
        rotation = self._rotation(positions)
        each = lambda layer, y: layer.over_prompt(y, rotation, mask)
        x, layers = self._scan(each, x, levels=levels)
        x, last = each(self.last_layer, x)
        return x, PrefixCache(Caches(layers, last), mask, _after(positions, mask))

    def extend(self, tokens: Int[Array, "*g T"], prefix: PrefixCache) -> Float[Array, "*g T D"]:
        """Hidden states of a completion, or of a group, under the prompt, all at once (the learner's forward pass)."""
        t = tokens.shape[-1]
        x = self.embed(tokens)
        rotation = self._rotation(jnp.broadcast_to(prefix.next_position + jnp.arange(t), (3, t)))
        return self._after_prefix(x, rotation, prefix)

    def extend_embedded(
        self, x: Float[Array, "T D"], exists: Bool[Array, "T"], prefix: PrefixCache
    ) -> Float[Array, "T D"]:
        """As `extend`, for embedded tokens of one sequence; those that do not exist advance no position."""
        rotation = self._rotation(_text_positions(prefix.next_position, exists))
        return self._after_prefix(x, rotation, prefix, exists)

    def packed_states(
        self,
        x: Float[Array, "W D"],
        positions: Int[Array, "3 W"],
        segments: Segments,
        places: Int[Array, "K"],
        levels: Levels = None,
    ) -> Float[Array, "K D"]:
        """Hidden states at some places of a row of examples, each of which sees what precedes it in its own alone.

        Args:
          x: embedded tokens.
          positions: (time, row, column) of each token.
          segments: the example of each token.
          places: whose states are wanted.
          levels: as in `prefill`.
        """
        rotation = self._rotation(positions)
        x, _ = self._scan(lambda layer, y: (layer.over_row(y, rotation, segments), None), x, levels=levels)
        return self.last_layer.over_places(x, rotation, segments, places)

    def decode(
        self, token: Int[Array, ""], t: Int[Array, ""], prefix: PrefixCache, caches: CompletionCaches
    ) -> tuple[Float[Array, "D"], CompletionCaches]:
        """Hidden state of completion token t, and the caches with its row written (the sampler's forward pass)."""
        x = self.embed(token[None])
        rotation = self._rotation(jnp.broadcast_to(prefix.next_position + t, (3, 1)))
        seen = jnp.arange(caches[-1].v.shape[-2]) <= t
        x, caches = self._append(x, rotation, t, prefix, caches, seen)
        return x[0], caches

    def advance(
        self,
        x: Float[Array, "n D"],
        exists: Bool[Array, "n"],
        t: Int[Array, ""],
        prefix: PrefixCache,
        caches: CompletionCaches,
        seen: Bool[Array, "T"],
    ) -> tuple[Float[Array, "n D"], CompletionCaches, Bool[Array, "T"]]:
        """Append n embedded tokens at row t of the caches; those that do not exist are never attended to.

        Args:
          x: embedded tokens.
          exists: which of them exist.
          t: row of the first one.
          prefix: encoded prompt.
          caches: keys and values of the rows before t.
          seen: rows before t that exist.

        Returns:
          The hidden states of the tokens, the caches, and all rows that exist.
        """
        n, rows = x.shape[0], seen.shape[0]
        rotation = self._rotation(_text_positions(prefix.next_position + jnp.sum(seen), exists))
        seen = write_rows(seen[None, :, None], exists[None, :, None], None, t)[0, :, 0]
        mask = seen & (jnp.arange(rows) <= t + jnp.arange(n)[:, None])
        return *self._append(x, rotation, t, prefix, caches, mask), seen

    def _scan(
        self, each: Callable[..., tuple[Any, Any]], x: Any, *of_layers: Any, levels: Levels = None
    ) -> tuple[Any, Any]:
        """x through all layers before the last, each(layer, x, its part of `of_layers`) → x, what is kept of it."""
        count = self.config.num_layers - 1
        if not count:
            return x, None
        if levels is None:
            return scan_layers(each, count)(self.layers, x, *of_layers)

        def with_level(layer: DecoderLayer, y: Array, i: Int[Array, ""], *of_layer: Any) -> tuple[Array, Any]:
            y, kept = each(layer, y, *of_layer)
            return add_level(y, levels, i), kept

        return scan_layers(with_level, count)(self.layers, x, jnp.arange(count), *of_layers)

    def _after_prefix(
        self, x: Float[Array, "*g T D"], rotation: Rotation, prefix: PrefixCache, exists: Bool[Array, "T"] | None = None
    ) -> Float[Array, "*g T D"]:
        """A completion through all layers."""
        each = lambda layer, y, past: (layer.over_completion(y, rotation, past, prefix.mask, exists), None)
        x, _ = self._scan(each, x, prefix.caches.layers)
        return each(self.last_layer, x, prefix.caches.last)[0]

    def _append(
        self,
        x: Float[Array, "n D"],
        rotation: Rotation,
        t: Int[Array, ""],
        prefix: PrefixCache,
        caches: CompletionCaches,
        seen: Bool[Array, "*n T"],
    ) -> tuple[Float[Array, "n D"], CompletionCaches]:
        """Tokens through all layers, their keys and values written from row t on."""

        apart = len(caches) == self.config.num_layers
        once = before_the_loop if apart else lambda x: x  # for weights of layers, and keys of the prompt as columns

        def each(layer: DecoderLayer, x: Any, past: LayerCache, cache: TokenCache, i: Any = None) -> Any:
            q, row = layer.project(x, rotation)
            cache = grown(cache, row, i, t)
            own = cache if i is None else layer_of(cache, i)
            before = KeySource(turned(once(turned(past.k))), past.v, prefix.mask)
            return layer.finish(x, attend(q, [before, KeySource(turned(own.k), own.v, seen)])), cache

        def scanned(layer: DecoderLayer, carry: Any, i: Int[Array, ""]) -> tuple[Any, None]:
            x, (cache, *others) = carry  # the caches are carried and not mapped over, so that they are written in place
            x, cache = each(layer, x, layer_of(prefix.caches.layers, i), cache, None if apart else i)
            return (x, (*others, cache)), None  # the cache of the next layer comes to the front

        *before, last = caches
        layer_step = nn.map_variables(scanned, ("params", ADAPTERS), functools.partial(jax.tree.map, once))
        (x, before), _ = self._scan(layer_step, (x, tuple(before)), jnp.arange(self.config.num_layers - 1))
        x, last = each(self.last_layer, x, prefix.caches.last, last)
        return x, (*before, last)

    def _rotation(self, positions: Int[Array, "3 T"]) -> Rotation:
        c = self.config
        return mrope(positions, c.head_dim, c.mrope_section, c.rope_theta, interleaved=c.interleaved)


def _joined(before: LayerCache | None, own: LayerCache) -> LayerCache:
    """Rows of one cache, then those of another."""
    if before is None:
        return own
    return LayerCache(jnp.concatenate([before.k, own.k], 1), jnp.concatenate([before.v, own.v], 1))


def _text_positions(first: Int[Array, ""], exists: Bool[Array, "n"]) -> Int[Array, "3 n"]:
    """(time, row, column) of tokens that follow one another; those that do not exist advance nothing."""
    return jnp.broadcast_to(first + jnp.cumsum(exists) - 1, (3, len(exists)))


def _after(positions: Int[Array, "3 L"], mask: Bool[Array, "L"]) -> Int[Array, ""]:
    """The position that follows a prompt."""
    return jnp.max(jnp.where(mask, positions, -1)) + 1
