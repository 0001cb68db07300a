"""How much of a touch must an encoder read: time of a forward pass against the accuracy of probes?

    make experiment EXP=pareto_encoder [ARGS="--scale smoke"]

Prompts of 8 frames by four sensors at 112².  Every variant saves time in one way: joined frames, frames selected by
salience, patches selected by contact, merged patches without contact, fewer pixels, another width, or fields instead of
pictures; the reference has 256 tokens per stream.  Stage 1 trains each variant on the same contacts in the same order.
Linear probes score it on unseen objects.  Forward passes are timed in alternation, on the cores of the process.  The
fastest variant within a point of the reference is chosen on the validation objects; the reported figures are those of
the test objects.

Cost: 59 minutes in the recorded run on one core with the data, `--scale smoke` under one.

Expected: patches of 28 px with the energies of their filters contain the information about the labels, so that 64
tokens are as good as 256; dropping patches outside the contact saves time in proportion and costs little.
"""

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.context import Context
from experiments.core.results import Cell, Picture, Results, Table, at_least, at_most, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds
from experiments.encoder.pretrain import (
    StageOneDataConfig,
    clip_of,
    held_out_contacts,
    open_touch,
    pretrain,
    probe_encoder,
)
from experiments.encoder.speed import CompiledProgram, forward, matrix_product, medians, parts
from experiments.encoder.variants import FRAMES, IMAGE_PX, REFERENCE, EncoderVariant, FieldsOnly, variants
from experiments.study.dataset import Dataset
from experiments.study.estimates import points
from sensors_io.pipeline import clip_batches
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.bench.statistics import Interval
from touchr1_jax.training.feeds import touch_batch
from touchr1_jax.training.pretraining import PretrainConfig
from touchr1_jax.types import Params, TouchBatch

SEED = 0
LEAST_RATE, MOST_LOSS = 150.0, 1.0  # prompts a second; points of probe accuracy
TIMED = 8  # prompts of a timed batch
NOISE = 0.02  # share of the total time below which a part's time is within the noise


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParetoEncoderConfig:
    """Data, training of every variant, rounds of timing."""

    touch: StageOneDataConfig = StageOneDataConfig()
    pretrain: PretrainConfig = PretrainConfig(
        frames=FRAMES, image_px=IMAGE_PX, steps=100, batch_size=16, probe_every=100
    )
    rounds: int = 15


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeasuredVariant:
    """One variant, and the seconds and Gflop of a batch of `TIMED` prompts.

    Its probes are right about validation contacts where `choosing`, bool [m, 3], about test contacts where `right`,
    bool [n, 3].
    """

    variant: EncoderVariant
    choosing: np.ndarray
    right: np.ndarray
    seconds: float
    gflop: float

    @property
    def rate(self) -> float:
        """Prompts a second."""
        return TIMED / self.seconds

    @property
    def accuracy(self) -> float:
        """Mean of the three probes, percent."""
        return float(100 * self.right.mean())


def run(config: ParetoEncoderConfig, context: Context) -> Results:
    """Train, probe, time."""
    data = open_touch(config.touch, config.pretrain.frames, config.pretrain.image_px, context)
    listed, sensors = variants(config.pretrain), len(data.clip.sensors)
    encoders, right = {}, {}
    for number, variant in enumerate(context.each("variants", listed)):
        encoders[variant.name], right[variant.name] = learn(config, variant, data, context, f"variant{number}")
    programs = {
        v.name: forward(v.config.dynamics(sensors), encoders[v.name], prompts(v, data))
        for v in context.each("compiling variants", listed)
    }
    product = matrix_product()
    seconds = medians({**programs, "product": product}, context.rounds("timing variants", config.rounds))
    between = len(data.parts["val"])
    measured = {}
    for v in listed:
        choosing, tested = np.split(right[v.name], [between])
        cost: dict[str, float] = {"seconds": seconds[v.name], "gflop": programs[v.name].gflop}
        measured[v.name] = MeasuredVariant(variant=v, choosing=choosing, right=tested, **cost)
    best = choose(measured)
    makers = parts(best.variant.config.dynamics(sensors), encoders[best.variant.name], prompts(best.variant, data))
    pieces = {name: make() for name, make in context.each("compiling parts", makers.items())}
    spent = medians(pieces, context.rounds("timing parts", config.rounds))
    peak = product.gflop / seconds["product"]
    objects = data.object_ids[data.parts["test"]]
    return report(config, data, measured, best, peak, objects, part_table(best, pieces, spent, peak))


