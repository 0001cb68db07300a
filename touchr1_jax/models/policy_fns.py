"""A policy together with its prompt layout and vocabulary: the pure functions that training and sampling call."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.lm import PrefixCache
from touchr1_jax.models.lora import LoraConfig, adapted
from touchr1_jax.models.policy import Features, Policy, Row, Slots
from touchr1_jax.models.stacked import ADAPTERS
from touchr1_jax.models.token_cache import CompletionCaches, empty_caches
from touchr1_jax.text.template import PromptLayout
from touchr1_jax.text.tokenizer import Tokenizer
from touchr1_jax.types import Params, TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PolicyFns:
    """Static context of every forward pass; parameters are always an argument.

    Attributes:
      module: the Linen module.
      slots: where a prompt keeps its tactile and view tokens.
      banned: [V], ids that are never sampled (padding, placeholders).
      end_ids: ids that end a completion.
      pad_id: id that follows the end.
      cache_dtype: type of keys and values, that of the decoder's parameters.
      lora: which layers have adapters where parameters hold any, and their scale.
      base: frozen parameters, in addition to those that are an argument.  A base of gigabytes must be an argument of a
        compiled step and not a constant: build the step inside the compiled function, as `over_base` does.
    """

    module: Policy
    slots: Slots
    banned: np.ndarray
    end_ids: tuple[int, ...]
    pad_id: int
    cache_dtype: jnp.dtype = jnp.dtype(jnp.float32)
    lora: LoraConfig = LoraConfig(rank=0)
    base: Params = dataclasses.field(default_factory=dict)

    @classmethod
    def for_layout(
        cls, module: Policy, layout: PromptLayout, tokenizer: Tokenizer, cache_dtype: jnp.dtype | type = jnp.float32
    ) -> "PolicyFns":
        """The functions of a module on the prompts of a layout."""
        return cls(
            module=module,
            slots=Slots(layout.touch, layout.view, layout.stream_text, layout.step_text),
            banned=tokenizer.banned,
            end_ids=tokenizer.end_ids,
            pad_id=tokenizer.pad_id,
            cache_dtype=jnp.dtype(cache_dtype),
        )

    def encode(self, params: Params, batch: TouchBatch, *, blind: bool = False) -> Features:
        """Encode a batch of contacts, [P, …]; a blind policy has no streams."""
        method = Policy.encode_blind if blind else Policy.encode
        return self._apply(params, method, batch)

    def encode_streams(self, params: Params, *stream: Array) -> Float[Array, "*n N D"]:
        """Encode any batch of single streams; arguments as in `TactileViT`."""
        return self._apply(params, Policy.encode_streams, *stream)

    def with_context(self, change: Callable[[Params], Params]) -> "PolicyFns":
        """The functions on a changed base."""
        return dataclasses.replace(self, base=change(self.base)) if self.base else self

    @property
    def touch_start(self) -> int:
        """First prompt token that any touch can change: a tactile token or a sensor's name."""
        stream = np.isin(self.slots.stream_text, np.arange(len(self.slots.touch)))
        return int(min([*np.flatnonzero(stream), *self.slots.touch.ravel(), len(stream)]))

    @property
    def step_tokens(self) -> int:
        """Tactile tokens of a time step."""
        return self.module.config.tactile.tokens_per_step

    @property
    def touch_starts(self) -> tuple[int, ...]:
        """First prompt token that a change of each stream's touch can change."""
        return tuple(int(row.min()) for row in self.slots.touch)

    def prefill(
        self,
        params: Params,
        features: Features,
        ids: Int[Array, "L"],
        mask: Bool[Array, "L"],
        known: PrefixCache | None = None,
        start: int = 0,
    ) -> tuple[Float[Array, "V"], PrefixCache]:
        """Encode one prompt; with `known`, the encoding of a prompt that differs from `start` on, only from there."""
        banned = jnp.asarray(self.banned)
        return self._apply(params, Policy.prefill, features, ids, mask, self.slots, banned, known, start)

    def decode(
        self, params: Params, token: Array, t: Array, prefix: PrefixCache, caches: CompletionCaches
    ) -> tuple[Float[Array, "V"], CompletionCaches]:
        """One token step of one rollout."""
        return self._apply(params, Policy.decode, token, t, prefix, caches, jnp.asarray(self.banned))

    def group_logits(
        self,
        params: Params,
        features: Features,
        ids: Int[Array, "L"],
        mask: Bool[Array, "L"],
        tokens: Int[Array, "G T"],
    ) -> Float[Array, "G T V"]:
        """Logits of every token of a group of completions of one prompt; the prompt is encoded once.

        Values and gradients equal those of G separate forward passes over prompt and completion.
        """
        return self.logits(params, self.group_states(params, features, ids, mask, tokens)[0])

    def group_states(
        self,
        params: Params,
        features: Features,
        ids: Int[Array, "L"],
        mask: Bool[Array, "L"],
        tokens: Int[Array, "G T"],
        known: PrefixCache | None = None,
        start: int = 0,
    ) -> tuple[Float[Array, "G T D"], PrefixCache]:
        """Hidden states that predict every token of a group of completions, and the encoded prompt.

        What `logits` makes of them is V numbers a token; who cannot afford those of all tokens at once takes some
        states at a time.  `known` and `start` as in `prefill`.
        """
        first, prefix = self._apply(params, Policy.prefill_state, features, ids, mask, self.slots, known, start)
        return self._apply(params, Policy.completion_states, tokens, first, prefix), prefix

    def packed_states(self, params: Params, features: Float[Array, "n E"], row: Row) -> Float[Array, "K D"]:
        """Hidden states at the places of a row of prompts with their completions, as `group_states` has them."""
        return self._apply(params, Policy.packed_states, features, row)

    def logits(self, params: Params, states: Float[Array, "*n D"]) -> Float[Array, "*n V"]:
        """Scores of the token that each hidden state predicts, banned ids out of reach."""
        return self._apply(params, Policy.logits, states, jnp.asarray(self.banned))

    def empty_cache(self, length: int) -> CompletionCaches:
        """Caches of one completion of at most `length` tokens."""
        return empty_caches(self.module.config.decoder, length, self.cache_dtype)

    def _apply(self, params: Params, method: Callable[..., Any], *args: Any) -> Any:
        whole = {**self.base, **params}
        adapters = whole.pop(ADAPTERS, None)
        if adapters is None:
            return self.module.apply({"params": whole}, *args, method=method)
        with adapted(self.lora.scale):
            return self.module.apply({"params": whole, ADAPTERS: adapters}, *args, method=method)


def over_base(fns: PolicyFns, make_step: Callable[[PolicyFns], Callable[..., Any]]) -> Callable[..., Any]:
    """Compile (base, state, …) → result from a maker of the step (state, …) → result; the state is donated."""

    def step(base: Params, state: Any, *rest: Any) -> Any:
        return make_step(dataclasses.replace(fns, base=base))(state, *rest)

    return jax.jit(step, donate_argnums=1)
