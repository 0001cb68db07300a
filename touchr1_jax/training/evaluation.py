"""Greedy and sampled answers of a policy to every question about some contacts, and the reward that each earns."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rewards import make_rewards, total_reward
from touchr1_jax.rewards.base import GROUP, Decode
from touchr1_jax.rl.rollout import GreedyAnswers, GRPOBatch, SampleConfig, make_answer, sample_group
from touchr1_jax.text.template import level_tokens
from touchr1_jax.training.questions import equal_blocks, labelled_questions, question_batch
from touchr1_jax.types import Params, Parsed

EVAL_BATCH = 64
"""Questions that are answered at once."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Greedy answers to every labelled question about some contacts; question n is about contact `contact[n]`.

    Attributes:
      contact, attribute, streams: the question, and the streams that were shown.
      tokens, parsed: the answer.
      label: −1 where not asked.
      truth: level of every attribute, −1 unknown, which rewards see; `None` where only `label` was kept.
      alone: conclusions of the policy that is shown each stream alone; `None` where it was not asked so.
      sampled: conclusions of n answers sampled at temperature 1 with all streams; `None` where none was.
      marginal: p(level | prompt), the mean over the sampled traces of p(level | trace) right after `conclude` opens,
        normalised over levels; where the tokenizer splits levels it is the share of the samples that conclude one.
    """

    contact: Int[np.ndarray, "N"]
    attribute: Int[np.ndarray, "N"]
    streams: Bool[np.ndarray, "N S"]
    tokens: Int[np.ndarray, "N T"]
    parsed: Parsed
    label: Int[np.ndarray, "N A"]
    alone: Int[np.ndarray, "N S A"] | None
    truth: Int[np.ndarray, "N A"] | None = None
    sampled: Int[np.ndarray, "N n A"] | None = None
    marginal: Float[np.ndarray, "N K"] | None = None


def evaluate_policy(
    policy: TouchPolicy,
    params: Params,
    features: Features,
    label: Int[np.ndarray, "n A"],
    *,
    alone: bool = True,
    samples: int = 0,
    batch_size: int = EVAL_BATCH,
    answer: Callable[[Params, GRPOBatch], GreedyAnswers] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Evaluation:
    """Ask every labelled question about every contact with all streams, and with each stream alone.

    Args:
      policy, params: of whom is asked.
      features: of the contacts, from `encoding.encode_contacts`.
      label: −1 for unknown, which is not asked about.
      alone: ask with each stream alone too, where there are several.
      samples: answers to each question that are sampled as well, with all streams.
      batch_size: questions that are answered at once.
      answer: from (decoder, questions) to answers; by default the policy's own (`answer_program`).
      progress: receives how many of how many answers are done.
    """
    contact, attribute = labelled_questions(label)
    present = np.asarray(features.stream_mask)[contact]
    s = present.shape[1]
    shown = [present]
    if alone and present.any() and s > 1:
        shown += [present & (np.arange(s) == i) for i in range(s)]
    answer, decoder = answer or answer_program(policy), {"decoder": params["decoder"]}
    rounds: list[tuple[np.ndarray, Callable[[GRPOBatch, int], Any]]]
    rounds = [(streams, lambda batch, block: answer(decoder, batch)) for streams in shown]
    if samples:
        draw, key = sample_program(policy, samples), jax.random.key(0)
        rounds.append((present, lambda batch, block: draw(decoder, batch, jax.random.fold_in(key, block))))
    found, done = [], 0
    progress(0, len(rounds) * len(contact))
    for streams, ask in rounds:
        blocks = []
        for block, (rows, real) in enumerate(equal_blocks(len(contact), batch_size)):
            batch = question_batch(policy, features, label, contact[rows], attribute[rows], streams[rows])
            blocks.append(jax.tree.map(lambda x, n=real: np.asarray(x)[:n], ask(batch, block)))
            done += real
            progress(done, len(rounds) * len(contact))
        found.append(jax.tree.map(lambda *x: np.concatenate(x), *blocks))
    sampled, marginal = found.pop() if samples else (None, None)
    together, *each_alone = found
    return Evaluation(
        contact=contact,
        attribute=attribute,
        streams=present,
        tokens=together.tokens,
        parsed=together.parsed,
        label=np.where(policy.layout.asked[attribute], label[contact], -1),
        alone=np.stack([x.parsed.conclude for x in each_alone], 1) if each_alone else None,
        truth=label[contact],
        sampled=sampled,
        marginal=marginal,
    )


@functools.cache
def answer_program(policy: TouchPolicy, *, constrained: bool = False) -> Any:
    """Compiled greedy decoder and parser, made once; a constrained one writes formatted answers alone."""
    grammar = policy.constraint if constrained else None
    return make_answer(policy.fns, policy.parser, policy.model.completion_tokens, grammar)


@functools.cache
def sample_program(policy: TouchPolicy, samples: int, *, constrained: bool = False) -> Any:
    """Compiled sampler, (params, questions, key) → conclusions [P, samples, A] and marginal [P, K], made once.

    A constrained one draws only formatted answers, so that the marginal sums to 1.
    """
    fns, length = policy.fns, policy.model.completion_tokens
    grammar = policy.constraint if constrained else None
    draw = SampleConfig(group=samples, length=length, end_ids=fns.end_ids, pad_id=fns.pad_id, constraint=grammar)
    known = level_tokens(policy.language, policy.tokenizer)

    def of_prompt(params: Params, batch: GRPOBatch, tokens: jax.Array, level: jax.Array) -> jax.Array:
        a = jnp.argmax(batch.target.asked)
        if known is None:
            share = jax.nn.one_hot(level[:, a], max(policy.levels))
        else:
            at = jnp.argmax(tokens == known.opens, -1) + 1
            states = fns.group_states(params, batch.features, batch.ids, batch.mask, tokens)[0]
            chosen = jnp.take_along_axis(states, jnp.minimum(at, length - 1)[:, None, None], 1)[:, 0]
            ids = jnp.asarray(known.level)[a]
            p = jax.nn.softmax(jnp.where(ids >= 0, fns.logits(params, chosen)[:, ids], -jnp.inf))
            share = jnp.where(((at > 1) & (at < length))[:, None], p, 0.0)
        return jnp.mean(share, 0)

    @jax.jit
    def sample(params: Params, batch: GRPOBatch, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        tokens = sample_group(fns, params, batch, key, draw).tokens
        level = jax.vmap(jax.vmap(policy.parser))(tokens).conclude
        return level, jax.vmap(of_prompt, in_axes=(None, 0, 0, 0))(params, batch, tokens, level)

    return sample


def reward_terms(
    policy: TouchPolicy, evaluation: Evaluation, weights: Mapping[str, float], prior: Float[np.ndarray, "A K"]
) -> dict[str, Float[np.ndarray, "N"]]:
    """The part of each weighted reward in the total of each answer.

    Args:
      policy: who answered.
      evaluation: the answers.
      weights: of the rewards.
      prior: share of each level among the training labels.
    """
    truth = evaluation.label if evaluation.truth is None else evaluation.truth
    target = policy.target(evaluation.attribute, truth, evaluation.streams)
    score = reward_program(tuple(weights.items()), prior.tobytes(), prior.shape, policy.tokenizer.decode)
    groups_of_one = jax.tree.map(lambda x: jnp.asarray(x)[:, None], (evaluation.parsed, evaluation.tokens))
    return jax.tree.map(lambda x: x[:, 0], jax.device_get(score(*groups_of_one, target)))


@functools.cache
def reward_program(weights: tuple[tuple[str, float], ...], prior: bytes, shape: tuple[int, ...], decode: Decode) -> Any:
    """Compiled reward terms of groups of answers, made once for each set of weights."""
    rewards = make_rewards(np.frombuffer(prior, np.float32).reshape(shape))
    one = lambda parsed, tokens, target: total_reward(rewards, dict(weights), parsed, target, tokens, decode)[1]
    return jax.jit(jax.vmap(jax.vmap(one, in_axes=(0, 0, None), axis_name=GROUP)))


def rewards_of(
    policy: TouchPolicy, evaluation: Evaluation, weights: Mapping[str, float], prior: Float[np.ndarray, "A K"]
) -> Float[np.ndarray, "N"]:
    """Total reward of each answer; arguments as in `reward_terms`."""
    terms = reward_terms(policy, evaluation, weights, prior)
    return sum(terms.values(), start=np.zeros(len(evaluation.contact), np.float32))
