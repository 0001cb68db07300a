"""A policy small enough to compile in a second or two: two sensors, frames of 28 × 56 px, widths of 16 to 24."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.policy import Features, Policy, PolicyConfig, Slots, init_policy
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.template import build_layout, prompt_words
from touchr1_jax.text.tokenizer import word_level
from touchr1_jax.types import Params, Target, TouchBatch

FRAMES, HEIGHT, WIDTH = 4, 28, 56
LANGUAGE = dataclasses.replace(TOUCH_LANGUAGE, sensors=TOUCH_LANGUAGE.sensors[:2])
TOKENIZER = word_level(LANGUAGE, prompt_words())
S, A, V = 2, 4, TOKENIZER.vocab_size
CONFIG = PolicyConfig(
    tactile=dataclasses.replace(
        TactileViTConfig(sensors=S), width=16, num_layers=1, num_heads=2, stem_width=4, frames_per_step=2
    ),
    vision=dataclasses.replace(VisionConfig(), image_px=16, patch_px=4, width=8),
    decoder=dataclasses.replace(
        DecoderConfig(vocab_size=V),
        hidden_size=24,
        num_layers=2,
        num_heads=4,
        num_kv_heads=2,
        head_dim=8,
        intermediate_size=32,
        mrope_section=(1, 1, 2),
    ),
)
N = FRAMES // CONFIG.tactile.frames_per_step * CONFIG.tactile.tokens_per_step
NV = CONFIG.vision.grid**2
LAYOUT = build_layout(TOKENIZER, LANGUAGE, tactile_tokens=N, view_tokens=NV)
SLOTS = Slots(LAYOUT.touch, LAYOUT.view, LAYOUT.stream_text)
L = LAYOUT.ids.shape[1]
WRITABLE = np.flatnonzero(~TOKENIZER.banned)
"""Ids that a completion may hold."""


def make_fns(config: PolicyConfig = CONFIG, slots: Slots = SLOTS) -> PolicyFns:
    """The tiny policy with its prompt layout."""
    return PolicyFns(
        module=Policy(config), slots=slots, banned=TOKENIZER.banned, end_ids=TOKENIZER.end_ids, pad_id=TOKENIZER.pad_id
    )


FNS = make_fns()


SHALLOW = make_fns(dataclasses.replace(CONFIG, decoder=dataclasses.replace(CONFIG.decoder, num_layers=1)))
"""One decoder layer, for programs that are slow to compile."""


def shallow_params(seed: int = 0, *, loud: float = 0.4) -> Params:
    """Parameters of the decoder of `SHALLOW`: those of the last layer of `params`."""
    decoder = params(seed, loud=loud)["decoder"]
    return {"decoder": {name: value for name, value in decoder.items() if name != "layers"}}


@functools.cache
def params(seed: int = 0, *, loud: float = 0.4) -> Params:
    """Loud parameters of `FNS`."""
    return draw_params(shapes(), seed, loud=loud)


@functools.cache
def shapes() -> Params:
    """Shapes of the parameters of `FNS`."""
    return jax.eval_shape(lambda: initialise(jax.random.key(0)))


def initialise(key: jax.Array) -> Params:
    """Parameters as `init_policy` makes them."""
    return init_policy(FNS.module, key, touch_batch(0), LAYOUT.ids[0], LAYOUT.mask[0], SLOTS)


def touch_batch(seed: int = 0, p: int = 1) -> TouchBatch:
    """P contacts of random pixels and forces, everything present."""
    rng = np.random.default_rng(seed)
    index = np.sort(rng.permuted(np.tile(np.arange(30), (p, S, 1)), axis=-1)[..., :FRAMES])
    return TouchBatch(
        frames=rng.integers(0, 256, (p, S, FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8),
        force_n=rng.normal(0, 5, (p, S, FRAMES, 3)).astype(np.float32),
        frame_index=index.astype(np.int32),
        frame_mask=np.ones((p, S, FRAMES), bool),
        stream_mask=np.ones((p, S), bool),
        view=rng.integers(0, 256, (p, 16, 16, 3), dtype=np.uint8),
        view_mask=np.ones(p, bool),
        label=rng.integers(0, 3, (p, A)).astype(np.int32),
    )


def features(seed: int = 0, p: int = 1) -> Features:
    """P encoded contacts made up without an encoder, everything present."""
    rng = np.random.default_rng(seed)
    width = CONFIG.decoder.hidden_size
    steps = np.sort(rng.permuted(np.tile(np.arange(30), (p, S, 1)), axis=-1)[..., : FRAMES // 2])
    return Features(
        touch=jnp.asarray(rng.normal(0, 1, (p, S, N, width)), jnp.float32),
        touch_time=jnp.asarray(np.repeat(steps, 2, -1), jnp.int32),
        stream_mask=jnp.ones((p, S), bool),
        view=jnp.asarray(rng.normal(0, 1, (p, NV, width)), jnp.float32),
        view_mask=jnp.ones(p, bool),
    )


@jax.jit
def copy(tree):
    """The same on buffers of its own, by one program rather than one for each shape."""
    return jax.tree.map(jnp.copy, tree)


def completions(seed: int, *shape: int) -> jax.Array:
    """Random writable tokens, int32 [*shape]."""
    return jnp.asarray(np.random.default_rng(seed).choice(WRITABLE, shape), jnp.int32)


def target(attribute: np.ndarray, label: np.ndarray) -> Target:
    """P single-attribute questions with their labels, int [P]."""
    asked = np.arange(A) == attribute[:, None]
    p = len(attribute)
    return Target(
        asked=jnp.asarray(asked),
        label=jnp.asarray(np.where(asked, label[:, None], -1), jnp.int32),
        levels=jnp.tile(jnp.array([3, 3, 3, 9]), (p, 1)),
        ordinal=jnp.tile(jnp.array([True, True, True, False]), (p, 1)),
        streams=jnp.ones((p, S), bool),
    )


def question_batch(seed: int = 0, p: int = 1) -> GRPOBatch:
    """P made-up contacts; question i asks for attribute i mod A, whose label is i mod 3."""
    attribute = np.arange(p) % A
    return GRPOBatch(
        features=features(seed, p),
        ids=jnp.asarray(LAYOUT.ids[attribute]),
        mask=jnp.asarray(LAYOUT.mask[attribute]),
        target=target(attribute, np.arange(p) % 3),
    )
