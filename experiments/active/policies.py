"""Policies that choose: warm start on random touches, GRPO on whole trajectories, evaluation."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.active.encoder import DrawnFeed
from experiments.active.plans import Answer, Played
from experiments.core.context import Context
from experiments.core.loops import stage_hooks
from experiments.study.alarm_log import alarm_log
from touchr1_jax.models.active_policy import ActivePolicy, Explored
from touchr1_jax.rl.active import make_explore
from touchr1_jax.rl.active_alarms import ACTIVE_RULES
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.environment import TouchBank
from touchr1_jax.rl.touch_reward import Prices
from touchr1_jax.training.exploration import (
    NO_CHOICE,
    ActiveFeed,
    RandomTouchFeed,
    WrittenTurns,
    demonstration,
    observed,
    touch_batch_of,
    train_active,
)
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.sft import SFTBatch
from touchr1_jax.training.train_sft import SFTConfig, train_sft
from touchr1_jax.types import Params

ROWS = 256  # trajectories that are scored at once


def part_of(bank: TouchBank, objects: Int[np.ndarray, "n"]) -> TouchBank:
    """The contacts of some objects."""
    rows = {name: getattr(bank, name)[objects] for name in ("tokens", "available", "seconds", "harm", "label")}
    return dataclasses.replace(bank, **rows)


def warm_up(
    policy: ActivePolicy,
    bank: TouchBank,
    contacts: int,
    config: SFTConfig,
    context: Context,
    stage: str,
    seed: int,
) -> Params:
    """SFT of a fresh policy on up to so many touches drawn at random, which ends in the right answer."""
    feed = RandomTouchFeed(policy, bank, budget=contacts, batch_size=config.batch_size, seed=seed)
    with stage_hooks(context, stage, config.steps) as hooks:
        return train_sft(policy, policy.init(seed, bank.tokens.shape[-1]), feed, config, hooks, seed=seed)


def imitate(
    policy: ActivePolicy,
    params: Params,
    bank: TouchBank,
    choice: Int[np.ndarray, "n A"],
    config: SFTConfig,
    context: Context,
    stage: str,
    seed: int,
) -> Params:
    """SFT on trajectories of one given touch for each object of a bank and question, and the right answer."""
    written, of_host = WrittenTurns.of(policy), jax.device_get(bank)

    def make(rng: np.random.Generator) -> SFTBatch:
        which, question = (rng.integers(n, size=config.batch_size) for n in of_host.label.shape)
        return demonstration(policy, written, of_host, which, question, choice[which, question][:, None])

    with stage_hooks(context, stage, config.steps) as hooks:
        return train_sft(policy, params, DrawnFeed(make, seed), config, hooks, seed=seed)


def reinforce(
    policy: ActivePolicy,
    params: Params,
    bank: TouchBank,
    config: GRPOConfig,
    budget: int,
    prices: Prices,
    dropout: float,
    steps: int,
    context: Context,
    stage: str,
    seed: int,
) -> Params:
    """GRPO on trajectories about the objects of a bank; alarms are logged and printed once each.

    The length of a step follows from the budget; a sensor or a motion drops out of a prompt with probability `dropout`.
    """
    config = dataclasses.replace(config, length=policy.tokens(budget))
    loop = LoopConfig(steps=steps, save_every=max(1, steps))
    feed = ActiveFeed(policy, bank, batch_size=config.drawn, seed=seed, dropout=dropout)
    make_log = functools.partial(alarm_log, rules=ACTIVE_RULES)
    with stage_hooks(context, stage, loop.steps, make_log=make_log) as hooks:
        return train_active(policy, params, feed, bank, config, loop, hooks, prices=prices, budget=budget, seed=seed)


def explore(
    policy: ActivePolicy,
    params: Params,
    bank: TouchBank,
    objects: Int[np.ndarray, "n"],
    budget: int,
) -> Played:
    """Greedy trajectories of a policy about every question of some objects."""
    label = np.asarray(bank.label)
    questions = label.shape[1]
    rows, asked = np.repeat(objects, questions), np.tile(np.arange(questions), len(objects))
    walk = _explorer(policy, budget)
    parts = []
    for start in range(0, len(rows), ROWS):
        at = np.minimum(np.arange(start, start + ROWS), len(rows) - 1)  # one shape, one program
        batch = touch_batch_of(policy, bank, rows[at], asked[at])
        found = jax.device_get(walk(params, bank, batch, jax.random.key(0)))
        parts.append((found.action[:, 0], found.parsed.conclude[:, 0], found.seconds[:, 0], found.harm[:, 0]))
    action, level, seconds, harm = (np.concatenate(x)[: len(rows)] for x in zip(*parts, strict=True))
    right = level[np.arange(len(rows)), asked] == label[rows, asked]
    shaped = lambda x: x.reshape(len(objects), questions, *x.shape[1:])
    return Played(
        shaped(right.astype(float)), shaped(seconds.astype(float)), shaped(harm.astype(float)), shaped(action)
    )


@functools.cache
def _explorer(policy: ActivePolicy, budget: int) -> Any:
    """Compiled greedy trajectories."""
    return make_explore(policy.constrained_fns, budget)


def answerer(policy: ActivePolicy, params: Params, bank: TouchBank) -> Answer:
    """The levels that a policy believes in after given contacts, as if it had chosen to stop there."""
    written = WrittenTurns.of(policy)

    def answer(objects: np.ndarray, questions: np.ndarray, choices: np.ndarray) -> np.ndarray:
        found = np.empty((len(objects), written.answers.shape[1]), np.float32)
        for question in np.unique(questions):
            of_question = np.flatnonzero(questions == question)
            for start in range(0, len(of_question), ROWS):
                rows = of_question[start : start + ROWS]
                at = rows[np.minimum(np.arange(ROWS), len(rows) - 1)]
                found[rows] = _levels(policy, params, bank, written, objects[at], int(question), choices[at])[
                    : len(rows)
                ]
        return found

    return answer


def single_beliefs(
    answer: Answer, objects: Int[np.ndarray, "n"], questions: int, choices: int
) -> Float[np.ndarray, "n C A K"]:
    """A policy's beliefs after each single contact."""
    o, c, a = (x.ravel() for x in np.meshgrid(objects, np.arange(choices), np.arange(questions), indexing="ij"))
    found = answer(o, a, c[:, None].astype(np.int32))
    return found.reshape(len(objects), choices, questions, -1)


