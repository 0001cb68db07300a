"""Policies of several sizes: shapes, parameters, times of a step and of an answer, and trends of the metrics."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.charts import Panel, Series, draw, estimates
from experiments.core.context import Context
from experiments.core.look import PALETTE, SHARED
from experiments.core.loops import STEPPING
from experiments.core.metric_log import read_metrics
from experiments.core.results import Estimate, Table, named_table
from experiments.core.text import bounds, number
from experiments.paper.components import FULL, run_full_model
from experiments.study.stages import answer_feed
from experiments.study.study import SFT, Study, StudyConfig
from touchr1_jax.bench.scoring import REPORTED
from touchr1_jax.bench.statistics import Interval, student_interval
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import ModelConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.training.encoding import BATCH, encode_program
from touchr1_jax.training.evaluation import answer_program
from touchr1_jax.training.feeds import touch_batch
from touchr1_jax.training.questions import labelled_questions, question_batch
from touchr1_jax.training.sft import SFTState
from touchr1_jax.training.train_sft import sft_program

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

CLAIMED = ("l2_em", "soi_rho", "csc", "avg")
"""Metrics that the paper names as growing clearly with the size; it claims growth of most other metrics as well."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SizeCost:
    """Parameters of a size, and seconds of a step of SFT, of a step of GRPO, and of a question.

    `grpo_s` is that of the run itself, waiting for data included; the others are measured in turns with other sizes.
    """

    parameters: int
    sft_s: float
    grpo_s: float
    question_s: float

    def training_s(self, config: StudyConfig) -> float:
        """Seconds of both stages of one seed."""
        return config.sft.steps * self.sft_s + config.grpo_steps * self.grpo_s


def study_of_size(config: StudyConfig, name: str, context: Context) -> tuple[Study, Mapping[str, float]]:
    """SFT and the full model of every seed in folder `name` of the run, whose log holds the curves as those of an arm.

    Returns:
      The study, and the wall seconds of its stages.
    """
    directory = context.directory / name
    directory.mkdir(exist_ok=True)
    inner = Context(
        directory, context.cache_dir, context.console, (), context.stopping, context.processes, context.devices
    )
    with contextlib.closing(inner), context.timed(f"study/{name}"):
        study = run_full_model(config, inner)
        for line in read_metrics(directory):
            phase, *arm, seed = line["stage"].split("/")
            curve = "_".join([name, *(part for part in arm if part not in (FULL, SFT))])
            scalars = {key: value for key, value in line.items() if key not in ("stage", "step")}
            context.log(f"{phase}/{curve}/{seed}", line["step"], **scalars)
        return study, inner.timing()


def grpo_step_s(config: StudyConfig, timing: Mapping[str, float]) -> float:
    """Mean seconds of a step of GRPO; the first step of a seed, which compiles, is not timed."""
    total = math.fsum(s for stage, s in timing.items() if stage.startswith(f"{STEPPING}/grpo/"))
    return total / (config.seeds * max(config.grpo_steps - 1, 1))


@dataclasses.dataclass(frozen=True, kw_only=True)
class TimedPrograms:
    """Programs of one size that have run once: a step of SFT, and a block of questions from pictures to answers.

    An untrained policy answers them, which never ends early: `answer` takes the longest time that it can.
    """

    train: Callable[[], Any]
    answer: Callable[[], Any]
    questions: int
    parameters: int


def timed_programs(study: Study) -> TimedPrograms:
    """A step of SFT and a block of questions about some test contacts, ready to be timed."""
    data, policy = study.data, study.policy
    rows = data.parts["test"][:BATCH]
    clips = data.batches(rows, batch_size=len(rows), seed=0, shuffle=False, repeat=False)
    touch, label = touch_batch(next(iter(clips))), data.label[rows]
    params = policy.init(0, touch)
    contact, attribute = labelled_questions(label)
    encode, ask = encode_program(policy.fns, False), answer_program(policy)

    def answer() -> Any:
        features = jax.device_get(encode(params, touch))
        present = features.stream_mask[contact]
        batch = question_batch(policy, features, label, contact, attribute, present)
        return ask({"decoder": params["decoder"]}, batch)

    config = study.config.sft
    evidence = np.zeros((len(data.store), len(data.clip.sensors), len(policy.levels), max(policy.levels)))
    batch = next(answer_feed(policy, data, evidence, config, seed=0))
    optimizer, step = sft_program(policy.fns, config, False)
    donated = jax.tree.map(jnp.array, params)  # a copy: the step gives its buffers away
    states = [SFTState(params=donated, opt_state=optimizer.init(donated), step=jnp.zeros((), jnp.int32))]

    def train() -> Any:
        state, metrics = step(states.pop(), batch, {})
        states.append(state)
        return metrics

    for call in (train, answer):
        jax.block_until_ready(call())
    parameters = sum(math.prod(x.shape) for x in jax.tree.leaves(params))
    return TimedPrograms(train=train, answer=answer, questions=len(contact), parameters=parameters)


SizeRows = Mapping[str, Mapping[str, Mapping[str, Estimate]]]  # policy → size → metric


