"""Parts of the stages of a study: probes, feeds, encoded contacts, arms, untrained policies."""

import dataclasses
import functools
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int

from experiments.core.context import Context
from experiments.core.progress import TrainingSample
from experiments.study.dataset import Dataset
from sensors_io.augment import AugmentConfig
from sensors_io.schema import ATTRIBUTES, LEVELS
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rewards import make_rewards
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.scoring import ScoreFn, make_score, reward_weights
from touchr1_jax.text.template import AND, QUESTIONS
from touchr1_jax.training import encoding
from touchr1_jax.training.feeds import AnswerFeed, host_touch, touch_batch
from touchr1_jax.training.linear_probe import ProbeConfig, sensor_evidence, stream_features
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.train_sft import SFTConfig
from touchr1_jax.types import Params, StepSample, TouchBatch

Weights = Mapping[str, float]  # reward → weight


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudySFT(SFTConfig):
    """SFT on clips that may be augmented."""

    augment: AugmentConfig = AugmentConfig()
    """Random changes of the touch; none by default."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProbeFeatures:
    """Fixed features of every contact's streams, float32 [contact, S, D], and of its force alone, [contact, D'].

    `present` [contact, S] is true where the stream was recorded.
    """

    streams: np.ndarray
    present: np.ndarray
    force: np.ndarray


def probe_features(data: Dataset, context: Context) -> ProbeFeatures:
    """Summarise all contacts once; every seed shares it, and every process does its part."""

    def summarise(rows: np.ndarray) -> dict[str, np.ndarray]:
        parts = [
            {
                "streams": np.asarray(stream_features(clip["frames"], clip["force_n"])),
                "present": clip["stream_mask"],
                "force": clip["force_n"].reshape(len(clip["force_n"]), -1),
            }
            for clip in _clips(data, rows, context, "reading touch", batch_size=32)
        ]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    return ProbeFeatures(**context.processes.split_work(np.arange(len(data.store)), summarise))


def _clips(data: Dataset, rows: np.ndarray, context: Context, title: str, **order: Any) -> Iterator[dict[str, Any]]:
    """The clips of some contacts once, in order, under a progress bar."""
    with context.progress(title, len(rows)) as advance:
        for clip in data.batches(rows, seed=0, shuffle=False, repeat=False, **order):
            yield clip
            advance(len(clip["contact"]))


def gather_evidence(
    data: Dataset, probed: ProbeFeatures, config: ProbeConfig, context: Context
) -> Float[np.ndarray, "contact S A K"]:
    """`sensor_evidence` of the training contacts, from probes of those of SFT; all others count as not recorded."""
    sft, train = (np.isin(np.arange(len(data.store)), rows) for rows in (data.parts["sft"], data.training))
    return sensor_evidence(
        probed.streams,
        probed.present & train[:, None],
        data.label,
        data.object_ids,
        [LEVELS[name] for name in ATTRIBUTES],
        config,
        track=functools.partial(context.each, "evidence"),
        read_only=train & ~sft,
    )


def answer_feed(
    policy: TouchPolicy,
    data: Dataset,
    evidence: np.ndarray,
    config: StudySFT,
    *,
    seed: int,
    blind: bool = False,
    own: np.ndarray | None = None,
    devices: int = 1,
) -> AnswerFeed:
    """Batches of SFT, of which this process reads the rows `own`; `devices` share a micro-batch."""
    order: dict[str, Any] = {"batch_size": config.batch_size, "seed": seed, "own": own}
    return AnswerFeed(
        policy,
        data.batches(data.parts["sft"], with_touch=not blind, augment=config.augment, **order),
        evidence,
        questions=config.questions,
        blind=blind,
        easy_steps=round(config.curriculum * config.steps),
        conclusion_weight=config.conclusion_weight,
        packing=config.packing(devices),
        **order,
    )


def computed_touch(policy: TouchPolicy, data: Dataset, context: Context) -> TouchBatch | None:
    """All contacts on the host with the statistics that a policy's stem reads; `None` for stems that read pixels.

    They have no parameters, so that one computation serves all seeds and stages; every process does its part.
    """
    tactile = policy.model.tactile
    if tactile.stem != "statistics":
        return None

    def compute(rows: np.ndarray) -> TouchBatch:
        clips = _clips(data, rows, context, "computing statistics", batch_size=encoding.BATCH)
        return encoding.touch_statistics(tactile, map(touch_batch, clips))

    with data.computing:
        if tactile.patch_px not in data.statistics:
            data.statistics[tactile.patch_px] = context.processes.split_work(np.arange(len(data.store)), compute)
        return data.statistics[tactile.patch_px]


def untrained(policy: TouchPolicy, data: Dataset, seed: int) -> Params:
    """The parameters that training of a seed starts from."""
    clips = data.batches(data.parts["sft"][:1], batch_size=1, seed=0, repeat=False)
    return policy.init(seed, touch_batch(next(iter(clips))))


def encode_rows(
    policy: TouchPolicy, params: Params, data: Dataset, rows: np.ndarray, context: Context, *, blind: bool = False
) -> Features:
    """Features of some contacts on the host, in the order of `rows`; each process encodes its part."""

    touch = None if blind else computed_touch(policy, data, context)

    def encode(own: np.ndarray) -> Features:
        clips = lambda: _clips(data, own, context, "encoding", batch_size=encoding.BATCH, with_touch=not blind)
        batches: Iterable[TouchBatch] = map(touch_batch, clips()) if touch is None else encoding.parts(touch, own)
        return encoding.encode_contacts(policy.fns, params, batches, blind=blind)

    return context.processes.split_work(rows, encode)


def noise_bank(
    policy: TouchPolicy, params: Params, data: Dataset, *, seed: int, contacts: int
) -> Float[Array, "K S N D"]:
    """Encoded noise with the statistics of some SFT contacts."""
    clips = data.batches(data.parts["sft"], batch_size=contacts, seed=seed, repeat=False)
    return encoding.noise_bank(policy.fns, params, host_touch(next(iter(clips))), seed=seed)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class GRPOArm:
    """One arm of a study: its reward, its algorithm, its length.

    `score` is the total reward, made of the weights and of the prior, the share of each level among the training
    labels; it is one object for all seeds, so that it is compiled once.
    """

    weights: Weights
    prior: Float[np.ndarray, "A K"]
    score: ScoreFn
    config: GRPOConfig
    loop: LoopConfig


def make_arm(
    policy: TouchPolicy,
    weights: Weights,
    prior: Float[np.ndarray, "A K"],
    config: GRPOConfig,
    loop: LoopConfig,
) -> GRPOArm:
    """An arm whose total reward is made of its weights, in the form that its algorithm asks for, and the prior."""
    weights = reward_weights(config.algorithm, weights)
    score = make_score(policy.parser, make_rewards(prior), weights, policy.tokenizer.decode)
    return GRPOArm(weights=weights, prior=prior, score=score, config=config, loop=loop)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class EncodedContacts:
    """Contacts that the decoder is trained on, by SFT or by GRPO, encoded by one policy.

    Attributes:
      features: their encoded touch.
      label: their levels [n, A]; −1 where GRPO may not ask.
      truth: all their levels, −1 unknown, which rewards and SFT see.
      noise: the encoder's noise bank.
      evidence: [n, S, A, K] of the sensors' probes, from which verified answers are made.
      full_share: share of the questions of GRPO that show all present sensors.
    """

    features: Features
    label: Int[np.ndarray, "n A"]
    truth: Int[np.ndarray, "n A"]
    noise: Float[Array, "K S N D"]
    evidence: Float[np.ndarray, "n S A K"]
    full_share: float = 0.75


def describe_sample(policy: TouchPolicy, sample: StepSample) -> TrainingSample:
    """An answer of a step in words."""
    asked = [a for a, chosen in zip(policy.language.attributes, sample.asked, strict=True) if chosen]
    levels = {a.name: level for a, level in zip(policy.language.attributes, sample.label, strict=True)}
    known = [f"{a.name} {a.levels[levels[a.name]][0]}" for a in asked if levels[a.name] >= 0]
    return TrainingSample(
        question=f"{f' {AND} '.join(QUESTIONS[a.name] for a in asked)}?",
        answer=policy.tokenizer.decode(sample.tokens).strip(),
        truth=", ".join(known),
        reward=float(sample.reward),
    )