def learn(
    config: ParetoEncoderConfig, variant: EncoderVariant, data: Dataset, context: Context, name: str
) -> tuple[Params, np.ndarray]:
    """The trained encoder, and whether its probes are right about the validation and then the test contacts."""
    store = FieldsOnly(data.store) if variant.fields else data.store
    stage = f"dynamics/{name}/{SEED}"
    state = pretrain(variant.config, store, data.training, data.clip, context, stage=stage, seed=SEED)
    unseen = dataclasses.replace(
        held_out_contacts(data, "test", config.touch),
        store=store,
        clip=clip_of(variant.config, data.clip),
        read_rows=np.concatenate([data.parts["val"], data.parts["test"]]),
    )
    networks = variant.config.dynamics(len(data.clip.sensors))
    right = np.array(context.once(f"probes/{name}", lambda: probe_encoder(networks, state.target, unseen, context)))
    context.print(f"{variant.name}: {100 * right.mean():.1f} %")
    return state.target, right


def prompts(variant: EncoderVariant, data: Dataset) -> TouchBatch:
    """A batch of pictures to time, also for the variant that reads fields: both are bytes of one size."""
    clip = clip_of(variant.config, data.clip)
    rows = np.resize(data.parts["test"], TIMED)
    return touch_batch(next(iter(clip_batches(data.store, rows, clip, batch_size=TIMED, seed=0, shuffle=False))))


def choose(measured: Mapping[str, MeasuredVariant]) -> MeasuredVariant:
    """The fastest of those whose probes are at most a point below the reference's on the validation contacts."""
    bound = measured[REFERENCE].choosing.mean() - MOST_LOSS / 100
    return max((m for m in measured.values() if m.choosing.mean() >= bound), key=lambda m: m.rate)


def loss(m: MeasuredVariant, measured: Mapping[str, MeasuredVariant], objects: np.ndarray) -> Interval:
    """Points below the reference, paired by contact."""
    return points(measured[REFERENCE].right.astype(float) - m.right, objects)


def report(
    config: ParetoEncoderConfig,
    data: Dataset,
    measured: Mapping[str, MeasuredVariant],
    best: MeasuredVariant,
    peak: float,
    objects: np.ndarray,
    where: Table,
) -> Results:
    """The chart, the choice and where its time goes; `peak` is that of the matrix product, Gflop/s."""
    losses = {name: loss(m, measured, objects) for name, m in measured.items()}
    lost, reference, share = losses[best.variant.name], measured[REFERENCE], best.gflop / best.seconds / peak
    sizes = f"8 frames × 4 sensors at 112², batches of {TIMED}; matrix products at {peak:.0f} Gflop/s"
    span = f"paired interval over objects {bounds(lost.low, lost.high, '.1f')}"
    return Results(
        verdict=(
            f"'{best.variant.name}' reads {best.rate:.0f} prompts a second at {share:.0%} of a matrix product's rate; "
            f"its probes are right in {best.accuracy:.1f} %, the reference's in {reference.accuracy:.1f} %.",
        ),
        requirements=(
            at_least(f"forward, '{best.variant.name}'", best.rate, LEAST_RATE, "prompts/s", sizes),
            at_most("probes below 256 tokens a stream", lost.mean, MOST_LOSS, "points", span),
        ),
        tables=(variant_table(measured, losses, peak), where),
        pictures=(
            Picture(
                name="pareto_encoder",
                title="Milliseconds against the accuracy of probes",
                caption="Mean of three linear probes on unseen objects, bars are 95 % intervals over objects of the "
                "paired difference to the reference; dotted: the corner that must be reached.",
                content=accuracy_chart(measured, losses),
            ),
        ),
        settings={
            "cores": len(os.sched_getaffinity(0)),
            "matrix product": f"{peak:.0f} Gflop/s",
            "contacts trained on": config.pretrain.steps * config.pretrain.batch_size,
        },
        data=data.summary(),
    )


