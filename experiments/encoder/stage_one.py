"""Which objective without labels prepares an encoder for few labels?

    make experiment EXP=stage_one
    make experiment EXP=stage_one ARGS="--touch.data records --touch.data-dir RECORDS"

Every method trains the same encoder on the touch of all training objects, without labels: prediction of the next latent
(`dynamics`), contrast between the sensors of one contact (`contrast`), prediction of hidden patches against an averaged
encoder (`masked`), estimation of force and depth (`physics`).  Then each encoder, and a random one, is fine-tuned in
the same way on 10, 30, 100 and 300 labelled contacts and predicts hardness, roughness and protrusion of unseen
objects.  The number of fine-tuning steps and the best method are chosen on validation objects.  With recordings
without depth, `physics` learns only force.

Cost: two hours on two busy cores in the recorded run, `--scale smoke` under two minutes.

Expected: contrast between sensors gains five points with 10 labels and two with 30; five at both are required.  The
stem computes the energies of its filters, from which a random encoder already reads levels.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

import jax
import numpy as np

from experiments.core.artifacts import write_bytes
from experiments.core.charts import Panel, draw, estimates
from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.core.results import Cell, Picture, Results, Table, at_least, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds, interval
from experiments.encoder.pretrain import (
    ClipFeed,
    StageOneDataConfig,
    clip_of,
    open_touch,
    pretrain,
    read_all,
    untrained,
)
from experiments.study.dataset import Dataset
from experiments.study.estimates import points
from sensors_io.pipeline import clip_batches
from sensors_io.scenes.config import SceneConfig
from touchr1_jax import validation
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.bench.statistics import Interval, student_interval
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.training.feeds import touch_batch
from touchr1_jax.training.fine_tuning import FineTuned, FineTuneState, level_log_probs, make_fine_tune_step
from touchr1_jax.training.fine_tuning import start_fine_tuning as start
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.objectives import Objective
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.training.pretraining import PretrainConfig, encoder_of
from touchr1_jax.types import Params

RANDOM = "random"
"""The encoder before any training."""

FEW = 30
"""Labelled contacts up to which the requirement counts."""

LEAST_LEAD = 5.0
"""Points over the random encoder that are required there."""

CLIP_MEMORY_GIB = 0.5
"""Clips that stay in memory once they were read; all of the default ones."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageOneConfig:
    """Data, objectives, stage 1, and fine-tuning."""

    touch: StageOneDataConfig = StageOneDataConfig()
    pretrain: PretrainConfig = PretrainConfig(
        encoder=TactileViTConfig(sensors=0, causal=True, stem_px=2), image_px=56, steps=300, probe_every=300
    )
    """Stage 1; pictures of 56 px give the same tokens as those of 112 and cost a quarter."""
    objectives: tuple[Objective, ...] = ("dynamics", "contrast", "masked", "physics")
    labelled: tuple[int, ...] = (10, 30, 100, 300)
    """Labelled contacts of the learning curve; more than there are means all."""
    tune_steps: tuple[int, ...] = (20, 60)
    """Numbers of fine-tuning steps, ascending, of which validation objects choose."""
    tune_batch: int = 16
    tune_optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=100.0, warmup_steps=5)
    seeds: int = 5
    read: int = 480
    """Most test contacts, and twice the most validation contacts, that are read."""

    def __post_init__(self) -> None:
        validation.at_least(self, 1, "seeds", "tune_batch")
        validation.at_least(self, 4, "read")
        validation.some_of(self, "objectives", get_args(Objective))
        for field in ("labelled", "tune_steps"):
            counts = getattr(self, field)
            if not counts or list(counts) != sorted(set(counts)) or counts[0] < 1:
                raise ValueError(f"{field} is {counts}: must hold different counts ≥ 1, ascending; sort it")


def run(config: StageOneConfig, context: Context) -> Results:
    """Pretrain and fine-tune with every seed, choose on validation objects, compare with the random encoder."""
    sizes = config.pretrain.frames, config.pretrain.image_px
    data = open_touch(config.touch, *sizes, context, memory_gib=CLIP_MEMORY_GIB)
    methods = (RANDOM, *config.objectives)
    curves: dict[str, list[np.ndarray]] = {method: [] for method in methods}
    for seed in context.each("seeds", range(config.seeds)):
        for method in methods:
            encode = functools.cache(functools.partial(trained_encoder, config, data, context, method, seed))
            of_counts = [fine_tuned_right(config, data, context, encode, method, n, seed) for n in config.labelled]
            curves[method].append(np.array(of_counts))  # count, steps, contact, attribute
    read = {part: read_rows(config, data, part) for part in ("val", "test")}
    between = len(read["val"])
    right = {method: np.stack(of_seeds) for method, of_seeds in curves.items()}  # seed first
    chosen = {m: chosen_steps(x[..., :between, :]) for m, x in right.items()}
    test = {m: at_steps(x[..., between:, :], chosen[m]) for m, x in right.items()}  # seed count contact attribute
    val = {m: at_steps(x[..., :between, :], chosen[m]) for m, x in right.items()}
    few = np.array(config.labelled) <= FEW
    few = few if few.any() else np.arange(len(config.labelled)) == 0
    best = max(config.objectives, key=lambda m: val[m][:, few].mean())
    objects = data.object_ids[read["test"]]
    return report(config, data, test, objects, chosen, best, few)


