"""A policy that explores: its question is the prompt, and its observations stand between its own turns.

    turn 0 | observation 0 | turn 1 | observation 1 | … | turn B

Each turn has as many places as the longest turn, and each observation N; those that are empty are never attended to
and advance no position.  The functions are those of `PolicyFns`, so that losses, gradients and SFT are shared.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.layers import MASKED
from touchr1_jax.models.lm import DecoderConfig, PrefixCache
from touchr1_jax.models.policy import Features, Policy, PolicyConfig, Slots
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.token_cache import CompletionCaches
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.text.language import EXPLORED_ATTRIBUTES, Attribute
from touchr1_jax.text.template import LevelTokens, level_tokens
from touchr1_jax.text.tokenizer import Tokenizer
from touchr1_jax.text.turns import QUESTIONS_OF_TOUCH, TurnLanguage, Turns, compile_turns, turn_tokenizer
from touchr1_jax.types import Params, Target


@struct.dataclass
class Explored:
    """Prompts, and the at most B observations of each of their G trajectories: N tokens of width W.

    `stream_mask` is true for prompts in which anything was observed.
    """

    prompt: Features
    touch: Float[Array, "*n G B N W"]
    exists: Bool[Array, "*n G B N"]
    stream_mask: Bool[Array, "*n 1"]


class Placed(NamedTuple):
    """Hidden states, the place in a turn from which each predicts a token, and the actions before that turn."""

    hidden: Float[Array, "*n D"]
    place: Int[Array, "*n"]
    made: Int[Array, "*n B"]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ActiveFns(PolicyFns):
    """Forward passes over trajectories; `Explored` takes the place of `Features`.

    Attributes:
      turns: automaton of the turns.
      levels: token of each level; `None` where the tokenizer splits one.
      constrained: give tokens that continue no turn the probability 0, for the sampler and for the learner.
    """

    turns: Turns
    levels: LevelTokens | None
    constrained: bool

    @property
    def touch_starts(self) -> tuple[int, ...]:
        """No prompt token depends on an observation; the last one is computed again."""
        return (len(self.slots.stream_text) - 1,)

    def prompt_state(
        self, params: Params, features: Features, ids: Int[Array, "L"], mask: Bool[Array, "L"]
    ) -> tuple[Float[Array, "D"], PrefixCache]:
        """Encode one prompt: the hidden state that predicts the first token, and the keys and values."""
        return self._apply(params, Policy.prefill_state, features, ids, mask, self.slots)

    def embed(self, params: Params, tokens: Int[Array, "*n"]) -> Float[Array, "*n D"]:
        """Embedded words."""
        return self._apply(params, Policy.embed, tokens)

    def project(self, params: Params, touch: Float[Array, "*n W"]) -> Float[Array, "*n D"]:
        """Embedded observations."""
        return self._apply(params, Policy.project, touch)

    def advance(
        self,
        params: Params,
        x: Float[Array, "n D"],
        exists: Bool[Array, "n"],
        t: Int[Array, ""],
        prefix: PrefixCache,
        caches: CompletionCaches,
        seen: Bool[Array, "T"],
    ) -> tuple[Float[Array, "n D"], CompletionCaches, Bool[Array, "T"]]:
        """Append embedded tokens to a trajectory; see `Decoder.advance`."""
        return self._apply(params, Policy.advance, x, exists, t, prefix, caches, seen)

    def placed(self, hidden: Float[Array, "*n D"], place: Int[Array, "*n"], made: Int[Array, "*n B"]) -> Any:
        """States as `logits` takes them."""
        return Placed(hidden, place, made) if self.constrained else hidden

    def group_states(
        self,
        params: Params,
        features: Any,
        ids: Int[Array, "L"],
        mask: Bool[Array, "L"],
        tokens: Int[Array, "G T"],
        known: PrefixCache | None = None,
        start: int = 0,
    ) -> tuple[Any, PrefixCache]:
        """States that predict every token of the turns of a group, in one pass over text and observations.

        Padding marks the tokens that do not exist.
        """
        prompt = (features.prompt, ids, mask, self.slots, known, start)
        first, prefix = self._apply(params, Policy.prefill_state, *prompt)

        def of_one(
            tokens: Int[Array, "T"], touch: Float[Array, "B N W"], exists: Bool[Array, "B N"]
        ) -> Float[Array, "T D"]:
            return self._apply(
                params, Policy.explored_states, tokens, tokens != self.pad_id, touch, exists, first, prefix
            )

        hidden = jax.vmap(of_one)(tokens, features.touch, features.exists)
        return (self.placed(hidden, *jax.vmap(self.places)(tokens)) if self.constrained else hidden), prefix

    def places(self, tokens: Int[Array, "T"]) -> tuple[Int[Array, "T"], Int[Array, "T B"]]:
        """The place in its turn from which each token of a trajectory is predicted, and the actions before that turn.

        The last turn must conclude.
        """
        by_turn = tokens.reshape(-1, self.turns.length)
        turn = jnp.arange(len(by_turn))
        before, after = self.turns.places(by_turn, turn == len(by_turn) - 1)
        action = jnp.asarray(self.turns.action)[after[:-1]]
        made = jnp.where(turn[:-1] < turn[:, None], action, -1)
        return before.reshape(-1), jnp.repeat(made, self.turns.length, 0)

    def logits(self, params: Params, states: Any) -> Float[Array, "*n V"]:
        """Scores of the next token; of constrained states those that continue no turn are out of reach."""
        if not isinstance(states, Placed):
            return super().logits(params, states)
        return jnp.where(self.turns.allowed(states.place, states.made), super().logits(params, states.hidden), MASKED)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ActivePolicy:
    """Everything static about a policy that explores; its parameters are always an argument.

    Attributes:
      language, tokenizer, turns: what it writes, and how it is read.
      ids, mask: [A, L], the question for each attribute, padded on the left.
      fns: forward passes that leave the text free, for SFT.
    """

    language: TurnLanguage
    tokenizer: Tokenizer
    turns: Turns
    ids: np.ndarray  # int32 [A, L]
    mask: np.ndarray  # bool [A, L]
    fns: ActiveFns

    @property
    def frozen(self) -> tuple[str, ...]:
        """No tower stands still."""
        return ()

    @functools.cached_property
    def constrained_fns(self) -> ActiveFns:
        """The same forward passes over turns that are always legal."""
        return dataclasses.replace(self.fns, constrained=True)

    def tokens(self, budget: int) -> int:
        """T, tokens of the turns of a trajectory of at most `budget` actions."""
        return (budget + 1) * self.turns.length

    def init(self, seed: int, width: int) -> Params:
        """Fresh parameters of the decoder and of the projection of observations of `width` numbers a token."""
        init = _initializer(self, width)
        return init(jax.random.key(seed), jnp.asarray(self.ids[0]), jnp.asarray(self.mask[0]))["params"]

    def prompt_features(self, n: int) -> Features:
        """Encoded touch and view of n prompts that are questions alone: nothing."""
        width = self.fns.module.config.decoder.hidden_size
        of: dict[str, Any] = {
            "touch": np.zeros((n, 0, 0, width), np.float32),
            "touch_time": np.zeros((n, 0, 0), np.int32),
            "stream_mask": np.zeros((n, 0), bool),
            "view": np.zeros((n, 0, width), np.float32),
            "view_mask": np.zeros(n, bool),
        }
        return Features(**of)

    def target(self, attribute: Int[np.ndarray, "n"], label: Int[np.ndarray, "n A"]) -> Target:
        """Targets of questions for one attribute each, on the host."""
        attributes = self.language.attributes
        levels = np.array([len(a.levels) for a in attributes], np.int32)
        of: dict[str, Any] = {
            "asked": np.eye(len(attributes), dtype=bool)[attribute],
            "label": label.astype(np.int32),
            "levels": np.tile(levels, (len(label), 1)),
            "ordinal": np.tile([a.ordinal for a in attributes], (len(label), 1)),
            "streams": np.ones((len(label), 1), bool),
        }
        return Target(**of)


@functools.cache
def _initializer(policy: ActivePolicy, width: int) -> Any:
    """Compiled (key, ids, mask) → fresh variables, made once for all seeds."""
    fns = policy.fns

    def touch_all(module: Policy, ids: Array, mask: Array) -> Array:
        features = jax.tree.map(lambda x: jnp.asarray(x[0]), policy.prompt_features(1))
        state, _ = module.prefill_state(features, ids, mask, fns.slots)
        return module.logits(state + module.project(jnp.zeros((1, width)))[0], jnp.asarray(fns.banned))

    return jax.jit(lambda key, ids, mask: fns.module.init(key, ids, mask, method=touch_all))


def build_active_policy(
    actions: tuple[str, ...],
    decoder: DecoderConfig,
    *,
    attributes: tuple[Attribute, ...] = EXPLORED_ATTRIBUTES,
    repeats: bool = True,
) -> ActivePolicy:
    """Put language, tokenizer, prompts and Linen module together for the actions of an environment.

    Args:
      actions: the words of each (`Environment.actions`).
      decoder: sizes; the vocabulary comes from the language.
      attributes: those that are asked for; each needs a question in `QUESTIONS_OF_TOUCH`.
      repeats: whether a trajectory may contain an action twice; `False` suits actions that return the same again.

    Raises:
      ValueError: an attribute without a question, or as `compile_turns`.
    """
    language = TurnLanguage(actions=actions, attributes=attributes, repeats=repeats)
    tokenizer = turn_tokenizer(language)
    missing = [a.name for a in attributes if a.name not in QUESTIONS_OF_TOUCH]
    if missing:
        raise ValueError(f"attributes {missing} have no question; add them to QUESTIONS_OF_TOUCH")
    asked = [tokenizer.encode(QUESTIONS_OF_TOUCH[a.name]) for a in attributes]
    width = max(map(len, asked))
    padding = [width - len(ids) for ids in asked]
    config = PolicyConfig(
        tactile=TactileViTConfig(sensors=0),
        vision=VisionConfig(),
        decoder=dataclasses.replace(decoder, vocab_size=tokenizer.vocab_size),
    )
    turns = compile_turns(language, tokenizer)
    fns = ActiveFns(
        module=Policy(config),
        slots=Slots(np.zeros((0, 0), np.int32), np.zeros(0, np.int32), np.full(width, -1)),
        banned=tokenizer.banned,
        end_ids=tokenizer.end_ids,
        pad_id=tokenizer.pad_id,
        turns=turns,
        levels=level_tokens(language, tokenizer),
        constrained=False,
    )
    return ActivePolicy(
        language=language,
        tokenizer=tokenizer,
        turns=turns,
        ids=np.array([[tokenizer.pad_id] * m + ids for m, ids in zip(padding, asked, strict=True)], np.int32),
        mask=np.array([[False] * m + [True] * (width - m) for m in padding]),
        fns=fns,
    )
