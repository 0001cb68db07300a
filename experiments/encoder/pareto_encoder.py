"""How much of a touch must an encoder read, in milliseconds against what probes find in it?

    make experiment EXP=pareto_encoder [ARGS="--scale smoke"]

Prompts of 8 frames by four sensors at 112².  Every variant saves in one way: fewer tokens by joining frames, frames
chosen by salience, patches chosen by contact, the quiet rest merged, fewer pixels, another width, fields instead of
pictures; the reference has 256 tokens a stream.  Each is trained by stage 1 on the same contacts in the same order and
read by linear probes on unseen objects; forward passes are timed interleaved, on the cores that the process has.  The
fastest within a point of the reference is chosen on the validation objects; what is reported is of the test objects.

Cost: about fifteen minutes on one core with the data, `--scale smoke` under one.

Expected: a patch of 28 px with the energies of its filters holds what the labels are about, so that 64 tokens lose
nothing against 256; dropping patches outside the contact saves time in proportion and costs little.
"""

import dataclasses
import os
from collections.abc import Mapping

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.encoder.charts import accuracy_against_time
from experiments.encoder.data import StageOneDataConfig, open_touch, training_rows, watched
from experiments.encoder.held_out import probe_encoder
from experiments.encoder.intervals import points
from experiments.encoder.pretrain import PretrainConfig, clip_of, pretrain
from experiments.encoder.speed import forward, matrix_product, medians, parts
from experiments.encoder.variants import FRAMES, IMAGE_PX, REFERENCE, EncoderVariant, FieldsOnly, variants
from experiments.study.dataset import Dataset
from experiments.study.feeds import touch_batch
from sensors_io.pipeline import clip_batches
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.bench.statistics import Interval
from touchr1_jax.types import Params, TouchBatch

