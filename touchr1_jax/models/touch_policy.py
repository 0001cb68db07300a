"""A policy with its language: from sizes to tokenizer, prompts, Linen module and parser.

policy = build_policy(ModelConfig(), sensors)
params = policy.init(seed, batch)
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from touchr1_jax.models.layers import SizeError, check_sizes
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.policy import Policy, PolicyConfig, init_policy
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.text.constraint import Constraint, compile_constraint
from touchr1_jax.text.language import TOUCH_LANGUAGE, Language
from touchr1_jax.text.parser import Parser, compile_parser
from touchr1_jax.text.template import QUESTIONS, LevelTokens, PromptLayout, build_layout, level_tokens, prompt_words
from touchr1_jax.text.tokenizer import Tokenizer, word_level
from touchr1_jax.types import Params, Target, TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchConfig:
    """Tactile input, its encoder, and the length of an answer; the number of sensors comes from the data."""

    tactile: TactileViTConfig = TactileViTConfig(sensors=0)
    frames: int = 4
    image_px: int = 112
    completion_tokens: int = 20

    def __post_init__(self) -> None:
        check_sizes(self, "frames", "image_px", "completion_tokens")

    @property
    def stream_tokens(self) -> int:
        """Tactile tokens of a stream."""
        return self.frames // self.tactile.frames_per_step * self.tactile.tokens_per_step


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelConfig(TouchConfig):
    """Sizes of all towers, 0.64 million parameters by default; the vocabulary comes from the language."""

    vision: VisionConfig = VisionConfig()
    decoder: DecoderConfig = DecoderConfig(vocab_size=0)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TouchPolicy:
    """Everything static about a policy; its parameters are always an argument.

    Attributes:
      model: sizes.
      language: attributes, levels and sensors that it speaks of.
      tokenizer, layout: of its prompts, one for each attribute.
      fns: forward passes.
      parser: reads an answer from its tokens, in-graph.
    """

    model: TouchConfig
    language: Language
    tokenizer: Tokenizer
    layout: PromptLayout
    fns: PolicyFns
    parser: Parser

    @property
    def frozen(self) -> tuple[str, ...]:
        """Towers whose weights no stage trains, except by adapters."""
        return ()

    @property
    def levels(self) -> tuple[int, ...]:
        """K of each attribute."""
        return tuple(len(a.levels) for a in self.language.attributes)

    @property
    def ordered(self) -> np.ndarray:
        """True where the answer to a question depends on the order of frames, bool [Q]."""
        return self.layout.asked @ np.array([a.ordered for a in self.language.attributes])

    @functools.cached_property
    def constraint(self) -> Constraint:
        """Grammar of formatted answers, for constrained sampling."""
        return compile_constraint(self.language, self.tokenizer)

    @functools.cached_property
    def level_tokens(self) -> LevelTokens:
        """Token of each level, for a conclusion that is enumerated or weighted.

        Raises:
          ValueError: a vocabulary that splits a level or a tag.
        """
        found = level_tokens(self.language, self.tokenizer)
        if found is None:
            raise ValueError(
                "this vocabulary writes a level or a tag in several tokens: each must be one token for a conclusion "
                "that is enumerated or weighted; leave enumerated None and conclusion_weight 1"
            )
        return found

    def init(self, seed: int, batch: TouchBatch) -> Params:
        """Fresh parameters for the shapes of a batch."""
        return self._init(jax.random.key(seed), batch)

    @functools.cached_property
    def _init(self) -> Callable[[Array, TouchBatch], Params]:
        """Compiled once for all seeds."""
        module, slots, layout = self.fns.module, self.fns.slots, self.layout
        return jax.jit(lambda key, batch: init_policy(module, key, batch, layout.ids[0], layout.mask[0], slots))

    def target(self, attribute: Int[np.ndarray, "n"], label: Int[np.ndarray, "n A"], streams: np.ndarray) -> Target:
        """Targets of single-attribute questions, on the host; labels of attributes that are not asked stay visible."""
        asked = self.layout.asked[attribute]
        of: dict[str, Any] = {
            "asked": asked,
            "label": label.astype(np.int32),
            "levels": np.tile(np.array(self.levels, np.int32), (len(asked), 1)),
            "ordinal": np.tile([a.ordinal for a in self.language.attributes], (len(asked), 1)),
            "streams": streams,
        }
        return Target(**of)


def build_policy(model: ModelConfig, sensors: tuple[str, ...]) -> TouchPolicy:
    """Put tokenizer, prompt layout, Linen module and parser together for a set of sensors.

    Raises:
      ValueError: a sensor that the language does not know.
    """
    language = language_of(sensors)
    return assemble_policy(model, language, word_level(language, prompt_words()))


def assemble_policy(
    model: ModelConfig, language: Language, tokenizer: Tokenizer, questions: Mapping[str, str] = QUESTIONS
) -> TouchPolicy:
    """The policy of a language, a vocabulary that has all of its words, and the question for each attribute."""
    config = PolicyConfig(
        tactile=dataclasses.replace(model.tactile, sensors=len(language.sensors)),
        vision=model.vision,
        decoder=dataclasses.replace(model.decoder, vocab_size=tokenizer.vocab_size),
    )
    prompt: dict[str, Any] = {"tactile_tokens": model.stream_tokens, "view_tokens": model.vision.grid**2}
    layout = build_layout(tokenizer, language, questions=questions, **prompt)
    return TouchPolicy(
        model=model,
        language=language,
        tokenizer=tokenizer,
        layout=layout,
        fns=PolicyFns.for_layout(Policy(config), layout, tokenizer),
        parser=compile_parser(language, tokenizer),
    )


P = TypeVar("P", bound=TouchPolicy)


def with_lora(policy: P, lora: LoraConfig) -> P:
    """The policy whose stages train adapters; rank 0 leaves it as it is."""
    return dataclasses.replace(policy, fns=dataclasses.replace(policy.fns, lora=lora)) if lora.rank else policy


def language_of(sensors: tuple[str, ...]) -> Language:
    """The language of touch with some of its sensors, in their order.

    Raises:
      ValueError: a sensor that the language does not know.
    """
    known = {s.name: s for s in TOUCH_LANGUAGE.sensors}
    unknown = [s for s in sensors if s not in known]
    if unknown:
        raise ValueError(f"sensors {unknown} are not in the language, which knows {', '.join(known)}; add them to it")
    return dataclasses.replace(TOUCH_LANGUAGE, sensors=tuple(known[s] for s in sensors))


def touch_shapes(model: TouchConfig, view: int, sensors: tuple[str, ...]) -> TouchBatch:
    """Shapes and types of a batch of one contact, whose object's picture has `view` rows and columns."""
    p, s, f, px = 1, len(sensors), model.frames, model.image_px
    of: dict[str, Any] = {
        "frames": ((p, s, f, px, px, 3), jnp.uint8),
        "force_n": ((p, s, f, 3), jnp.float32),
        "frame_index": ((p, s, f), jnp.int32),
        "frame_mask": ((p, s, f), bool),
        "stream_mask": ((p, s), bool),
        "view": ((p, view, view, 3), jnp.uint8),
        "view_mask": ((p,), bool),
        "label": ((p, len(TOUCH_LANGUAGE.attributes)), jnp.int32),
    }
    shapes: dict[str, Any] = {name: jax.ShapeDtypeStruct(*shape) for name, shape in of.items()}
    return TouchBatch(**shapes)


def check_model(model: ModelConfig, sensors: tuple[str, ...]) -> None:
    """Build a policy in shapes alone, so that contradictory sizes are reported before data are made.

    Raises:
      SizeError: sizes that contradict each other.
    """
    try:
        policy = build_policy(model, sensors)
        jax.eval_shape(functools.partial(policy.init, 0), touch_shapes(model, model.vision.image_px, sensors))
    except (ValueError, TypeError) as error:
        raise SizeError(f"no model can be built of these sizes: {error}") from error
