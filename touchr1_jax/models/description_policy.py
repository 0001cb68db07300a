"""The policy that answers for one touch or several: an encoder of descriptions in front of the decoder, its answers.

The prompt asks for hardness, roughness and protrusion at once, so that the answer is drawn from their joint
distribution: the decoder writes roughness knowing the hardness that it wrote.  All 27 answers can be scored, so the
answer is not sampled but chosen by its expected utility (`choose`).
"""

import dataclasses
import functools
import itertools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.policy import Features, Policy, PolicyConfig
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import TouchConfig, TouchPolicy
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.text.language import HARDNESS, PROTRUSION, ROUGHNESS, SENSORS, Language
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import answer_text, build_layout, encode_answer, prompt_words
from touchr1_jax.text.tokenizer import word_level
from touchr1_jax.types import Params

LANGUAGE = Language(attributes=(HARDNESS, ROUGHNESS, PROTRUSION), sensors=SENSORS[:1])
"""One GelSight Mini, three ordinal attributes."""

LEVELS = 3
COMBINATIONS = np.array(list(itertools.product(range(LEVELS), repeat=len(LANGUAGE.attributes))))
"""Every answer, int [27, A], in the order of `np.unravel_index`."""

LENGTH = 18
"""Tokens of an answer with its end: six tags, the sensor, three times three levels, the end, and one to spare."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyShape:
    """Sizes: the most touches that a prompt holds, tactile tokens of each, width of the encoder, decoder."""

    contacts: int = 1
    tokens: int = 4
    width: int = 96
    decoder: DecoderConfig = DecoderConfig(
        vocab_size=0, hidden_size=64, num_layers=1, num_heads=2, intermediate_size=128
    )


class DescriptionEncoder(nn.Module):
    """Tactile tokens of a description: x → W₂ gelu(W₁ x), cut into N tokens of the decoder's width."""

    shape: PolicyShape

    @nn.compact
    def __call__(self, x: Float[Array, "*n D"]) -> Float[Array, "*n N H"]:
        hidden = self.shape.decoder.hidden_size
        y = nn.gelu(nn.Dense(self.shape.width, name="in")(x))
        return nn.Dense(self.shape.tokens * hidden, name="out")(y).reshape(*x.shape[:-1], self.shape.tokens, hidden)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class DescriptionPolicy(TouchPolicy):
    """A policy whose encoder reads descriptions; its parameters are `{"encoder", "decoder"}`."""

    shape: PolicyShape

    def fresh(self, key: Array, inputs: int) -> Params:
        """Fresh parameters for descriptions of so many numbers."""
        encoder_key, decoder_key = jax.random.split(key)
        touches = jnp.zeros((self.shape.contacts, inputs))
        encoder = DescriptionEncoder(self.shape).init(encoder_key, touches)["params"]
        features = self.features({"encoder": encoder}, touches)
        banned = jnp.asarray(self.fns.banned)
        prompt = jnp.asarray(self.layout.ids[0]), jnp.asarray(self.layout.mask[0]), self.fns.slots, banned
        decoder = self.fns.module.init(decoder_key, features, *prompt, method=Policy.prefill)["params"]["decoder"]
        return {"encoder": encoder, "decoder": decoder}

    def features(self, params: Params, x: Float[Array, "*n C D"]) -> Features:
        """Decoder input from the touches of an object, of which those that are NaN do not exist.

        They are one stream in which all tokens of a touch share one time; no view.
        """
        lead, hidden = x.shape[:-2], self.shape.decoder.hidden_size
        exists = ~jnp.isnan(x[..., :1])
        touch = DescriptionEncoder(self.shape).apply({"params": params["encoder"]}, jnp.where(exists, x, 0.0))
        time = jnp.where(exists, jnp.arange(x.shape[-2])[:, None], -1)
        return Features(
            touch=jnp.asarray(touch).reshape(*lead, 1, -1, hidden),
            touch_time=jnp.repeat(time, self.shape.tokens, -1).reshape(*lead, 1, -1),
            stream_mask=jnp.ones((*lead, 1), bool),
            view=jnp.zeros((*lead, 0, hidden)),
            view_mask=jnp.zeros(lead, bool),
        )

    def log_probs(self, params: Params, x: Float[Array, "C D"], tokens: Int[Array, "G T"]) -> Float[Array, "G T"]:
        """Log-probability of every token of answers about one object."""
        ids, mask = jnp.asarray(self.layout.ids[0]), jnp.asarray(self.layout.mask[0])
        logits = self.fns.group_logits(params, self.features(params, x), ids, mask, tokens)
        return jnp.take_along_axis(jax.nn.log_softmax(logits), tokens[..., None], -1)[..., 0]

    @functools.cached_property
    def slots(self) -> np.ndarray:
        """Positions of the levels in an answer, int [2, A]: in `perceive`, in `conclude`."""
        first, *others = (self.answer(np.full(3, a), np.full(3, b))[0] for a, b in ((0, 0), (1, 0), (0, 1)))
        perceived, concluded = (np.flatnonzero(first != other) for other in others)
        return np.stack([perceived[: len(concluded)], concluded])

    def answer(self, perceive: np.ndarray, conclude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tokens of an answer and the mask of those that count, [T] each; with one sensor `compare` is `perceive`."""
        streams = np.ones(1, bool)
        asked = np.ones(len(LANGUAGE.attributes), bool)
        text = answer_text(
            LANGUAGE, asked=asked, streams=streams, perceive=perceive[None], compare=perceive, conclude=conclude
        )
        return encode_answer(self.tokenizer, text, LENGTH)

    @functools.cached_property
    def answers(self) -> np.ndarray:
        """Every answer to every percept, int32 [27, 27, T]."""
        return np.array([[self.answer(p, c)[0] for c in COMBINATIONS] for p in COMBINATIONS], np.int32)

    @functools.cached_property
    def posterior(self) -> Any:
        """Compiled (params of M members, x [n, C, D]) → log-probabilities of the conclusions [n, 27].

        The members' log-probabilities are averaged; those of the conclusions follow the most likely percept.
        """
        answers, (perceive, conclude) = jnp.asarray(self.answers), self.slots
        same = jnp.arange(len(COMBINATIONS))

        def scored(params: Params, x: Array, tokens: Array, slots: np.ndarray) -> Array:
            each = jax.vmap(self.log_probs, in_axes=(0, None, None))(params, x, tokens)
            return jnp.mean(jnp.sum(each[..., slots], -1), 0)

        def one(params: Params, x: Float[Array, "C D"]) -> Array:
            percept = jnp.argmax(scored(params, x, answers[same, same], perceive))
            return jax.nn.log_softmax(scored(params, x, answers[percept], conclude))

        return jax.jit(lambda params, x: jax.lax.map(lambda row: one(params, row), x, batch_size=16))


@functools.cache
def description_policy(shape: PolicyShape) -> DescriptionPolicy:
    """Tokenizer, prompt, decoder and parser of one question about one sensor; made once, as are its programs."""
    tokenizer = word_level(LANGUAGE, prompt_words())
    asked = [[attribute.name for attribute in LANGUAGE.attributes]]
    layout = build_layout(tokenizer, LANGUAGE, tactile_tokens=shape.contacts * shape.tokens, view_tokens=0, asked=asked)
    config = PolicyConfig(
        tactile=TactileViTConfig(sensors=1, tokens_per_step=shape.tokens),
        vision=VisionConfig(),
        decoder=dataclasses.replace(shape.decoder, vocab_size=tokenizer.vocab_size),
    )
    return DescriptionPolicy(
        model=TouchConfig(completion_tokens=LENGTH),
        language=LANGUAGE,
        tokenizer=tokenizer,
        layout=layout,
        fns=PolicyFns.for_layout(Policy(config), layout, tokenizer),
        parser=compile_parser(LANGUAGE, tokenizer),
        shape=shape,
    )


def choose(log_prob: Float[np.ndarray, "n 27"]) -> Int[np.ndarray, "n A"]:
    """Levels of the answer with the highest expected utility, argmax_y Σ_t p(t) u(y, t)."""
    return COMBINATIONS[(np.exp(log_prob) @ utility().T).argmax(-1)]


def utility() -> Float[np.ndarray, "27 27"]:
    """u(y, t) = 1[y = t] + mean 1[y_a = t_a] − mean |y_a − t_a|: the reported scores, each with weight 1."""
    distance = np.abs(COMBINATIONS[:, None] - COMBINATIONS[None])
    return (distance == 0).all(-1) + (distance == 0).mean(-1) - distance.mean(-1)