SEED = 0
LEAST_RATE, MOST_LOSS = 150.0, 1.0  # prompts a second; points of probe accuracy
TIMED = 8  # prompts of a timed batch
NOISE = 0.02  # share of the time below which the difference of two programs says nothing


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
    """One variant.

    Args:
      variant: the encoder.
      choosing: whether its probes are right about the validation contacts, bool [m, 3].
      right: the same about the test contacts, bool [n, 3].
      seconds: of a batch of `TIMED` prompts.
      gflop: of it.
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
    ladder = variants(config.pretrain)
    encoders, right = {}, {}
    for number, variant in enumerate(context.each("variants", ladder)):
        encoders[variant.name], right[variant.name] = learn(config, variant, data, context, f"variant{number}")
    programs = {
        v.name: forward(v.config.dynamics(len(data.clip.sensors)), encoders[v.name], prompts(v, data))
        for v in context.each("compiling variants", ladder)
    }
    product = matrix_product()
    seconds = medians({**programs, "product": product}, context.rounds("timing variants", config.rounds))
    between = len(data.parts["val"])
    measured = {
        v.name: MeasuredVariant(
            variant=v,
            choosing=right[v.name][:between],
            right=right[v.name][between:],
            seconds=seconds[v.name],
            gflop=programs[v.name].gflop,
        )
        for v in ladder
    }
    peak = product.gflop / seconds["product"]
    objects = data.object_ids[data.parts["test"]]
    best = choose(measured)
    networks = best.variant.config.dynamics(len(data.clip.sensors))
    makers = parts(networks, encoders[best.variant.name], prompts(best.variant, data))
    pieces = {name: make() for name, make in context.each("compiling parts", makers.items())}
    spent = medians(pieces, context.rounds("timing parts", config.rounds))
    where = pieces_table(best, spent, {name: p.gflop for name, p in pieces.items()}, peak)
    return findings(config, data, measured, best, peak, objects, where)


def learn(
    config: ParetoEncoderConfig, variant: EncoderVariant, data: Dataset, context: Context, name: str
) -> tuple[Params, np.ndarray]:
    """The trained encoder, and whether its probes are right about the validation and then the test contacts."""
    store = FieldsOnly(data.store) if variant.fields else data.store
    rows, stage = training_rows(data), f"dynamics/{name}/{SEED}"
    state = pretrain(variant.config, store, rows, data.clip, context, stage=stage, seed=SEED)
    if not context.done(answers := f"probes/{name}"):
        clip = clip_of(variant.config, data.clip)
        both = np.concatenate([data.parts["val"], data.parts["test"]])
        unseen = dataclasses.replace(watched(data, "test", config.touch), store=store, clip=clip, read_rows=both)
        found = probe_encoder(variant.config.dynamics(len(data.clip.sensors)), state.target, unseen, context)
        context.save_stage(answers, found)
    right = np.array(context.load_stage(answers))
    context.print(f"{variant.name}: {100 * right.mean():.1f} %")
    return state.target, right


def prompts(variant: EncoderVariant, data: Dataset) -> TouchBatch:
    """A batch to time, pictures whatever the variant reads: both are bytes of one size."""
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


def findings(
    config: ParetoEncoderConfig,
    data: Dataset,
    measured: Mapping[str, MeasuredVariant],
    best: MeasuredVariant,
    peak: float,
    objects: np.ndarray,
    where: Table,
) -> Results:
    """The chart, the choice and where its time goes."""
    lost = loss(best, measured, objects)
    share = best.gflop / best.seconds / peak
    return Results(
        verdict=(
            f"'{best.variant.name}' reads {best.rate:.0f} prompts a second and its probes are right in "
            f"{best.accuracy:.1f} %; the reference reads {measured[REFERENCE].rate:.0f} and is right in "
            f"{measured[REFERENCE].accuracy:.1f} %.",
            f"Its arithmetic runs at {share:.0%} of the {peak:.0f} Gflop/s of a matrix product on the same cores.",
        ),
        requirements=(
            Requirement(
                name=f"forward, '{best.variant.name}'",
                measured=best.rate,
                bound=LEAST_RATE,
                better="higher",
                unit="prompts/s",
                note=f"8 frames × 4 sensors at 112², batches of {TIMED}; matrix products at {peak:.0f} Gflop/s",
            ),
            Requirement(
                name="probes below 256 tokens a stream",
                measured=lost.mean,
                bound=MOST_LOSS,
                better="lower",
                unit="points",
                note=f"paired interval over objects [{lost.low:.1f}, {lost.high:.1f}]",
            ),
        ),
        tables=(ladder_table(measured, objects, peak), where),
        pictures=(picture(measured, objects),),
        settings={
            "cores": len(os.sched_getaffinity(0)),
            "matrix product": f"{peak:.0f} Gflop/s",
            "contacts trained on": config.pretrain.steps * config.pretrain.batch_size,
        },
        data=data.summary(),
    )


def picture(measured: Mapping[str, MeasuredVariant], objects: np.ndarray) -> Picture:
    """The chart."""
    reference = measured[REFERENCE].accuracy
    return Picture(
        name="pareto_encoder",
        title="Milliseconds against what the probes find",
        caption="Mean of three linear probes on unseen objects, bars are 95 % intervals over objects of the paired "
        "difference to the reference; dotted: the corner that must be reached.",
        content=accuracy_against_time(
            [
                (name, m.variant.kind, 1e3 / m.rate, m.accuracy, loss(m, measured, objects))
                for name, m in measured.items()
            ],
            reference,
            (1e3 / LEAST_RATE, reference - MOST_LOSS),
        ),
    )


def ladder_table(measured: Mapping[str, MeasuredVariant], objects: np.ndarray, peak: float) -> Table:
    """All variants."""
    rows: list[tuple[Cell, ...]] = []
    for name, m in measured.items():
        lost = loss(m, measured, objects)
        by_attribute = tuple(float(100 * x) for x in m.right.mean(0))
        speed = (m.variant.tokens, 1e3 / m.rate, m.rate, m.gflop / m.seconds / peak)
        gained = (0.0 - lost.mean, f"[{0.0 - lost.high:.1f}, {0.0 - lost.low:.1f}]")  # 0 − 0 has no minus sign
        rows.append((name, *speed, m.accuracy, *gained, *by_attribute))
    return Table(
        title="Variants",
        columns=(
            Column(name="variant"),
            Column(name="tokens", format="d", meaning="of a stream inside the transformer"),
            Column(name="a prompt", unit="ms", format=".2f", meaning="8 frames by four sensors, forward"),
            Column(name="prompts/s", format=".0f"),
            Column(name="share of peak", format=".2f", meaning="arithmetic a second over a matrix product's"),
            Column(name="mean", unit="%", format=".1f", meaning="of the three probes"),
            Column(name="gain", unit="points", format="+.1f", meaning="over the reference"),
            Column(name="95 %", meaning="of the gain, over objects, paired"),
            *(Column(name=name, unit="%", format=".1f") for name in ORDINAL),
        ),
        rows=tuple(rows),
    )


def pieces_table(best: MeasuredVariant, spent: Mapping[str, float], gflop: Mapping[str, float], peak: float) -> Table:
    """What each part adds to the time and to the arithmetic."""
    rows: list[tuple[Cell, ...]] = []
    before_s = before_gflop = 0.0
    total = spent[list(spent)[-1]]
    for name, seconds in spent.items():
        added, work = seconds - before_s, gflop[name] - before_gflop
        rate = work / added / peak if added > NOISE * total else None
        rows.append((name, 1e3 * added / TIMED, 100 * added / total, 1e3 * work / TIMED, rate))
        before_s, before_gflop = seconds, gflop[name]
    return Table(
        title=f"Where the time of '{best.variant.name}' goes",
        columns=(
            Column(name="part", meaning="each row is what one part adds to those above it"),
            Column(name="time", unit="ms a prompt", format=".2f"),
            Column(name="share", unit="%", format=".0f"),
            Column(name="arithmetic", unit="Mflop a prompt", format=".0f"),
            Column(name="share of peak", format=".2f"),
        ),
        rows=tuple(rows),
    )


DEFAULT = ParetoEncoderConfig()
SMOKE = ParetoEncoderConfig(
    touch=StageOneDataConfig(scenes=SceneConfig(objects=60, sites=1, seed=1)),
    pretrain=PretrainConfig(frames=FRAMES, image_px=IMAGE_PX, steps=2, batch_size=4, probe_every=2),
    rounds=2,
)

EXPERIMENT = Experiment(name="pareto_encoder", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
