"""Policies of several sizes: their shapes, their parameters, and what a step and an answer of each cost."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context, read_metrics
from experiments.core.loops import STEPPING
from experiments.paper.ladder_arms import FULL
from experiments.study.answers import answer_program
from experiments.study.assembly import Assembly, ModelConfig
from experiments.study.feeds import AnswerFeed, labelled, question_batch, touch_batch
from experiments.study.scores import PUBLISHED
from experiments.study.stages import ENCODE_BATCH, encode_program, sft_program
from experiments.study.study import Study, StudyConfig, run_study
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.rl.config import Paper
from touchr1_jax.training.sft import SFTState
from touchr1_jax.types import Params, TouchBatch

SMALL = ModelConfig(
    tactile=TactileViTConfig(sensors=0, width=60),
    vision=VisionConfig(width=36),
    decoder=DecoderConfig(vocab_size=0, hidden_size=60, num_heads=2, intermediate_size=120),
)
LARGE = ModelConfig(
    tactile=TactileViTConfig(sensors=0, width=144),
    vision=VisionConfig(width=96),
    decoder=DecoderConfig(vocab_size=0, hidden_size=144, num_heads=5, intermediate_size=288),
)
"""About .43 and 2.1 times the parameters of the default, as 3 and 14 billion are of 7; pictures, frames, tokens and the
answer's length are the default's."""

CALLS = ("train", "answer")
"""What is timed: one step of SFT, and one block of questions from pictures to answers."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cost:
    """What a size takes: parameters, and seconds of a step of SFT, of a step of GRPO, and of a question.

    `grpo_s` is that of the run itself, waiting for data included; the others are measured beside those of other sizes.
    """

    parameters: int
    sft_s: float
    grpo_s: float
    question_s: float

    def training_s(self, config: StudyConfig) -> float:
        """Seconds of both stages of one seed."""
        return config.sft.steps * self.sft_s + config.grpo_steps * self.grpo_s


def study_apart(config: StudyConfig, name: str, context: Context) -> tuple[Study, Mapping[str, float]]:
    """SFT and the full model of every seed in a folder of the run; the curves stand in the run's log as arms `name`.

    Args:
      config: of the study.
      name: of the folder.
      context: the run.

    Returns:
      The study, and the wall seconds of its stages.
    """
    directory = context.directory / name
    directory.mkdir(exist_ok=True)
    inner = Context(
        directory, context.cache_dir, context.console, (), context.stopping, context.processes, context.devices
    )
    with contextlib.closing(inner), context.timed(f"study/{name}"):
        study = run_study(config, {FULL: PUBLISHED}, inner, {FULL: Paper()})
        for line in read_metrics(directory):
            phase, seed = line["stage"].split("/")[0], line["stage"].split("/")[-1]
            scalars = {key: value for key, value in line.items() if key not in ("stage", "step")}
            context.log(f"{phase}/{name}/{seed}", line["step"], **scalars)
        return study, inner.timing()


def grpo_step_s(config: StudyConfig, timing: Mapping[str, float]) -> float:
    """Mean seconds of a step of GRPO; the first step of a seed, which compiles, is not among those that are timed."""
    total = math.fsum(s for stage, s in timing.items() if stage.startswith(f"{STEPPING}/grpo/"))
    return total / (config.seeds * max(config.grpo_steps - 1, 1))


def parameters(params: Params) -> int:
    """How many numbers a policy has learnt."""
    return sum(math.prod(x.shape) for x in jax.tree.leaves(params))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Calls:
    """Programs of one size that were called once: `by_name` holds those of `CALLS`, `questions` what a block answers.

    An untrained policy answers them, which never ends early: a question costs at most this.
    """

    by_name: Mapping[str, Callable[[], Any]]
    questions: int
    parameters: int


def calls_of(study: Study) -> Calls:
    """A step of SFT and a block of questions about some test contacts, ready to be timed."""
    data, assembly = study.data, study.assembly
    rows = data.parts["test"][:ENCODE_BATCH]
    clips = data.batches(rows, batch_size=len(rows), seed=0, shuffle=False, repeat=False)
    touch = touch_batch(next(iter(clips)))
    params = assembly.init(0, touch)
    contact, _ = labelled(data.label[rows])
    calls = {"train": _train(study, params), "answer": _answer(assembly, params, touch, data.label[rows])}
    for call in calls.values():
        jax.block_until_ready(call())
    return Calls(by_name=calls, questions=len(contact), parameters=parameters(params))


def _answer(assembly: Assembly, params: Params, touch: TouchBatch, label: np.ndarray) -> Callable[[], Any]:
    encode, answer = encode_program(assembly.fns, False), answer_program(assembly)
    contact, attribute = labelled(label)
    decoder = {"decoder": params["decoder"]}

    def call() -> Any:
        features = jax.device_get(encode(params, touch))
        present = features.stream_mask[contact]
        return answer(decoder, question_batch(assembly, features, label, contact, attribute, present))

    return call


def _train(study: Study, params: Params) -> Callable[[], Any]:
    """A step on one batch, again and again; what sensors say by themselves does not matter to its time."""
    config, data, assembly = study.config.sft, study.data, study.assembly
    evidence = np.zeros((len(data.store), len(data.clip.sensors), len(assembly.levels), max(assembly.levels)))
    feed = AnswerFeed(assembly, data, evidence, batch_size=config.batch_size, questions=config.questions, seed=0)
    batch = next(feed)
    optimizer, step = sft_program(assembly.fns, config, False)
    mine = jax.tree.map(jnp.array, params)  # a copy: the step gives its buffers away
    states = [SFTState(params=mine, opt_state=optimizer.init(mine), step=jnp.zeros((), jnp.int32))]

    def call() -> Any:
        state, metrics = step(states.pop(), batch)
        states.append(state)
        return metrics

    return call
