"""What a policy answers to questions about some contacts, and what each answer earns."""

import dataclasses
import functools
import io
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.core.artifacts import write_bytes
from experiments.core.context import Context
from experiments.study.assembly import Assembly, Weights
from experiments.study.feeds import each, labelled, question_batch
from touchr1_jax.bench.metrics import Answers
from touchr1_jax.models.policy import Features
from touchr1_jax.rewards import make_rewards, total_reward
from touchr1_jax.rl.rollout import make_answer
from touchr1_jax.types import Params, Parsed

EVAL_BATCH = 64
"""Questions that are answered at once."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluated:
    """Greedy answers to every question about some contacts; question n is about contact `contact[n]`."""

    contact: np.ndarray
    attribute: np.ndarray
    streams: np.ndarray
    tokens: np.ndarray
    parsed: Parsed
    label: np.ndarray  # int32 [N, A], −1 where not asked
    alone: np.ndarray | None  # int32 [N, S, A]

    def answers(self, reward: np.ndarray) -> Answers:
        """What the metrics read."""
        return Answers(
            conclude=np.asarray(self.parsed.conclude),
            label=self.label,
            formatted=np.asarray(self.parsed.formatted),
            reward=reward,
            streams=self.streams,
            perceive=np.asarray(self.parsed.perceive),
            alone=self.alone,
        )


def evaluate_policy(
    assembly: Assembly,
    params: Params,
    features: Features,
    label: np.ndarray,
    context: Context,
    *,
    alone: bool = True,
) -> Evaluated:
    """Ask every labelled question about every contact, with all streams and, unless `alone` is off, with each alone."""
    contact, attribute = labelled(label)
    present = np.asarray(features.stream_mask)[contact]
    s = present.shape[1]
    shown = [present]
    if alone and present.any() and s > 1:
        shown += [present & (np.arange(s) == i) for i in range(s)]
    ask = answer_program(assembly)
    with context.progress("asking", len(shown) * len(contact)) as advance:
        said, *each_alone = [
            _ask(ask, assembly, params, features, label, contact, attribute, streams, advance) for streams in shown
        ]
    single = np.stack([x.parsed.conclude for x in each_alone], 1) if each_alone else None
    return Evaluated(
        contact=contact,
        attribute=attribute,
        streams=present,
        tokens=said.tokens,
        parsed=said.parsed,
        label=np.where(assembly.layout.asked[attribute], label[contact], -1),
        alone=single,
    )


@functools.cache
def answer_program(assembly: Assembly) -> Any:
    """Compiled greedy answerer, made once."""
    return make_answer(assembly.fns, assembly.parser, assembly.model.completion_tokens)


def _ask(ask, assembly, params, features, label, contact, attribute, streams, advance):
    """Greedy answers to all questions, in blocks of one size so that the program is compiled once."""
    decoder, blocks = {"decoder": params["decoder"]}, []
    for rows, real in each(len(contact), EVAL_BATCH):
        batch = question_batch(assembly, features, label, contact[rows], attribute[rows], streams[rows])
        blocks.append(jax.tree.map(lambda x, n=real: np.asarray(x)[:n], ask(decoder, batch)))
        advance(real)
    return jax.tree.map(lambda *x: np.concatenate(x), *blocks)


def reward_terms(
    assembly: Assembly, done: Evaluated, weights: Weights, prior: np.ndarray
) -> dict[str, Float[np.ndarray, "N"]]:
    """What each weighted reward adds to the total of each answer."""
    target = assembly.target(done.attribute, done.label, done.streams)
    score = reward_program(tuple(weights.items()), prior.tobytes(), prior.shape)
    return jax.device_get(score(jax.tree.map(jnp.asarray, done.parsed), target))


@functools.cache
def reward_program(weights: tuple[tuple[str, float], ...], prior: bytes, shape: tuple[int, ...]) -> Any:
    """Compiled reward terms of many answers, made once for each set of weights."""
    rewards = make_rewards(np.frombuffer(prior, np.float32).reshape(shape))
    return jax.jit(jax.vmap(lambda p, t: total_reward(rewards, dict(weights), p, t)[1]))


def reward_of(assembly: Assembly, done: Evaluated, weights: Weights, prior: np.ndarray) -> Float[np.ndarray, "N"]:
    """Total reward of each answer under the given weights."""
    return sum(reward_terms(assembly, done, weights, prior).values(), start=np.zeros(len(done.contact), np.float32))


def save_answers(path: Path, answers: Evaluated) -> None:
    """Publish answers as one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    flat: dict[str, Any] = {f: getattr(answers, f) for f in _FLAT if getattr(answers, f) is not None}
    flat |= {f"parsed_{f}": getattr(answers.parsed, f) for f in _PARSED}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **flat)
    write_bytes(path, buffer.getvalue())


def load_answers(path: Path) -> Evaluated:
    """Answers that `save_answers` published."""
    with np.load(path) as file:
        flat: dict[str, Any] = {f: file.get(f) for f in _FLAT}
        return Evaluated(**flat, parsed=Parsed(**{f: file[f"parsed_{f}"] for f in _PARSED}))


_FLAT = tuple(f.name for f in dataclasses.fields(Evaluated) if f.name != "parsed")
_PARSED = tuple(f.name for f in dataclasses.fields(Parsed))
