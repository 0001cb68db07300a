"""What does an encoder learn about touch by predicting its next observation, without labels?

    make experiment EXP=pretrain_encoder
    make experiment EXP=ablation_ordinal ARGS="--encoder runs/pretrain_encoder/latest"

Stage 1: a causal tactile encoder and a predictor learn the dynamics of presses by four sensors, on objects that no
later stage uses.  Measured on objects that neither training nor probes have used: the skill of the predicted latents
over copying the last one, and linear probes compared with those on the untrained encoder.  The averaged encoder is
written to the run as `encoder.npz`.

Cost: 25 minutes in the recorded run on one core with the data, `--scale smoke` under one.

Expected: a skill near .5 over copying, and .4 over the mean latent of each step, which contains the force but not the
object.  A random encoder is a strong baseline: it computes the energies of its filters by design, and probes predict
seven labels of ten from them.  Prediction first improves hardness, which depends on dynamics, and makes texture and
shape worse: the final accuracy is three points lower.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.core.artifacts import write_bytes
from experiments.core.charts import Panel, Series, draw
from experiments.core.context import Context
from experiments.core.metric_log import read_metrics
from experiments.core.results import Cell, Picture, Results, Table, at_least, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds, interval
from experiments.encoder.pretrain import (
    StageOneDataConfig,
    assess,
    clip_of,
    held_out_contacts,
    open_touch,
    pretrain,
    untrained,
)
from experiments.study.estimates import points
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.bench.statistics import skill
from touchr1_jax.training.pretraining import EncoderAssessment, PretrainConfig, encoder_of

SEED = 0
LEAST_SKILL, LEAST_LEAD = 0.2, 15.0  # over copy-last; points over the random encoder


@dataclasses.dataclass(frozen=True, kw_only=True)
class PretrainEncoderConfig:
    """Data and training; `watch_fit` contacts fit the probes during training."""

    touch: StageOneDataConfig = StageOneDataConfig()
    pretrain: PretrainConfig = PretrainConfig()
    watch_fit: int = 640


def run(config: PretrainEncoderConfig, context: Context) -> Results:
    """Train, save the encoder, measure on the test objects before and after."""
    data = open_touch(config.touch, config.pretrain.frames, config.pretrain.image_px, context)
    rows, sensors = data.training, data.clip.sensors
    state = pretrain(
        config.pretrain,
        data.store,
        rows,
        data.clip,
        context,
        stage=f"dynamics/{SEED}",
        seed=SEED,
        held_out=held_out_contacts(data, "val", config.touch, config.watch_fit),
    )
    encoder = encoder_of(config.pretrain, state, sensors, steps=config.pretrain.steps, source=data.store.meta.source)
    write_bytes(context.directory / "encoder.npz", encoder.to_bytes())
    with context.timed("assess"):
        test, networks = held_out_contacts(data, "test", config.touch), config.pretrain.dynamics(len(sensors))
        after = assess(networks, state, test, context)
        start = untrained(config.pretrain, data.store, rows, clip_of(config.pretrain, data.clip), SEED)
        before = assess(networks, start, test, context)
    objects = data.object_ids[data.parts["test"]]
    copied, constant = (skill(after.error, reference, objects) for reference in (after.copied, after.constant))
    lead = points(after.right.astype(float) - before.right, objects)
    span = bounds(lead.low, lead.high, ".1f")
    return Results(
        verdict=(
            f"On unseen objects the predicted latents have a skill of {interval(copied, '.2f')} over copying the last, "
            f"and of {interval(constant, '.2f')} over the mean latent of each step.",
            f"Linear probes are right in {after.accuracy:.1f} %, before training in {before.accuracy:.1f} %: "
            f"{interval(lead, '+.1f')} points.",
        ),
        requirements=(
            at_least(
                "skill over copy-last", copied.low, LEAST_SKILL, note="lower end of the 95 % interval over objects"
            ),
            at_least("probes over a random encoder", lead.mean, LEAST_LEAD, "points", f"interval over objects {span}"),
        ),
        tables=(probe_table(before, after, objects),),
        pictures=(
            Picture(
                name="pretrain_encoder",
                title="Learning",
                caption="Loss terms of every step, and held-out skill and probes on the validation objects.",
                content=learning_chart(read_metrics(context.directory)),
            ),
        ),
        settings={"steps": config.pretrain.steps, "contacts a step": config.pretrain.batch_size},
        data=data.summary(),
    )


def probe_table(before: EncoderAssessment, after: EncoderAssessment, objects: np.ndarray) -> Table:
    """Probes by attribute before and after training."""
    rows: list[dict[str, Cell]] = []
    for a, name in enumerate((*ORDINAL, "mean of three")):
        pick = slice(a, a + 1) if a < len(ORDINAL) else slice(None)
        gain = points(after.right[:, pick].astype(float) - before.right[:, pick], objects)
        rows.append(
            {
                "attribute": name,
                "random encoder": points(before.right[:, pick], objects).mean,
                "pretrained": points(after.right[:, pick], objects).mean,
                "gain": gain.mean,
                "95 %": bounds(gain.low, gain.high, ".1f"),
            }
        )
    figures = ("random encoder", "pretrained", "gain")
    return named_table(
        f"Linear probes on {len(np.unique(objects))} unseen objects",
        rows,
        formats=dict.fromkeys(figures, ".1f"),
        units=dict(zip(figures, ("%", "%", "points"), strict=True)),
        meanings={
            "random encoder": "the same networks before training",
            "pretrained": "the averaged encoder",
            "95 %": "over objects, paired",
        },
        note="The probes read each stream's tokens, mean over its steps.",
    )


def learning_chart(lines: Sequence[Mapping[str, Any]]) -> bytes:
    """Loss terms, held-out skill and held-out probes over steps, from the logged lines of a run."""
    trained, probed = ([line for line in lines if line["stage"] == f"{name}/{SEED}"] for name in ("dynamics", "probe"))

    def curve(name: str, key: str, rows: Sequence[Mapping[str, Any]], **look: Any) -> Series:
        return Series(name, x=[row["step"] for row in rows], y=[row[key] for row in rows], width=1.4, **look)

    low = min((line["skill_over_mean"] for line in probed[1:]), default=0.0)
    terms = {"prediction": "prediction error", "variance_term": "variance term"}
    skills = {"skill": "over copy-last", "skill_over_mean": "over the step's mean"}
    panels = [
        Panel([curve(name, key, trained, marker="") for key, name in terms.items()], title="loss terms"),
        Panel(
            [
                curve("skill on training batches", "skill", trained, marker="", colour="#b8c0c8", alpha=0.8),
                *(curve(f"skill {name}", key, probed[1:]) for key, name in skills.items()),
            ],
            title="held-out skill",
            y_limits=(min(-0.1, low - 0.05), 1),
        ),
        Panel([curve(name, f"probe_{name}", probed) for name in ORDINAL], title="linear probes, % right"),
    ]
    return draw([dataclasses.replace(panel, x_label="step") for panel in panels], size=(10.2, 3.4))


SMOKE = PretrainEncoderConfig(
    touch=StageOneDataConfig(scenes=SceneConfig(objects=60, sites=1)),
    pretrain=PretrainConfig(steps=6, batch_size=8, probe_every=3),
    watch_fit=24,
)

EXPERIMENT = Experiment(name="pretrain_encoder", config=PretrainEncoderConfig(), scales={"smoke": SMOKE}, run=run)