def _levels(
    policy: ActivePolicy,
    params: Params,
    bank: TouchBank,
    written: WrittenTurns,
    objects: np.ndarray,
    question: int,
    choices: np.ndarray,
) -> Float[np.ndarray, "n K"]:
    """Log-probabilities of the levels of one question."""
    zeros = np.zeros(len(objects), np.int32)
    tokens = written.trajectories(choices, zeros + question, zeros)
    word = np.argmax(written.answers[question, 0] != written.answers[question, 1])  # where answers differ
    at = (choices != NO_CHOICE).sum(1) * written.actions.shape[1] + word
    touch, exists = map(jnp.asarray, observed(bank, objects, choices))
    seen = Explored(jax.tree.map(lambda x: x[0], policy.prompt_features(1)), touch, exists, jnp.ones(1, bool))
    ids = written.answers[question, :, word]
    return np.asarray(
        _level_log_probs(policy.fns, params, seen, policy.ids[question], policy.mask[question], tokens, at, ids)
    )


@functools.partial(jax.jit, static_argnums=0)
def _level_log_probs(
    fns: Any, params: Params, seen: Explored, ids: Array, mask: Array, tokens: Array, at: Array, words: Array
) -> Array:
    states, _ = fns.group_states(params, seen, ids, mask, tokens)
    states = jnp.take_along_axis(states, at[:, None, None], 1)[:, 0]
    return jax.nn.log_softmax(fns.logits(params, states)[:, words])
