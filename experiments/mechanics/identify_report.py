"""Figures, tables and pictures of `identifiability`."""

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw, estimates
from experiments.core.look import PALETTE, SHARED
from experiments.core.results import Cell, Picture, Table, named_table
from experiments.core.text import number
from experiments.mechanics.identify_motions import MotionData
from experiments.mechanics.identify_presses import PressData
from experiments.mechanics.identify_probes import (
    DYNAMIC,
    FORCE,
    FUSED,
    LEVELS,
    SHAPE,
    SOURCES,
    STATIC,
    Answers,
)
from experiments.study.estimates import points
from sensors_io.schema import SENSORS
from touchr1_jax.bench.statistics import Interval

MAY_LOSE = 2.0
"""Points that a tier may lose."""

CHANCE = 100 / LEVELS

LINEAR_POINTS = 5.0
"""The axis of lost points is linear up to here and logarithmic beyond: springs lose ten times what tiers lose."""

ENDS = {"from": "lower end of the 95 % interval over objects", "to": "upper end"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyPredictions:
    """Predictions of all probes, and their accuracies in % and losses in points, with intervals over objects.

    By touch and force at each level of `noise`, multiples of the sensors' own, and without touch; trained at each tier,
    about that tier's own records and about the exact ones; by motion, the press too, without force and without touch.
    """

    noise: tuple[float, ...]
    exact: str
    solved: tuple[str, ...]
    springs: str
    touch: Sequence[Answers]
    blind: Answers
    tiers: Mapping[str, Sequence[Answers]]
    motion: Mapping[str, Answers]
    still: Mapping[str, Answers]
    pressed: PressData
    moved: dict[str, MotionData]

    @property
    def own(self) -> int:
        """Level of the sensors' own noise."""
        return self.noise.index(1.0)

    def losses(self, tier: str, name: str, sources: tuple[str, ...]) -> np.ndarray:
        """Right answers about exact records less those by training at a tier instead, paired, [n, sources]."""
        exact = [self.touch[self.own][name, source].right for source in sources]
        cheap = [self.tiers[tier][1][name, source].right for source in sources]
        return np.stack(exact, 1) - np.stack(cheap, 1)

    @functools.cached_property
    def accuracy(self) -> dict[tuple[str, str, int], Interval]:
        """Accuracy by property, source and level of noise."""
        return {
            (*key, level): points(one.right, self.pressed.objects)
            for level, answers in enumerate(self.touch)
            for key, one in answers.items()
        }

    @functools.cached_property
    def blind_accuracy(self) -> dict[tuple[str, str], Interval]:
        """Accuracy without touch by property and source."""
        return {key: points(answers.right, self.pressed.objects) for key, answers in self.blind.items()}

    @functools.cached_property
    def lost(self) -> dict[tuple[str, str], Interval]:
        """Loss by tier and property, mean over sensors."""
        keys = itertools.product((*self.solved, self.springs), STATIC)
        return {key: points(self.losses(*key, SENSORS), self.pressed.objects) for key in keys}

    def lost_by(self, tier: str, name: str, source: str) -> float:
        """Loss of one source, without interval."""
        return 100 * float(self.losses(tier, name, (source,)).mean())

    @functools.cached_property
    def moved_accuracy(self) -> dict[tuple[str, str], Interval]:
        """Accuracy of all sensors without force by property and motion."""
        objects = {"press": self.pressed.objects} | {motion: data.objects for motion, data in self.moved.items()}
        keys = itertools.product(DYNAMIC, self.motion)
        return {
            (name, motion): points(self.motion[motion][name, FUSED].right, objects[motion]) for name, motion in keys
        }


def touch_table(studied: StudyPredictions) -> Table:
    """Accuracy of every property by every source over the noise."""
    rows: list[dict[str, Cell]] = []
    for name, source in itertools.product(STATIC, SOURCES):
        own = studied.accuracy[name, source, studied.own]
        rows.append(
            {
                "property, sensor": f"{name}, {source}",
                **{f"noise ×{f:g}": studied.accuracy[name, source, i].mean for i, f in enumerate(studied.noise)},
                "×1 from": own.low,
                "×1 to": own.high,
                "two levels off": studied.touch[studied.own][name, source].far_off,
            }
        )
    return _percent_table(
        "Accuracy of touch and force on unseen objects",
        rows,
        {
            **{f"noise ×{f:g}": "right answers" for f in studied.noise},
            **{f"×1 {end}": meaning for end, meaning in ENDS.items()},
            "two levels off": "at the sensors' own noise",
        },
        f"Probes are trained and tested at the same noise, on {studied.exact}; guessing gives {CHANCE:.0f} %. "
        "The noise of fields and cameras is multiplied; that of units, mountings and the force sensor stays.",
    )


def blind_table(studied: StudyPredictions) -> Table:
    """Accuracy without touch."""
    rows: list[dict[str, Cell]] = []
    for name in STATIC:
        row: dict[str, Cell] = {"property": name}
        for source in (SHAPE, FORCE):
            one = studied.blind_accuracy[name, source]
            row |= {source: one.mean, f"{source}, from": one.low, f"{source}, to": one.high}
        counts = np.bincount(studied.pressed.levels[name])
        rows.append(row | {"commonest level": 100 * float(counts.max()) / len(studied.pressed.objects)})
    return _percent_table(
        "Accuracy without touch",
        rows,
        {
            SHAPE: "statistics of the true gap, noiseless",
            **{f"{SHAPE}, {end}": meaning for end, meaning in ENDS.items()},
            FORCE: "the forces measured by all four sensors",
            **{f"{FORCE}, {end}": meaning for end, meaning in ENDS.items()},
            "commonest level": "its share of the objects",
        },
        "Roughness and protrusion are shape, so true shape is their ceiling. Materials tie hardness to shape.",
    )


def tier_table(studied: StudyPredictions) -> Table:
    """Accuracy on exact records of probes trained at each tier."""
    rows: list[dict[str, Cell]] = []
    for (tier, name), lost in studied.lost.items():
        right = [[answers[name, sensor].right for sensor in SENSORS] for answers in studied.tiers[tier]]
        own, exact = (100 * float(np.mean(of_records)) for of_records in right)
        rows.append(
            {
                "tier: property": f"{tier}: {name}",
                "own records": own,
                "exact records": exact,
                "lost": lost.mean,
                "from": lost.low,
                "to": lost.high,
                **{source: studied.lost_by(tier, name, source) for source in SOURCES},
            }
        )
    return _percent_table(
        "Trained at a tier, tested on exact records",
        rows,
        {
            "own records": "right about unseen objects at the same tier",
            "exact records": f"right about them at {studied.exact}",
            "lost": "compared with training on exact records, mean over sensors",
            **ENDS,
            **dict.fromkeys(SOURCES, "lost by it"),
        },
        "The same presses with the same noise at every tier, which is named by the points of its grid and a looser "
        "tolerance of the solver; springs do not act on each other. A coarse grid leaves out short waves of the skin.",
        in_points=("lost", "from", "to", *SOURCES),
    )


def motion_table(studied: StudyPredictions) -> Table:
    """Friction and elasticity by motion, by touch without force and without touch."""
    percent = lambda answers: 100 * float(answers.right.mean())
    rows: list[dict[str, Cell]] = []
    for name, motion in itertools.product(DYNAMIC, studied.motion):
        fused = studied.moved_accuracy[name, motion]
        rows.append(
            {
                "property by motion": f"{name} by {motion}",
                **{sensor: percent(studied.motion[motion][name, sensor]) for sensor in SENSORS},
                FUSED: fused.mean,
                "from": fused.low,
                "to": fused.high,
                **{source: percent(studied.still[motion][name, source]) for source in (SHAPE, FORCE)},
            }
        )
    return _percent_table(
        "Elasticity and friction by motion",
        rows,
        {
            **dict.fromkeys(SENSORS, "right answers of touch without force"),
            FUSED: "their product",
            **ENDS,
            SHAPE: "statistics of the true gap",
            FORCE: "forces along three axes: in a slide they are friction itself",
        },
        "A press neither slides nor unloads: its accuracy on the two properties comes from the material.",
    )


def noise_picture(studied: StudyPredictions) -> Picture:
    """Accuracy of every source over the noise."""
    at = range(len(studied.noise))
    shifts = dict(zip(SOURCES, np.linspace(-0.12, 0.12, len(SOURCES)), strict=True))
    panels = [
        Panel(
            [
                estimates(s, [studied.accuracy[name, s, level] for level in at], at=at, shift=float(shift))
                for s, shift in shifts.items()
            ],
            title=name,
            x_label="noise",
            y_label="right on unseen objects, %" if name == STATIC[0] else "",
            x_ticks={float(i): f"×{factor:g}" for i, factor in enumerate(studied.noise)},
            x_limits=(-0.35, len(at) - 0.65),
            rules=[
                Rule(y=studied.blind_accuracy[name, SHAPE].mean, name=SHAPE, line="--", colour=SHARED),
                Rule(y=studied.blind_accuracy[name, FORCE].mean, name=FORCE, line=":", colour=SHARED),
                Rule(y=CHANCE, name="guessing", line="-", colour=SHARED, width=0.6),
            ],
        )
        for name in STATIC
    ]
    return Picture(
        name="identifiability",
        title="Accuracy of touch over noise",
        caption="Right answers about unseen objects, with 95 % intervals over objects. The lines use no touch; shape "
        "is the ceiling for roughness and protrusion.",
        content=draw(panels, share_y=True, size=(9.3, 3.5)),
    )


def tier_picture(studied: StudyPredictions) -> Picture:
    """Points lost by tier."""
    tiers = list(dict.fromkeys(tier for tier, _ in studied.lost))
    panels = []
    for name in STATIC:
        lost = [studied.lost[tier, name] for tier in tiers]
        colour = [PALETTE[0] if one.mean <= MAY_LOSE else PALETTE[1] for one in lost]
        each = [(studied.lost_by(tier, name, s), row) for row, tier in enumerate(tiers) for s in SENSORS]
        x, y = zip(*each, strict=True)
        panels.append(
            Panel(
                [
                    estimates("", lost, bar=True, colour=colour, alpha=0.45),
                    Series(x=x, y=y, line="", marker="o", size=8, colour=SHARED, alpha=0.7),
                ],
                title=name,
                x_label="points lost",
                x_scale="symlog",
                linear_to=LINEAR_POINTS,
                x_ticks={float(tick): number(tick) for tick in (-5, -2, 0, 2, 5, 10, 20, 50)},
                rows=tiers,
                rules=[Rule(x=0, line="-", colour=SHARED, width=0.8), Rule(x=MAY_LOSE, colour=SHARED)],
            )
        )
    return Picture(
        name="label_transfer",
        title="Loss by a cheaper contact",
        caption="Points lost on exact records by training on those of a cheaper contact, mean over sensors with 95 % "
        f"interval; dots are single sensors. Dotted: the greatest loss allowed, {MAY_LOSE:g} points; orange: exceeded.",
        content=draw(panels, share_x=True, share_y=True, size=(9.7, 0.9 + 0.36 * len(tiers))),
    )


def _percent_table(
    title: str,
    rows: Sequence[Mapping[str, Cell]],
    meanings: Mapping[str, str],
    note: str,
    in_points: Sequence[str] = (),
) -> Table:
    figures = list(meanings)
    return named_table(
        title,
        rows,
        formats=dict.fromkeys(figures, ".1f"),
        units=dict.fromkeys(figures, "%") | dict.fromkeys(in_points, "points"),
        meanings=meanings,
        note=note,
    )