def variant_table(measured: Mapping[str, MeasuredVariant], losses: Mapping[str, Interval], peak: float) -> Table:
    """All variants."""
    return named_table(
        "Variants",
        [
            {
                "variant": name,
                "tokens": m.variant.tokens,
                "a prompt": 1e3 / m.rate,
                "prompts/s": m.rate,
                "share of peak": m.gflop / m.seconds / peak,
                "mean": m.accuracy,
                "gain": 0.0 - losses[name].mean,  # 0 − 0 has no minus sign
                "95 %": bounds(0.0 - losses[name].high, 0.0 - losses[name].low, ".1f"),
                **{attribute: float(100 * x) for attribute, x in zip(ORDINAL, m.right.mean(0), strict=True)},
            }
            for name, m in measured.items()
        ],
        formats={"tokens": "d", "a prompt": ".2f", "prompts/s": ".0f", "share of peak": ".2f", "mean": ".1f"}
        | {"gain": "+.1f"}
        | dict.fromkeys(ORDINAL, ".1f"),
        units={"a prompt": "ms", "gain": "points"} | dict.fromkeys(("mean", *ORDINAL), "%"),
        meanings={
            "tokens": "of a stream inside the transformer",
            "a prompt": "8 frames by four sensors, forward",
            "share of peak": "arithmetic a second over a matrix product's",
            "mean": "of the three probes",
            "gain": "over the reference",
            "95 %": "of the gain, over objects, paired",
        },
    )


def part_table(
    best: MeasuredVariant, pieces: Mapping[str, CompiledProgram], spent: Mapping[str, float], peak: float
) -> Table:
    """Time and arithmetic that each part adds to those before it; `spent` are seconds of `pieces`."""
    rows: list[dict[str, Cell]] = []
    before_s = before_gflop = 0.0
    total = list(spent.values())[-1]
    for name, seconds in spent.items():
        added, work = seconds - before_s, pieces[name].gflop - before_gflop
        rows.append(
            {
                "part": name,
                "time": 1e3 * added / TIMED,
                "share": 100 * added / total,
                "arithmetic": 1e3 * work / TIMED,
                "share of peak": work / added / peak if added > NOISE * total else None,
            }
        )
        before_s, before_gflop = seconds, pieces[name].gflop
    return named_table(
        f"Where the time of '{best.variant.name}' goes",
        rows,
        formats={"time": ".2f", "share": ".0f", "arithmetic": ".0f", "share of peak": ".2f"},
        units={"time": "ms a prompt", "share": "%", "arithmetic": "Mflop a prompt"},
        meanings={"part": "each row is the addition of one part to those above it"},
    )


def accuracy_chart(measured: Mapping[str, MeasuredVariant], losses: Mapping[str, Interval]) -> bytes:
    """Probe accuracy over milliseconds a prompt, a colour and marker for each kind of saving."""
    reference = measured[REFERENCE].accuracy
    series = []
    for kind in dict.fromkeys(m.variant.kind for m in measured.values()):
        named = {name: m for name, m in measured.items() if m.variant.kind == kind}
        look: dict[str, Any] = {"line": "", "size": 46.0, "labels": list(named)}
        low, high = ([reference - getattr(losses[name], end) for name in named] for end in ("high", "low"))
        x, y = [1e3 / m.rate for m in named.values()], [m.accuracy for m in named.values()]
        series.append(Series(f"saving in {kind}", x=x, y=y, low=low, high=high, **look))
    panel = Panel(
        series,
        x_label="forward, ms a prompt of 8 frames × 4 sensors",
        y_label="probes right, %",
        x_scale="log",
        rules=[Rule(x=1e3 / LEAST_RATE, y=reference - MOST_LOSS, keep="above")],
        better=("lower", "higher"),
    )
    return draw([panel], size=(8.4, 5.0))


SMOKE = ParetoEncoderConfig(
    touch=StageOneDataConfig(scenes=SceneConfig(objects=60, sites=1, seed=1)),
    pretrain=PretrainConfig(frames=FRAMES, image_px=IMAGE_PX, steps=2, batch_size=4, probe_every=2),
    rounds=2,
)

EXPERIMENT = Experiment(name="pareto_encoder", config=ParetoEncoderConfig(), scales={"smoke": SMOKE}, run=run)