def trained_encoder(config: StageOneConfig, data: Dataset, context: Context, method: str, seed: int) -> Params:
    """Parameters of the encoder after stage 1 by a method; they are written to the run."""
    rows, clip = data.training, clip_of(config.pretrain, data.clip)
    if method == RANDOM:
        return untrained(config.pretrain, data.store, rows, clip, seed).params["encoder"]
    objective = next(o for o in config.objectives if o == method)
    settings = dataclasses.replace(config.pretrain, objective=objective)
    order: dict[str, Any] = {"stage": f"stage1/{method}/{seed}", "seed": seed, "memory": data.memory}
    state = pretrain(settings, data.store, rows, data.clip, context, **order)
    online = dataclasses.replace(state, target=state.params["encoder"])  # the average lags behind in a short training
    encoder = encoder_of(settings, online, data.clip.sensors, objective=method, steps=settings.steps)
    write_bytes(context.directory / "encoders" / f"{method}-{seed}.npz", encoder.to_bytes())
    return state.params["encoder"]


def fine_tuned_right(
    config: StageOneConfig,
    data: Dataset,
    context: Context,
    encoder: Callable[[], Params],
    method: str,
    count: int,
    seed: int,
) -> list[Any]:
    """Correctness of fine-tuned encoders, [steps, val + test contact, attribute], from the run where it is there."""

    def compute() -> list[Any]:
        rows = np.random.default_rng((seed, 31)).permutation(data.training)[:count]  # fewer are always among more
        clip = clip_of(config.pretrain, data.clip)
        tuned, optimizer, step, read = fine_tune_programs(config, len(clip.sensors))
        feed = ClipFeed(data.store, rows, clip, batch_size=config.tune_batch, seed=seed, memory=data.memory)
        one = next(iter(clip_batches(data.store, rows[:1], clip, batch_size=1, seed=0, repeat=False)))
        state: FineTuneState = start(tuned, optimizer, encoder(), touch_batch(one))
        state, found = jax.device_put(state, jax.devices()[0]), []
        for steps in config.tune_steps:
            loop = LoopConfig(steps=steps, save_every=config.tune_steps[-1])
            state = run_loop(step, state, feed, loop, context, f"tune/{method}-{count}/{seed}")
            found.append(is_right(config, data, read, state.params).tolist())
        return found

    return context.once(f"right/{method}-{count}/{seed}", compute)


