"""Greedy and sampled answers of a policy to every question about some contacts, and the reward that each earns."""

import collections
import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from touchr1_jax.models.lora import of_decoder
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rewards import make_rewards, total_reward
from touchr1_jax.rewards.base import GROUP, Decode
from touchr1_jax.rl.rollout import (
    GreedyAnswers,
    GRPOBatch,
    SampleConfig,
    encode_prompts,
    make_answer,
    sample_with_caches,
)
from touchr1_jax.text.template import level_tokens
from touchr1_jax.training.compilation import committed
from touchr1_jax.training.questions import equal_blocks, labelled_questions, question_batch
from touchr1_jax.types import Params, Parsed

EVAL_BATCH = 64
"""Questions that are answered at once."""

AHEAD = 2
"""Batches of questions that are dispatched before the first is fetched."""

T = TypeVar("T")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Greedy answers to every labelled question about some contacts; question n is about contact `contact[n]`.

    Attributes:
      contact, attribute, streams: the question, and the shown streams.
      tokens, parsed: the answer.
      label: −1 where not asked.
      truth: level of every attribute, −1 unknown, which rewards see; `None` where only `label` was kept.
      alone: conclusions of the policy from each single stream; `None` if these were not asked.
      sampled: conclusions of n answers sampled at temperature 1 with all streams; `None` if there are none.
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
      policy, params: the policy that answers.
      features: of the contacts, from `encoding.encode_contacts`.
      label: −1 for unknown, which is not asked about.
      alone: also ask with each stream alone, if there are several.
      samples: number of sampled answers to each question, with all streams.
      batch_size: questions that are answered at once.
      answer: from (decoder, questions) to answers; by default the policy's own (`answer_program`).
      progress: receives the number of finished answers and of all answers.
    """
    contact, attribute = labelled_questions(label)
    present = np.asarray(features.stream_mask)[contact]
    s = present.shape[1]
    shown = [present]
    if alone and present.any() and s > 1:
        shown += [present & (np.arange(s) == i) for i in range(s)]
    answer, decoder = answer or answer_program(policy), committed(of_decoder(params))
    rounds: list[tuple[np.ndarray, Callable[[GRPOBatch, int], Any]]]
    rounds = [(streams, lambda batch, block: answer(decoder, batch)) for streams in shown]
    if samples:
        draw, key = sample_program(policy, samples), jax.random.key(0)
        rounds.append((present, lambda batch, block: draw(decoder, batch, jax.random.fold_in(key, block))))
    found, done = [], 0
    progress(0, len(rounds) * len(contact))
    for streams, ask in rounds:
        order, blocks = enumerate(equal_blocks(len(contact), batch_size)), []
        batch = lambda at, s=streams: question_batch(policy, features, label, contact[at], attribute[at], s[at])
        for result, real in in_flight((ask(batch(rows), block), real) for block, (rows, real) in order):
            blocks.append(jax.tree.map(lambda x, n=real: np.asarray(x)[:n], result))
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


def in_flight(results: Iterable[T], number: int = AHEAD) -> Iterator[T]:
    """The results in order, each after so many later ones are dispatched, because small programs leave cores idle."""
    waiting: collections.deque[T] = collections.deque()
    for result in results:
        waiting.append(result)
        if len(waiting) > number:
            yield waiting.popleft()
    yield from waiting


@functools.cache
def answer_program(policy: TouchPolicy, *, constrained: bool = False) -> Any:
    """Compiled greedy decoder and parser, made once; a constrained one writes only formatted answers."""
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
    unknown = jnp.zeros(max(policy.levels))

    def decode(params: Params, token: jax.Array, t: jax.Array, past: Any, kept: Any) -> tuple[jax.Array, Any]:
        """A token step that keeps p(level | trace), the softmax over the levels' scores after `conclude` opens."""
        (prefix, ids), (caches, share) = past, kept
        logits, caches = fns.decode(params, token, t, prefix, caches)
        if known is None:
            return logits, (caches, share)
        opened = (token == known.opens) & (t > 0) & (t < length - 1) & ~jnp.any(share)
        p = jax.nn.softmax(jnp.where(ids >= 0, logits[ids], -jnp.inf))
        return logits, (caches, jnp.where(opened, p, share))

    @jax.jit
    def sample(params: Params, batch: GRPOBatch, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        prompts, asked = encode_prompts(fns, params, batch), jnp.argmax(batch.target.asked, -1)
        ids = jnp.zeros_like(asked) if known is None else jnp.asarray(known.level)[asked]
        past, kept = (prompts.prefix, ids), (fns.empty_cache(length), unknown)
        step = functools.partial(decode, params)
        drawn, (_, share) = sample_with_caches(step, prompts.first, past, kept, key, draw)
        level = jax.vmap(jax.vmap(policy.parser))(drawn.tokens).conclude
        if known is None:
            share = jax.nn.one_hot(jnp.take_along_axis(level, asked[:, None, None], -1)[..., 0], len(unknown))
        return level, jnp.mean(share, 1)

    return sample


def reward_terms(
    policy: TouchPolicy, evaluation: Evaluation, weights: Mapping[str, float], prior: Float[np.ndarray, "A K"]
) -> dict[str, Float[np.ndarray, "N"]]:
    """The part of each weighted reward in the total of each answer.

    Args:
      policy: the policy that answered.
      evaluation: the answers.
      weights: of the rewards.
      prior: share of each level among the training labels.
    """
    truth = evaluation.label if evaluation.truth is None else evaluation.truth
    target = policy.target(evaluation.attribute, truth, evaluation.streams)
    shares = np.asarray(prior, np.float32)
    score = reward_program(tuple(weights.items()), shares.tobytes(), shares.shape, policy.tokenizer.decode)
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
