"""A simulated world of touch with known truth, and a policy that is small enough to be trained a thousand times.

An object has a hardness and an elasticity, each on three levels.  Two sensors touch it for two time steps: sensor s
observes z_s = y + σ ε_s of each property y.  Both steps show the same hardness; only the order of the steps shows
elasticity, as a ramp that rises (0), stays (1) or falls (2).  A view shows the right level with probability `sight`,
otherwise a random one.  Answers use the library's language and parser.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.policy import Features, Policy, PolicyConfig
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.text.language import HARDNESS, TOUCH_LANGUAGE, Attribute
from touchr1_jax.text.parser import Parser, compile_parser
from touchr1_jax.text.template import build_layout
from touchr1_jax.text.tokenizer import word_level
from touchr1_jax.types import Target

ELASTICITY = Attribute(name="elasticity", levels=(("stiff",), ("springy",), ("elastic",)), ordered=True)
QUESTIONS = {"hardness": "how hard is it", "elasticity": "how elastic is it"}
LANGUAGE = dataclasses.replace(TOUCH_LANGUAGE, attributes=(HARDNESS, ELASTICITY), sensors=TOUCH_LANGUAGE.sensors[:2])
TOKENIZER = word_level(LANGUAGE, tuple(QUESTIONS.values()))
LAYOUT = build_layout(TOKENIZER, LANGUAGE, tactile_tokens=2, view_tokens=1, questions=QUESTIONS)
PARSER: Parser = compile_parser(LANGUAGE, TOKENIZER)
S, STEPS, A, K = len(LANGUAGE.sensors), 2, len(LANGUAGE.attributes), 3
LENGTH = 15  # tokens of an answer with two levels in its conclusion and its end, and one more

DECODER = DecoderConfig(
    vocab_size=TOKENIZER.vocab_size,
    hidden_size=24,
    num_layers=1,
    num_heads=4,
    num_kv_heads=2,
    head_dim=8,
    intermediate_size=48,
    mrope_section=(1, 1, 2),
)
TACTILE = TactileViTConfig(sensors=S, width=8, num_layers=0, num_heads=1, tokens_per_step=1)
MODULE = Policy(PolicyConfig(tactile=TACTILE, vision=VisionConfig(image_px=32), decoder=DECODER))
FNS = PolicyFns.for_layout(MODULE, LAYOUT, TOKENIZER)

_BASIS = np.linalg.qr(np.random.default_rng(0).normal(size=(DECODER.hidden_size,) * 2))[0].astype(np.float32)
LEVEL, RAMP, SENSOR, SIGHT, HOLE = np.split(_BASIS[: 2 * K + S + 2], [K, K + 1, K + 1 + S, 2 * K + 1 + S])
"""Directions [n, D] of the levels of hardness, the ramp, the sensors, the levels in view, and a broken stream."""

BUMP = 0.5  # width of a level's response to evidence, in levels
GRAIN = 0.1  # standard deviation of the noise of a channel
Scalar = Any  # a number or a traced scalar


class World(NamedTuple):
    """Properties of objects, sensors and supervised answers; numbers or traced scalars.

    Attributes:
      noise: σ of a sensor's evidence, in levels.
      sight: probability that the view shows the right level.
      asked: attribute of the question, 0 hardness or 1 elasticity.
      tick: time id of the second step; that of the first is 0.
      kept: share of the second sensor's touch that reaches the policy; the rest is one constant token.
      anchored: share of supervised answers that conclude what the view shows.
      sloppy: share of supervised answers with two levels in their conclusion.
      sharp: factor on the logits of the supervised policy.
    """

    noise: Scalar = 0.5
    sight: Scalar = 0.5
    asked: Scalar = 0
    tick: Scalar = 15
    kept: Scalar = 1.0
    anchored: Scalar = 0.0
    sloppy: Scalar = 0.05
    sharp: Scalar = 1.0


class WorldBatch(NamedTuple):
    """P questions, the true level, the sensors' evidence of it in levels, and the level in view."""

    batch: GRPOBatch
    level: Int[Array, "P"]
    evidence: Float[Array, "P S"]
    seen: Int[Array, "P"]


