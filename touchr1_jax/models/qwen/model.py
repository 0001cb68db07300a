"""Qwen2.5-VL and Qwen3-VL: vision tower and decoder, on prompts that mix text with pictures and videos."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from touchr1_jax.models.deepstack import Levels, placed, split_levels
from touchr1_jax.models.lm import Decoder, PrefixCache
from touchr1_jax.models.qwen.config import AnyVision, QwenConfig, QwenVisionConfig
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.qwen3_vision import Qwen3Vision
from touchr1_jax.models.qwen.vision import QwenVision
from touchr1_jax.types import Params


class Inputs(NamedTuple):
    """One prompt, ready to be encoded; a prompt of text alone has no patches and no slots."""

    ids: Int[Array, "L"]
    positions: Int[Array, "3 L"]
    slots: Int[Array, "N"]  # where the tokens of the vision tower stand, in the order of the patches
    patches: Float[Array, "n pixel"]


def vision_tower(config: AnyVision) -> QwenVision | Qwen3Vision:
    """The module f(patches, grids) → tokens of a config."""
    return QwenVision(config) if isinstance(config, QwenVisionConfig) else Qwen3Vision(config)


class QwenVL(nn.Module):
    """Parameters and forward passes; `grids` says whose the patches are and is static."""

    config: QwenConfig

    def setup(self) -> None:
        self.vision = vision_tower(self.config.vision)
        self.decoder = Decoder(self.config.decoder)

    def __call__(self, inputs: Inputs, grids: tuple[Grid, ...]) -> Float[Array, "L V"]:
        """Logits of the token that follows each token."""
        x, levels = self._embed(inputs, grids)
        mask = jnp.ones(inputs.ids.shape, bool)
        return self._logits(self.decoder.states(x, inputs.positions, mask, levels)[0])

    def prefill(self, inputs: Inputs, grids: tuple[Grid, ...]) -> tuple[Float[Array, "V"], PrefixCache]:
        """Logits of the first token of the answer, and the cache that `extend` and `decode` of the decoder read."""
        x, levels = self._embed(inputs, grids)
        mask = jnp.ones(inputs.ids.shape, bool)
        last, cache = self.decoder.prefill(x, inputs.positions, mask, levels=levels)
        return self._logits(last), cache

    def extend(self, tokens: Int[Array, "T"], prefix: PrefixCache) -> Float[Array, "T V"]:
        """Logits after each token of an answer, all at once."""
        return self._logits(self.decoder.extend(tokens, prefix))

    def decode(self, token, t, prefix, caches):
        """Logits after token t of an answer, and the caches with its row written; arguments as in `Decoder.decode`."""
        hidden, caches = self.decoder.decode(token, t, prefix, caches)
        return self._logits(hidden), caches

    def _embed(self, inputs: Inputs, grids: tuple[Grid, ...]) -> tuple[Float[Array, "L D"], Levels]:
        x = self.decoder.embed(inputs.ids)
        if not grids:
            return x, None
        seen, levels = split_levels(self.vision(inputs.patches, grids).astype(x.dtype), x.shape[-1])
        return x.at[inputs.slots].set(seen), placed(levels, inputs.slots, len(x))

    def _logits(self, states: Float[Array, "*n D"]) -> Float[Array, "*n V"]:
        return self.decoder.logits(states, jnp.zeros(self.config.decoder.vocab_size, bool))


def abstract_params(config: QwenConfig) -> Params:
    """Shapes of all parameters, as `jax.ShapeDtypeStruct`: what is initialised and what a checkpoint must hold."""
    return jax.eval_shape(lambda: init_params(config, jax.random.key(0)))


def init_params(config: QwenConfig, key: Array) -> Params:
    """Fresh parameters, float32."""
    v = config.vision
    grid = Grid(1, v.merge, v.merge)
    inputs = Inputs(
        ids=jnp.full(1, config.image_id, jnp.int32),
        positions=jnp.zeros((3, 1), jnp.int32),
        slots=jnp.zeros(1, jnp.int32),
        patches=jnp.zeros((grid.patches, v.patch_size)),
    )
    return QwenVL(config).init(key, inputs, (grid,))["params"]
