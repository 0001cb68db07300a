"""A bank of contacts and a policy that explores it, small enough that all of its trajectories can be listed."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.models.active_policy import ActivePolicy, build_active_policy
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.rl.environment import TouchBank, TouchCase, TouchChoice
from touchr1_jax.rl.trajectory import ActiveBatch
from touchr1_jax.text.language import FRICTION, HARDNESS
from touchr1_jax.types import Params

O, N, W, BUDGET = 4, 2, 8, 2  # noqa: E741
CHOICES = tuple(TouchChoice(sensor="xense", motion=motion, force_n=2.0) for motion in ("press", "slide"))
DECODER = DecoderConfig(
    vocab_size=0,
    hidden_size=32,
    num_layers=2,
    num_heads=2,
    num_kv_heads=1,
    head_dim=16,
    intermediate_size=32,
    mrope_section=(2, 3, 3),
)
POLICY, SHALLOW, ONCE = (
    build_active_policy(
        tuple(choice.words for choice in CHOICES),
        dataclasses.replace(DECODER, num_layers=layers),
        attributes=(HARDNESS, FRICTION),
        repeats=repeats,
    )
    for layers, repeats in ((2, True), (1, True), (2, False))
)
"""The policy, one with a single decoder layer for programs that are slow to compile, one that repeats no action."""

T = POLICY.tokens(BUDGET)


def make_bank(seed: int = 0) -> TouchBank:
    """Four objects of which the last lacks the slide; contacts are random."""
    rng = np.random.default_rng(seed)
    available = np.ones((O, 2), bool)
    available[-1, 1] = False
    return TouchBank(
        tokens=rng.normal(0, 1, (O, 2, N, W)).astype(np.float32),
        available=available,
        seconds=rng.uniform(1, 4, (O, 2)).astype(np.float32),
        harm=np.array([[0, 1]] * O, np.float32),
        label=rng.integers(0, 3, (O, 2)).astype(np.int32),
        choices=CHOICES,
    )


BANK = make_bank()


def batch_of(*objects: int) -> ActiveBatch:
    """Questions about some objects, for hardness and friction in turn; every choice is offered."""
    which, attribute = np.array(objects), np.arange(len(objects)) % 2
    return ActiveBatch(
        features=jax.tree.map(jnp.asarray, POLICY.prompt_features(len(which))),
        ids=jnp.asarray(POLICY.ids[attribute]),
        mask=jnp.asarray(POLICY.mask[attribute]),
        target=jax.tree.map(jnp.asarray, POLICY.target(attribute, BANK.label[which])),
        case=TouchCase(jnp.asarray(which, jnp.int32), jnp.ones((len(which), 2), bool)),
    )


@functools.cache
def params(policy: ActivePolicy = POLICY) -> Params:
    """Parameters that prefer no token by much and are far from uniform."""
    return draw_params(jax.eval_shape(lambda: policy.init(0, W)), loud=0.3)


def trajectories() -> list[tuple[tuple[int, ...], str]]:
    """Every legal trajectory: its actions and its answer."""
    found = []
    for count in range(BUDGET + 1):
        for actions in itertools.product(range(2), repeat=count):
            found += [(actions, word) for word in POLICY.language.words]
    return found


def turn_ids(actions: tuple[int, ...], word: str) -> list[list[int]]:
    """Token ids of each turn of a trajectory."""
    texts = [*map(POLICY.language.action_text, actions), POLICY.language.answer_text(word)]
    return [POLICY.tokenizer.encode(text) for text in texts]


def padded(turns: list[list[int]]) -> np.ndarray:
    """Tokens [T] of a trajectory."""
    tokens = np.full((BUDGET + 1, POLICY.turns.length), POLICY.tokenizer.pad_id, np.int32)
    for row, ids in zip(tokens, turns, strict=False):
        row[: len(ids)] = ids
    return tokens.reshape(-1)