@dataclasses.dataclass(frozen=True, kw_only=True)
class SizeTrend:
    """Change of a metric for each doubling of the parameters, with its interval over seeds."""

    policy: str
    metric: str
    slope: Interval

    @property
    def larger_is(self) -> Literal["better", "worse", "undecided"]:
        """The direction beyond chance over seeds."""
        if not self.slope.excludes_zero:
            return "undecided"
        rises = self.slope.mean > 0
        return "better" if rises == (REPORTED[self.metric].better == "higher") else "worse"


def size_trends(rows: SizeRows, costs: Mapping[str, SizeCost], metrics: Sequence[str]) -> tuple[SizeTrend, ...]:
    """Slopes of every policy and metric: for every seed a line m = a + b·log₂ N through its sizes, b over seeds.

    By least squares b = Σ (x − x̄)(m − m₀) / Σ (x − x̄)² with x = log₂ N, exactly 0 where m does not change.  A metric
    that some size lacks is left out.
    """
    doublings = np.log2([costs[name].parameters for name in costs])
    away, found = doublings - doublings.mean(), []
    for policy, sizes in rows.items():
        for metric in metrics:
            if all(metric in sizes[name] for name in costs):
                values = np.array([sizes[name][metric].per_seed for name in costs])
                slope = student_interval(np.asarray(away @ (values - values[:1]) / (away @ away)))
                found.append(SizeTrend(policy=policy, metric=metric, slope=slope))
    return tuple(found)


def trend_table(trends: Sequence[SizeTrend]) -> Table:
    """Every slope, and the paper's claim about the metric."""
    spec = lambda trend: f"+{REPORTED[trend.metric].format}"
    return named_table(
        "Change for each doubling of the parameters",
        [
            {
                "policy and metric": f"{t.policy}: {REPORTED[t.metric].title}",
                "change": number(t.slope.mean, spec(t)),
                "95 % over seeds": bounds(t.slope.low, t.slope.high, spec(t)),
                "larger is": t.larger_is,
                "paper": "grows clearly" if t.metric in CLAIMED else "grows, if it is among most",
            }
            for t in trends
        ],
        meanings={
            "95 % over seeds": "Student's t over the slopes of single seeds",
            "larger is": "better or worse where the interval excludes 0",
            "paper": "its text: consistent growth on most higher-better metrics, these named",
        },
        note="Slopes of straight lines through three sizes; the learning rates are those of the default size.",
    )


def size_table(models: Mapping[str, ModelConfig], costs: Mapping[str, SizeCost], config: StudyConfig) -> Table:
    """Shape, parameters and times of each size."""
    towers = lambda m: ((m.tactile.num_layers, m.tactile.width), (m.vision.num_layers, m.vision.width))
    decoder = lambda m: (m.decoder.num_layers, m.decoder.hidden_size)
    return named_table(
        "Sizes",
        [
            {
                "size": name,
                "parameters": cost.parameters,
                "shape": ", ".join(f"{n}×{width}" for n, width in (*towers(models[name]), decoder(models[name]))),
                "SFT step": 1e3 * cost.sft_s,
                "GRPO step": 1e3 * cost.grpo_s,
                "question": 1e3 * cost.question_s,
                "training": cost.training_s(config),
            }
            for name, cost in costs.items()
        ],
        formats={"SFT step": ".0f", "GRPO step": ".0f", "question": ".1f", "training": ".0f"},
        units={"SFT step": "ms", "GRPO step": "ms", "question": "ms", "training": "s"},
        meanings={
            "shape": "layers × width of the tactile encoder, the picture tower, the decoder",
            "SFT step": "measured in turns with the other sizes",
            "GRPO step": "as it ran",
            "question": "pictures to answer, to its full length",
            "training": "both stages of a seed, by the steps' times",
        },
    )


def size_chart(rows: SizeRows, costs: Mapping[str, SizeCost], config: StudyConfig, metrics: Sequence[str]) -> bytes:
    """One row of panels for each metric, against parameters and against seconds of training."""
    positions = {
        "parameters (million)": [cost.parameters / 1e6 for cost in costs.values()],
        "training of a seed (s)": [cost.training_s(config) for cost in costs.values()],
    }
    panels = []
    for metric in metrics:
        unit = f" ({REPORTED[metric].unit})" if REPORTED[metric].unit else ""
        for label, x in positions.items():
            series: list[Series] = []
            for (policy, sizes), colour in zip(rows.items(), (*PALETTE[:2], SHARED), strict=False):
                found = [sizes[name][metric] for name in costs]
                series.append(estimates(policy, found, at=x, colour=colour, marker="o"))
                dots = [(at, value) for at, e in zip(x, found, strict=True) for value in e.per_seed]
                at, values = zip(*dots, strict=True)
                series.append(Series(x=at, y=values, line="", marker="o", size=9, alpha=0.35, colour=colour))
            ticks = {value: format(value, ".2g") if value < 10 else format(value, ".0f") for value in x}
            x_label = label if metric == metrics[-1] else ""
            y_label = f"{REPORTED[metric].title}{unit}" if label == next(iter(positions)) else ""
            panels.append(Panel(series, x_scale="log", x_ticks=ticks, x_label=x_label, y_label=y_label))
    return draw(panels, columns=len(positions), size=(8.2, 2.5 * len(metrics) + 0.5))