def read_rows(config: StageOneConfig, data: Dataset, part: str) -> np.ndarray:
    """Contacts of a part that are read."""
    return data.parts[part][: config.read if part == "test" else config.read // 2]


def is_right(config: StageOneConfig, data: Dataset, read: Callable[..., Any], params: Params) -> np.ndarray:
    """Correctness of the likeliest level, bool [val + test contact, attribute]."""
    rows = np.concatenate([read_rows(config, data, part) for part in ("val", "test")])
    clip, label = clip_of(config.pretrain, data.clip), data.label[rows][:, : len(ORDINAL)]
    found = read_all(functools.partial(read, params), data.store, rows, clip, memory=data.memory)
    return (found == label) & (label >= 0)


@functools.cache
def fine_tune_programs(config: StageOneConfig, sensors: int) -> tuple[FineTuned, Any, Any, Any]:
    """The encoder that is fine-tuned, its optimizer, compiled step, and compiled reading of levels, made once."""
    tuned = FineTuned(encoder=dataclasses.replace(config.pretrain.encoder, sensors=sensors))
    optimizer = make_optimizer(config.tune_optimizer, config.tune_steps[-1])
    levels = jax.jit(lambda params, batch: level_log_probs(tuned, params, batch).argmax(-1))
    return tuned, optimizer, make_fine_tune_step(tuned, optimizer), levels


def chosen_steps(right: np.ndarray) -> np.ndarray:
    """For each count the best number of steps on validation objects, [count], of right [seed, count, steps, n, A]."""
    return right.mean((0, 3, 4)).argmax(-1)


def at_steps(right: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """The answers at the chosen numbers of steps, float [seed, count, n, A]."""
    return np.stack([right[:, c, s] for c, s in enumerate(steps)], 1).astype(float)


def lead(a: np.ndarray, b: np.ndarray, objects: np.ndarray) -> Interval:
    """Points of a over b, both [seed, count, n, A], mean over seeds and counts, with an interval over objects."""
    return points((a - b).mean((0, 1)), objects)


def report(
    config: StageOneConfig,
    data: Dataset,
    test: Mapping[str, np.ndarray],
    objects: np.ndarray,
    chosen: Mapping[str, np.ndarray],
    best: str,
    few: np.ndarray,
) -> Results:
    """Verdict, the requirement at few labels, the table and the learning curves."""
    counts = [n for n, at in zip(config.labelled, few, strict=True) if at]
    gains: dict[str, Interval] = {m: lead(test[m][:, few], test[RANDOM][:, few], objects) for m in config.objectives}
    gain, spread = gains[best], ""
    if config.seeds > 1:
        over_seeds = student_interval(100 * (test[best] - test[RANDOM])[:, few].mean((1, 2, 3)))
        spread = f", over seeds {bounds(over_seeds.low, over_seeds.high, '.1f')}"
    others = ", ".join(f"{m} {interval(gains[m], '+.1f')}" for m in config.objectives if m != best)
    pays = "meets" if gain.low > 0 and gain.mean >= LEAST_LEAD else "does not meet"
    verdict = (
        f"Stage 1 {pays} its requirement: with {' and '.join(map(str, counts))} labelled contacts {best}, chosen on "
        f"validation objects, is {interval(gain, '+.1f')} points over a random encoder with the same fine-tuning (95 % "
        f"over objects{spread}).",
        *((f"The other methods: {others}.",) if others else ()),
    )
    note = f"95 % over objects {bounds(gain.low, gain.high, '.1f')}"
    return Results(
        verdict=verdict,
        requirements=(
            at_least(f"{best} over a random encoder, few labels", gain.mean, LEAST_LEAD, "points", note),
            at_least("lower end of that interval", gain.low, 0.0, "points", "over objects"),
        ),
        tables=(curve_table(config, test, objects, chosen),),
        pictures=(
            Picture(
                name="stage_one",
                title="Learning curves",
                caption="Right answers about unseen objects after fine-tuning, by the number of labelled contacts; "
                "mean over seeds and three properties, 95 % over objects.",
                content=curve_chart(config.labelled, test, objects),
            ),
        ),
        settings={"stage 1 steps": config.pretrain.steps, "seeds": config.seeds},
        data=data.summary(),
    )


def curve_table(
    config: StageOneConfig, test: Mapping[str, np.ndarray], objects: np.ndarray, chosen: Mapping[str, np.ndarray]
) -> Table:
    """Accuracy and lead of every method at every number of labels."""
    rows: list[dict[str, Cell]] = []
    for method, right in test.items():
        for c, count in enumerate(config.labelled):
            row: dict[str, Cell] = {"method and labels": f"{method}, {count}"}
            row["right"] = interval(points(right[:, c].mean(0), objects), ".1f")
            row |= {name: 100 * float(right[:, c, :, a].mean()) for a, name in enumerate(ORDINAL)}
            row["steps"] = config.tune_steps[chosen[method][c]]
            if method != RANDOM:
                at = slice(c, c + 1)
                row["over random"] = interval(lead(right[:, at], test[RANDOM][:, at], objects), "+.1f")
            rows.append(row)
    return named_table(
        f"Fine-tuned encoders on {len(np.unique(objects))} unseen objects",
        rows,
        formats={**dict.fromkeys(ORDINAL, ".1f"), "steps": "d"},
        units={**dict.fromkeys(("right", *ORDINAL), "%"), "over random": "points"},
        meanings={"right": "95 % over objects", "steps": "of fine-tuning, chosen on validation objects"},
        note=f"Means over {config.seeds} seeds, which differ in the encoder, the labelled contacts and their order.",
    )


def curve_chart(counts: Sequence[int], test: Mapping[str, np.ndarray], objects: np.ndarray) -> bytes:
    """Draw accuracy over the number of labelled contacts."""
    series = []
    for i, (method, right) in enumerate(test.items()):
        found = [points(right[:, c].mean(0), objects) for c in range(len(counts))]
        shift = 0.05 * (i - (len(test) - 1) / 2)
        series.append(estimates(method, found, at=np.arange(len(counts)), shift=shift))
    ticks = {float(c): str(count) for c, count in enumerate(counts)}
    return draw([Panel(series, x_label="labelled contacts", y_label="right (%)", x_ticks=ticks)], size=(7.0, 3.8))


SMOKE = StageOneConfig(
    touch=StageOneDataConfig(scenes=SceneConfig(objects=60, sites=1)),
    pretrain=dataclasses.replace(StageOneConfig().pretrain, steps=4, batch_size=8, probe_every=4),
    objectives=("contrast", "physics"),
    labelled=(5, 10),
    tune_steps=(1, 2),
    tune_batch=4,
    seeds=2,
    read=12,
)

EXPERIMENT = Experiment(name="stage_one", config=StageOneConfig(), scales={"smoke": SMOKE}, run=run, quick=("smoke",))
