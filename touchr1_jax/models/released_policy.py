"""A policy on released weights: its sizes, its prompts in the chat template, and its forward passes."""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from touchr1_jax.models.layers import SizeError, check_sizes
from touchr1_jax.models.load import Checkpoint
from touchr1_jax.models.qwen.policy import QwenViewConfig, init_on_pretrained, qwen_fns, qwen_policy
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import TouchConfig, TouchPolicy, language_of
from touchr1_jax.text.chat import FRAMES_PER_SECOND, build_chat_layout, timestamps
from touchr1_jax.text.language import Language
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import answer_text
from touchr1_jax.text.tokenizer import Tokenizer
from touchr1_jax.types import Params, TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReleasedModel(TouchConfig):
    """Sizes of touch, picture and answer next to released towers, and the type of these towers' weights."""

    tactile: TactileViTConfig = TactileViTConfig(
        sensors=0, width=384, num_layers=8, num_heads=6, mlp_ratio=4, tokens_per_step=4
    )
    frames: int = 8
    image_px: int = 224
    completion_tokens: int = 96
    view_px: int = 224
    """Rows and columns of the object's picture; the released vision towers make one token of 28² or 32² pixels."""
    dtype: Literal["bfloat16", "float32"] = "bfloat16"
    four_bits: bool = False
    """Hold the kernels of the decoder's layers in four bits (`models.nf4`), under adapters: QLoRA."""
    in_order: bool = False
    """Number a prompt's tokens one by one, as a server does that draws rollouts from their embeddings alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_sizes(self, "view_px")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ReleasedPolicy(TouchPolicy):
    """A policy whose vision tower and decoder are a checkpoint's."""

    model: ReleasedModel
    checkpoint: Checkpoint

    @property
    def frozen(self) -> tuple[str, ...]:
        """The released towers."""
        return ("vision", "decoder")

    def init(self, seed: int, batch: TouchBatch) -> Params:
        """The released towers as they are, and a fresh tactile encoder."""
        prompt = self.layout.ids[0], self.layout.mask[0], self.fns.slots
        return init_on_pretrained(self.fns.module, jax.random.key(seed), batch, *prompt, self.checkpoint.params)

    def check(self, batch: TouchBatch) -> None:
        """Build the parameters of a batch's shapes abstractly, so that contradicting sizes show before data are made.

        Raises:
          SizeError: sizes contradict each other.
        """
        try:
            jax.eval_shape(functools.partial(self.init, 0), batch)
        except (ValueError, TypeError) as error:
            raise SizeError(f"no policy can be built of these sizes: {error}") from error


def instruction(language: Language) -> str:
    """The system prompt: the form of an answer and the words for every level, such as

    Answer about the touch as <perceive> SENSOR LEVEL … </perceive> <compare> LEVEL </compare> …
    """
    perceive, compare, conclude = language.tags
    levels = "; ".join(f"{a.name}: {', '.join(level[0] for level in a.levels)}" for a in language.attributes)
    return (
        f"Answer about the touch as <{perceive}> SENSOR LEVEL ... </{perceive}> <{compare}> LEVEL </{compare}> "
        f"<{conclude}> LEVEL </{conclude}>. Levels are {levels}."
    )


def build_released_policy(model: ReleasedModel, found: Checkpoint, sensors: tuple[str, ...]) -> ReleasedPolicy:
    """Combine a checkpoint, prompts in its chat template and a tactile encoder for a set of sensors.

    Raises:
      SizeError: completions that are too short for an answer.
      ValueError: a sensor that the language does not know.
    """
    language = language_of(sensors)
    need = longest_answer(language, found.tokenizer)
    if model.completion_tokens < need:
        raise SizeError(
            f"model.completion_tokens is {model.completion_tokens}: the longest answer takes {need} tokens of this "
            "tokenizer; raise it, and grpo.length with it"
        )
    tactile = dataclasses.replace(model.tactile, sensors=len(sensors))
    view_px = (model.view_px, model.view_px)
    policy = qwen_policy(found.config, tactile, view_px, found.budget, in_order=model.in_order)
    view = policy.config.vision
    assert isinstance(view, QwenViewConfig)
    as_text = found.config.vision.model_type == "qwen3_vl"
    layout = build_chat_layout(
        found.tokenizer,
        language,
        tactile_tokens=model.stream_tokens,
        view_tokens=view.tokens,
        system=instruction(language),
        times=timestamps(range(model.frames), FRAMES_PER_SECOND, tactile.frames_per_step) if as_text else (),
    )
    return ReleasedPolicy(
        model=model,
        language=language,
        tokenizer=found.tokenizer,
        layout=layout,
        fns=qwen_fns(policy, layout, found.tokenizer, jnp.dtype(model.dtype)),
        parser=compile_parser(language, found.tokenizer),
        checkpoint=found,
    )


def longest_answer(language: Language, tokenizer: Tokenizer) -> int:
    """Tokens of the longest answer to a question for one attribute, the end token included."""
    return max(len(tokenizer.encode(text)) + 1 for text in plain_answers(language))


def plain_answers(language: Language) -> Iterator[str]:
    """For each level of each attribute the answer that gives it in every slot, with all sensors."""
    sensors, attributes = len(language.sensors), len(language.attributes)
    for a, attribute in enumerate(language.attributes):
        for level in range(len(attribute.levels)):
            yield answer_text(
                language,
                asked=np.arange(attributes) == a,
                streams=np.ones(sensors, bool),
                perceive=np.full((sensors, attributes), level),
                compare=np.full(attributes, level),
                conclude=np.full(attributes, level),
            )
