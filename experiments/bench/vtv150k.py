"""How do touch, force and guessing score under the protocol of VTV150K, compared with the paper's table?

    make experiment EXP=vtv150k [ARGS="--scale smoke"]

Nine tasks about recordings of unseen objects: hardness, protrusion, elasticity, friction, all four at once, which of
two has more, which of three most or least, which recording belongs to which object, which suits a scenario.  VTV150K's
videos have no published levels; here a recording is a slide and a press that is released, on the same generated object,
by four sensors.  Linear probes on fixed features, fitted on other objects, answer.  Baselines are force with and
without touch, true shape alone, the frequency of the levels, and guessing.  No policy answers, because its language has
no words for elasticity and friction.

Cost: about four minutes of one core, nearly all of it to make the recordings; `--scale smoke` half a minute.

Expected: all sensors together well above guessing in every task; about half of the levels of friction and elasticity,
three quarters of those of hardness and protrusion.  In the paper's table no model that was not trained for touch even
reaches guessing.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.core.charts import Panel, Series, draw, estimates
from experiments.core.context import Context
from experiments.core.errors import DataError
from experiments.core.look import PALETTE, SHARED
from experiments.core.results import Cell, Picture, Results, Table, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds, interval
from experiments.mechanics.identify_motions import MOTIONS, MotionData, contacts_of, motion_data
from experiments.mechanics.identify_probes import FORCE, transfer
from experiments.study import paper_numbers as paper
from experiments.study.paper_numbers import differences_table
from sensors_io.live import LiveScenes
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS
from touchr1_jax.bench import vtv
from touchr1_jax.bench.averages import VTV, vtv_average
from touchr1_jax.bench.statistics import Interval
from touchr1_jax.bench.vtv import ATTRIBUTES, CHANCE
from touchr1_jax.training.linear_probe import ProbeConfig

FUSED, WITH_FORCE = "all sensors", "all sensors and force"
SHAPE, PRIOR = "true shape", "commonest"

Scored = Mapping[str, Mapping[str, Interval]]  # predictor → task, and "average"


@dataclasses.dataclass(frozen=True, kw_only=True)
class VTVProtocolConfig:
    """The scenes of the recordings, the frames read of each, the probes, and the number of questions."""

    scenes: SceneConfig = SceneConfig(objects=400, sequences=4 * 2800, frames=24, image_px=56, contact_grid=32)
    """Its protocol moves only objects that bear it: about three in ten have both motions, the flat ones more often."""
    moments: int = 8  # frames of a motion that are read
    probe: ProbeConfig = ProbeConfig()
    questions: int = 960  # questions of each task that compares recordings


class RecordingFeatures(NamedTuple):
    """n objects: features by source, [n, D], true levels [n, A], names [n]."""

    features: Mapping[str, Float[np.ndarray, "n D"]]
    label: np.ndarray
    objects: np.ndarray


def run(config: VTVProtocolConfig, context: Context) -> Results:
    """Make the recordings, fit the probes, score them."""
    with context.progress("planning", 1) as advance:
        rows = one_each(LiveScenes(config.scenes))
        advance()
    with context.timed("recordings"), context.progress("recordings", sum(map(len, rows.values()))) as advance:
        made = together([motion_data(config.scenes, name, config.moments, advance, rows[name]) for name in MOTIONS])
    tasks = vtv.draw_tasks(made.label, config.questions, seed=0)
    with context.timed("probes"):
        predicted = predictions(made, config.probe, context)
    scores = {name: vtv.score(tasks, log_probs) for name, log_probs in context.each("scoring", predicted.items())}
    scored = {name: vtv.averaged(score, made.objects) for name, score in scores.items()}
    shares = {
        name: [round(100 * float(np.mean(made.label[:, a] == level)), 1) for level in range(vtv.LEVELS)]
        for a, name in enumerate(ATTRIBUTES)
    }
    return Results(
        verdict=verdict(scored),
        tables=(score_table(scored), differences_table(DIFFERENCES)),
        pictures=(
            Picture(
                name="vtv",
                title="Nine tasks",
                caption="Share of right answers about objects that no probe was trained on, 95 % intervals over "
                "objects; the paper's figures are of other recordings.",
                content=score_chart(scored),
            ),
        ),
        settings={
            "recordings": f"{len(made.objects)} objects, {' and '.join(MOTIONS)} each, by {len(SENSORS)} sensors"
        },
        data={
            "objects": len(made.objects),
            "level shares (%)": shares,
            "questions": {task: len(score.values) for task, score in scores[FUSED].items()},
        },
    )


def one_each(scenes: LiveScenes) -> dict[str, list[int]]:
    """The first contact of every motion with each object that has one of all, objects in the same order."""
    by_object = lambda rows: {scenes.contacts[row].object_id: row for row in reversed(rows)}
    first: dict[str, dict[str, int]] = {name: by_object(contacts_of(scenes, name)) for name in MOTIONS}
    shared = sorted(set.intersection(*(set(rows) for rows in first.values())))
    if not shared:
        raise DataError(f"no object has a contact of each of {', '.join(MOTIONS)}: raise scenes.sequences")
    return {name: [rows[object_id] for object_id in shared] for name, rows in first.items()}


def together(motions: Sequence[MotionData]) -> RecordingFeatures:
    """Contacts of several motions with the same objects, their features joined."""
    joined = lambda parts: np.concatenate(list(parts), 1)
    touch = {sensor: joined(m.touch[s] for m in motions) for s, sensor in enumerate(SENSORS)}
    force = joined(m.force.reshape(len(m.force), -1) for m in motions)
    return RecordingFeatures(
        features={**touch, FORCE: force, SHAPE: joined(m.shape for m in motions)},
        label=np.stack([motions[0].levels[name] for name in ATTRIBUTES], 1),
        objects=motions[0].objects,
    )


def predictions(
    made: RecordingFeatures, config: ProbeConfig, context: Context
) -> dict[str, Float[np.ndarray, "n A K"]]:
    """log p of every level by every source; sensors are joined as if their errors were independent."""
    found = {}
    with context.progress("probes", len(made.features) * len(ATTRIBUTES)) as advance:
        for source, x in made.features.items():
            parts = []
            for a in range(len(ATTRIBUTES)):
                (predicted,) = transfer(x, [], made.label[:, a], made.objects, config)
                parts.append(predicted.log_probs)
                advance()
            found[source] = np.stack(parts, 1)
    fused = np.sum([found[sensor] for sensor in SENSORS], axis=0)
    return {
        FUSED: fused,
        WITH_FORCE: fused + found[FORCE],
        **{source: found[source] for source in (*SENSORS, FORCE, SHAPE)},
        PRIOR: vtv.prior_log_probs(made.label),
    }


def verdict(scored: Scored) -> tuple[str, ...]:
    """Touch against force, shape and guessing; and the paper's rows against guessing."""
    average, guess = {name: row["average"] for name, row in scored.items()}, vtv_average(CHANCE)
    others = ", ".join(f"{name} {average[name].mean:.1f}" for name in (FORCE, SHAPE, PRIOR))
    below = [name for name, (_, value) in paper.VTV.items() if value < guess]
    return (
        f"All sensors together have an average of {interval(average[FUSED], '.1f')}; {others}, guessing {guess:.1f}.",
        f"{len(below)} of the paper's {len(paper.VTV)} rows lie below guessing ({', '.join(below)}), which a model "
        "that always answers can reach only if questions differ or answers could not be read.",
    )