def draw(world: World, key: Array, p: int) -> WorldBatch:
    """P random objects, touched, seen and asked about."""
    keys = jax.random.split(key, 5)
    level = jax.random.randint(keys[0], (p, A), 0, K)
    evidence = level[:, None] + world.noise * jax.random.normal(keys[1], (p, S, A))
    asked = jnp.asarray(world.asked)
    y = level[:, asked]
    shown = jax.random.uniform(keys[2], (p,)) < world.sight
    seen = jnp.where(shown, y, jax.random.randint(keys[3], (p,), 0, K))
    features = Features(
        touch=touch_tokens(world, evidence, keys[4]),
        touch_time=jnp.broadcast_to(jnp.stack([jnp.zeros((), jnp.int32), jnp.asarray(world.tick)]), (p, S, STEPS)),
        stream_mask=jnp.ones((p, S), bool),
        view=2 * jnp.asarray(SIGHT)[seen][:, None],
        view_mask=jnp.ones(p, bool),
    )
    chosen = jnp.broadcast_to(jnp.arange(A) == asked, (p, A))
    target = Target(
        asked=chosen,
        label=jnp.where(chosen, y[:, None], -1),
        levels=jnp.full((p, A), K),
        ordinal=jnp.ones((p, A), bool),
        streams=jnp.ones((p, S), bool),
    )
    of_question = lambda x: jnp.broadcast_to(jnp.asarray(x)[asked], (p, *np.shape(x)[1:]))
    ordered = of_question([a.ordered for a in LANGUAGE.attributes])
    batch = GRPOBatch(
        features=features, ids=of_question(LAYOUT.ids), mask=of_question(LAYOUT.mask), target=target, ordered=ordered
    )
    return WorldBatch(batch, y, evidence[..., asked], seen)


def touch_tokens(world: World, evidence: Float[Array, "P S A"], key: Array) -> Float[Array, "P S N D"]:
    """The sensors' tokens for their evidence, one a step."""
    p = evidence.shape[0]
    response = jnp.exp(-0.5 * ((evidence[..., :1] - jnp.arange(K)) / BUMP) ** 2)
    ramp = (1 - evidence[..., 1])[..., None, None] * jnp.array([[-1.0], [1.0]]) * jnp.asarray(RAMP)
    steady = response @ jnp.asarray(LEVEL) + jnp.asarray(SENSOR)
    grain = GRAIN * jax.random.normal(key, (p, S, STEPS, DECODER.hidden_size))
    return broken(world, steady[..., None, :] + ramp + grain)


def broken(world: World, touch: Float[Array, "*n S N D"]) -> Float[Array, "*n S N D"]:
    """Touch as the policy receives it: of the last stream only the share `kept`."""
    kept = jnp.where(jnp.arange(S) == S - 1, world.kept, 1.0)[:, None, None]
    return kept * touch + (1 - kept) * 2 * jnp.asarray(HOLE[0])


def noise_bank(world: World, key: Array, draws: int = 32, probe: int = 256) -> Float[Array, "K S N D"]:
    """Encoded noise, N(μ, σ²) at each sensor's statistics per channel, through the same broken path."""
    touch_key, noise_key = jax.random.split(key)
    whole = world._replace(kept=1.0)
    touch = draw(whole, touch_key, probe).batch.features.touch
    mean, std = jnp.mean(touch, (0, 2)), jnp.std(touch, (0, 2))
    noise = jax.random.normal(noise_key, (draws, S, STEPS, DECODER.hidden_size))
    return broken(world, mean[:, None] + std[:, None] * noise)


WORDS = np.array([[TOKENIZER.encode(words[0])[0] for words in a.levels] for a in LANGUAGE.attributes])
"""Token of each level of each attribute, [A, K]."""
(CONCLUDE,) = TOKENIZER.encode("<conclude>")


def verified_answers(world: World, scene: WorldBatch, key: Array) -> tuple[Int[Array, "P T"], Array]:
    """Answers for supervised training, and the tokens that count, both [P, T].

    Each slot names its own evidence; the conclusion is the label, or the level in view, or, if sloppy, two levels.
    """
    p = scene.level.shape[0]
    anchor_key, slop_key = jax.random.split(key)
    words = jnp.asarray(WORDS)[jnp.asarray(world.asked)]
    nearest = lambda z: words[jnp.clip(jnp.round(z), 0, K - 1).astype(jnp.int32)]
    slots = [nearest(scene.evidence[:, s]) for s in range(S)]
    anchored = jax.random.uniform(anchor_key, (p,)) < world.anchored
    level = jnp.where(anchored, scene.seen, scene.level)
    sloppy = jax.random.uniform(slop_key, (p,)) < world.sloppy
    first, second = words[level], words[(level + 1) % K]
    fixed = lambda text: [jnp.full(p, i) for i in TOKENIZER.encode(text)]
    perceive = [x for s, slot in zip(LANGUAGE.sensors, slots, strict=True) for x in (*fixed(s.phrases[0]), slot)]
    compare = nearest(jnp.mean(scene.evidence, 1))
    head = [*fixed("<perceive>"), *perceive, *fixed("</perceive> <compare>"), compare, *fixed("</compare> <conclude>")]
    end, pad = jnp.full(p, FNS.end_ids[0]), jnp.full(p, FNS.pad_id)
    (close,) = fixed("</conclude>")
    tidy, loose = jnp.stack([*head, first, close, end, pad], -1), jnp.stack([*head, first, second, close, end], -1)
    tokens = jnp.where(sloppy[:, None], loose, tidy).astype(jnp.int32)
    tokens = jnp.pad(tokens, ((0, 0), (0, LENGTH - tokens.shape[1])), constant_values=FNS.pad_id)
    return tokens, tokens != FNS.pad_id
