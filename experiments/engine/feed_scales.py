"""The batches of a study at one of its scales, as its first device gets them."""

import dataclasses
from typing import Any

import jax
import numpy as np

from experiments.study.dataset import Dataset
from experiments.study.stages import answer_feed
from experiments.study.study import StudyConfig
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.training.encoding import encode_program
from touchr1_jax.training.feeds import AnswerFeed
from touchr1_jax.training.questions import QuestionFeed
from touchr1_jax.types import TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeedScale:
    """A study, its devices, and how many contacts its feed is tried on."""

    study: StudyConfig
    devices: int
    contacts: int

    def __post_init__(self) -> None:
        for name, size in (("sft.batch_size", self.study.sft.batch_size), ("grpo.drawn", self.study.grpo.drawn)):
            if size % self.devices:
                raise ValueError(f"devices is {self.devices}: must divide {name} = {size}; change either")


def clip_bytes(touch: TouchBatch) -> int:
    """Bytes of each clip of a batch."""
    return sum(x.nbytes for x in jax.tree.leaves(touch)) // len(touch.stream_mask)


def memory_share(study: StudyConfig, data: Dataset, touch: TouchBatch) -> float:
    """Share of the study's clips that its memory holds."""
    scenes = study.scenes
    contacts = scenes.objects * scenes.sites if scenes.sequences is None else scenes.sequences // len(data.clip.sensors)
    return min(1.0, study.clip_memory_gib * 2**30 / (contacts * clip_bytes(touch)))


def answers(policy: TouchPolicy, data: Dataset, scale: FeedScale) -> AnswerFeed:
    """Batches of SFT, those rows that the first device reads; the evidence is equal for all levels."""
    config = scale.study.sft
    shape = (len(data.store), len(data.clip.sensors), len(policy.levels), max(policy.levels))
    own = np.arange(config.batch_size // scale.devices)
    return answer_feed(policy, data, np.zeros(shape, np.float32), config, seed=0, own=own)


def questions(policy: TouchPolicy, touch: TouchBatch, data: Dataset, scale: FeedScale) -> QuestionFeed:
    """Batches of GRPO, those rows that the first device reads, about encoded touch that is all zeros."""
    params = jax.eval_shape(lambda touch: policy.init(0, touch), touch)
    one = jax.eval_shape(encode_program(policy.fns, False), params, touch)
    n = len(data.store)
    zeros: Features = jax.tree.map(lambda x: np.zeros((n, *x.shape[1:]), x.dtype), one)
    there: Any = np.ones(zeros.stream_mask.shape, bool)
    features = dataclasses.replace(zeros, stream_mask=there)
    drawn = scale.study.grpo.drawn
    return QuestionFeed(policy, features, data.label, batch_size=drawn, seed=0, own=np.arange(drawn // scale.devices))