def score_table(scored: Scored) -> Table:
    """Every predictor, guessing, and every row of the paper."""
    span, columns = "95 %", (*paper.VTV_COLUMNS, "Average")
    row = lambda name, values: {"row": name, **dict(zip(columns, values, strict=True))}
    rows: list[dict[str, Cell]] = [
        row(name, [of[task].mean for task in (*VTV, "average")])
        | {span: bounds(of["average"].low, of["average"].high, ".1f")}
        for name, of in scored.items()
    ]
    rows.append(row("guessing", [*(CHANCE[task] for task in VTV), vtv_average(CHANCE)]))
    rows += [row(_published(name), (*values, average)) for name, (values, average) in paper.VTV.items()]
    return named_table(
        "The nine tasks, ours and the paper's",
        rows,
        formats=dict.fromkeys(columns, ".1f"),
        meanings={
            "Average": "plain mean of the nine",
            span: "of the average, whole objects resampled; the paper gives none",
            **{column: MEANINGS[task] for task, column in zip(VTV, paper.VTV_COLUMNS, strict=True)},
        },
        note="Percent right. Compare directions, not values: other objects, other questions, no language model. The "
        "paper's caption says that SOI is no percentage, but its averages take it as one.",
    )


def _published(name: str) -> str:
    return f"{'Touch-R1' if name == 'Ours' else name} (paper)"


MEANINGS: Mapping[str, str] = {
    **dict.fromkeys(ATTRIBUTES, "its level, of three"),
    "combined": "all four levels",
    "sfd": "which of two has more of an attribute",
    "soi": "which of three has the most, or the least",
    "osc": "which recording is which of three named objects",
    "tsa": "which of two suits a scenario",
}


DIFFERENCES = (
    ("recordings", "VTV150K: 100 objects in the hand, three sensors", "generated objects, a slide and a held press"),
    ("levels", "given by people", "of the object's own friction, returned energy, modulus, relief"),
    ("who answers", "a language model of 7 billion parameters", "linear probes on fixed features of a sensor"),
    ("unseen objects", "not stated", "every object, by probes that no recording of it trained"),
    ("scenarios, names", "written for the benchmark", "six of this project; a name stands for the object's levels"),
    ("intervals", "none", "whole objects resampled"),
)


def score_chart(scored: Scored) -> bytes:
    """Every task: all sensors with intervals, other predictors and the paper's best as points, guessing as marks."""
    tasks = (*VTV, "average")
    chance = {**CHANCE, "average": vtv_average(CHANCE)}
    series = [
        Series("guessing", x=[chance[task] for task in tasks], marker="$|$", size=150.0, colour=SHARED),
        estimates(FUSED, [scored[FUSED][task] for task in tasks], colour=PALETTE[0], marker="o", width=2.4),
    ]
    for name, colour in zip((FORCE, SHAPE, PRIOR), PALETTE[2:], strict=False):
        x = [scored[name][task].mean for task in tasks]
        series.append(Series(name, x=x, colour=colour, marker="s", size=20.0))
    for name, marker in (("VTV-LLM-7B", "d"), ("Ours", "D")):
        values, average = paper.VTV[name]
        x = [*values, average]
        series.append(Series(_published(name), x=x, colour=PALETTE[1], marker=marker, size=36.0, hollow=True))
    rows = [*paper.VTV_COLUMNS, "Average"]
    return draw([Panel(series, rows=rows, x_limits=(0, 100), x_label="right answers (%)")], size=(8.2, 4.6))


DEFAULT = VTVProtocolConfig()

EXPERIMENT = Experiment(
    name="vtv150k",
    config=DEFAULT,
    scales={
        "smoke": dataclasses.replace(
            DEFAULT,
            scenes=SceneConfig(objects=24, sequences=4 * 168, frames=20, image_px=28, contact_grid=24),
            moments=6,
            probe=ProbeConfig(iterations=20),
            questions=96,
        )
    },
    run=run,
)
