"""Answers to the bench's questions, computed from answers about single touches; scores next to the paper's table.

A policy has one touch in its prompt.  It answers a question about several properties one by one, and a question about
one sensor from that sensor alone.  Two touches are compared by the levels that the policy answers for them; if these
are equal, by the mean level over single sensors; if these are equal too, the touch that is shown first counts as the
lesser.  Questions come in all orders, so a constant answer has exactly chance accuracy.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Int

from experiments.bench.contacts import measure_split
from experiments.core.context import Context
from experiments.core.results import Cell, Estimate, Table, named_table
from experiments.core.text import ABSENT, bounds, number
from experiments.study.answers import concluded
from experiments.study.dataset import Dataset
from experiments.study.estimates import RESAMPLES, estimate
from experiments.study.paper_numbers import Row as PaperRow
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.averages import AVERAGED, WORST_OMAE, touch_average
from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import KINDS, Ask, Touch
from touchr1_jax.bench.metrics import BOTTOM, Scores
from touchr1_jax.bench.questions.draw import Quota, draw
from touchr1_jax.bench.scoring import REPORTED, ItemAnswers, score
from touchr1_jax.bench.statistics import (
    TAILS,
    draw_clusters,
    drawn_means,
    improvement_interval,
    stratified_bootstrap_iqm,
)
from touchr1_jax.training.evaluation import Evaluation

ORDINAL_LEVELS = 3  # K of ordinal levels: means of levels over K stay below one level

AVERAGE_MEANING = "mean of the nine columns, OMAE as 100(1 − OMAE/2), ρ as 100ρ"

Estimates = Mapping[str, Estimate]  # metric → estimate, of one row of a table


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleTouchAnswers:
    """Levels answered about n contacts, from all streams and from each alone; −1 where no answer can be read."""

    level: Int[np.ndarray, "n A"]
    alone: Int[np.ndarray, "n S A"]

    @staticmethod
    def of(answers: Evaluation, contacts: int) -> "SingleTouchAnswers":
        """From all answers about some contacts; a policy without touch answers the same whichever sensor is shown."""
        attributes, streams = answers.label.shape[1], answers.streams.shape[1]
        level = np.full((contacts, attributes), BOTTOM)
        alone = np.full((contacts, streams, attributes), BOTTOM)
        n = np.arange(len(answers.contact))
        together = concluded(answers)
        level[answers.contact, answers.attribute] = together
        single = np.repeat(together[:, None], streams, 1)
        if answers.alone is not None:  # of a sensor that recorded nothing the answer is to a prompt without touch
            single = np.where(answers.streams, answers.alone[n, :, answers.attribute], BOTTOM)
        alone[answers.contact, :, answers.attribute] = single
        return SingleTouchAnswers(level=level, alone=alone)

    def strength(self, contact: int, attribute: int) -> float | None:
        """Strength of a property: its level and a fraction from single sensors; `None` where its level is ⊥."""
        level, alone = self.level[contact, attribute], self.alone[contact, :, attribute]
        if level == BOTTOM:
            return None
        read = alone[alone != BOTTOM]
        return float(level) + (float(read.mean()) / ORDINAL_LEVELS if len(read) else 0.0)


def bench_questions(data: Dataset, quota: Quota, context: Context) -> tuple[Ask, ...]:
    """The bench's questions about the test contacts."""
    with context.progress("measuring contacts", len(data.store.contacts_of_split("test"))) as advance:
        contacts = measure_split(data.store, "test", advance).contacts
    return draw(contacts, data.clip.sensors, quota, seed=0)


def bench_answers(data: Dataset, asks: Sequence[Ask], seeds: Sequence[Evaluation]) -> list[dict[str, tuple[int, ...]]]:
    """Answers to the bench's questions that follow from the answers about single touches, for every seed."""
    rows, contacts = touch_rows(data), len(data.parts["test"])
    each = (SingleTouchAnswers.of(answers, contacts) for answers in seeds)
    return [answer_all(asks, single, rows, data.clip.sensors) for single in each]


def touch_rows(data: Dataset) -> dict[Touch, int]:
    """The place of each test contact among the test contacts."""
    keys = [data.store.contacts[int(i)] for i in data.parts["test"]]
    return {Touch(object=k.object_id, site=k.site, motion=k.motion, trial=k.trial): n for n, k in enumerate(keys)}


def answer_all(
    asks: Iterable[Ask], single: SingleTouchAnswers, rows: Mapping[Touch, int], sensors: Sequence[str]
) -> dict[str, tuple[int, ...]]:
    """The levels that answer each question, keyed by its id, −1 for ⊥; `rows` are the places of touches in `single`."""
    return {ask.id: _answer(ask, single, [rows[t] for t in ask.touches], sensors) for ask in asks}


def _answer(ask: Ask, single: SingleTouchAnswers, rows: list[int], sensors: Sequence[str]) -> tuple[int, ...]:
    asked = [ATTRIBUTES.index(name) for name in ask.attributes]
    if ask.kind == "one_sensor":
        return (int(single.alone[rows[0], sensors.index(ask.sensors[0]), asked[0]]),)
    if ask.kind not in ("compare", "order"):
        return tuple(int(single.level[rows[0], a]) for a in asked)
    strengths = [single.strength(row, asked[0]) for row in rows]
    known = [s for s in strengths if s is not None]
    if len(known) < len(strengths):
        return (BOTTOM,)
    rising = tuple(int(i) for i in np.argsort(known, kind="stable"))
    return (rising[-1],) if ask.kind == "compare" else (ORDERS.index(rising),)


def bench_row(
    asks: Sequence[Ask], answers: Sequence[ItemAnswers], by_picture: Sequence[ItemAnswers] | None = None
) -> dict[str, Estimate]:
    """Every metric of the bench that the questions define, and their average where all of its metrics are there.

    A metric about a single object has no interval and is left out, and so is one that some seed lacks.
    """
    priors: Sequence[ItemAnswers | None] = [None] * len(answers) if by_picture is None else by_picture
    tables = [score(asks, given, prior) for given, prior in zip(answers, priors, strict=True)]
    objects = np.array([ask.cluster for ask in asks])
    several = lambda scores: len(np.unique(objects[scores.items])) > 1
    shared = [name for name in tables[0] if all(name in table and several(table[name]) for table in tables)]
    row = {name: estimate([table[name] for table in tables], objects) for name in shared}
    return row | ({"avg": average(tables, objects)} if set(AVERAGED) <= set(shared) else {})


def average(tables: Sequence[Mapping[str, Scores]], objects: np.ndarray) -> Estimate:
    """`touch_average` of every seed, and its interval: one resample of the objects serves all metrics and seeds."""
    cluster, weights = draw_clusters(objects, resamples=RESAMPLES)

    def drawn(table: Mapping[str, Scores]) -> np.ndarray:
        means = {n: drawn_means(s.values, cluster[s.items], s.strata, weights) for n in AVERAGED for s in (table[n],)}
        whole = np.all([np.isfinite(m) for m in means.values()], axis=0)
        return np.array([touch_average({n: m[i] for n, m in means.items()}) for i in np.flatnonzero(whole)])

    each = tuple(touch_average({name: table[name].mean() for name in AVERAGED}) for table in tables)
    low, high = np.quantile(np.mean([drawn(table) for table in tables], axis=0), TAILS)
    return Estimate(mean=float(np.mean(each)), ci95=(float(low), float(high)), per_seed=each)


def comparison_table(
    title: str, ours: Mapping[str, Estimates], theirs: Mapping[str, tuple[PaperRow, float] | None], note: str
) -> Table:
    """Our rows, then the paper's with their printed averages, in the columns of its main table."""
    titles = {m: REPORTED[m].title for m in AVERAGED}
    rows: list[dict[str, Cell]] = []
    for name, row in ours.items():
        means = {heading: row[m].mean if m in row else None for m, heading in (titles | {"avg": "Avg"}).items()}
        rows.append({"row": name, **means, "Avg as printed": None})
    for name, printed in theirs.items():
        cells: dict[str, Cell] = {"row": f"{name} (paper)"}
        if printed is not None:
            values = dict(zip(AVERAGED, printed[0], strict=True))
            cells |= {titles[m]: value for m, value in values.items()}
            cells |= {"Avg": touch_average(values), "Avg as printed": printed[1]}
        rows.append(cells)
    return named_table(
        title,
        rows,
        formats={titles[m]: REPORTED[m].format for m in AVERAGED} | {"Avg": ".1f", "Avg as printed": ".1f"},
        units={titles[m]: REPORTED[m].unit for m in AVERAGED},
        meanings={"Avg": AVERAGE_MEANING, "Avg as printed": "the paper's own, whose formula is not given"},
        note=note,
    )


def question_table(asks: Sequence[Ask]) -> Table:
    """Number of questions of each kind, and of the objects that they are about."""
    kinds = {kind: [ask for ask in asks if ask.kind == kind] for kind in KINDS}
    rows: list[dict[str, Cell]] = [
        {
            "kind": kind,
            "tier": KINDS[kind].tier,
            "questions": len(of),
            "objects": len({touch.object for ask in of for touch in ask.touches}),
            "asks for": KINDS[kind].meaning,
        }
        for kind, of in kinds.items()
        if of
    ]
    return named_table("Questions", rows, formats=dict.fromkeys(("tier", "questions", "objects"), "d"))


def pooled_table(rows: Mapping[str, Estimates], against: str) -> tuple[Table, ...]:
    """Every row of two seeds or more, pooled over its columns: interquartile mean and probability of improvement.

    Rows of one seed, baselines, are left out; there is no table where `against`, which others are compared with, has
    one.
    """
    trained = {name: row for name, row in rows.items() if all(len(e.per_seed) > 1 for e in row.values())}
    if against not in trained:
        return ()
    columns = [m for m in AVERAGED if all(m in row for row in trained.values())]
    scores = {name: np.stack([_share(m, row[m].per_seed) for m in columns], axis=1) for name, row in trained.items()}
    lines: list[dict[str, Cell]] = []
    better = f"P(better than {against})"
    for name, values in scores.items():
        iqm, gain = stratified_bootstrap_iqm(values), improvement_interval(values, scores[against])
        compared: dict[str, Cell] = {better: ABSENT, "95 % of P": ABSENT}
        if name != against:
            compared = {better: number(gain.mean, ".2f"), "95 % of P": bounds(gain.low, gain.high, ".2f")}
        span = bounds(iqm.low, iqm.high, ".1f")
        lines.append({"row": name, "IQM": number(iqm.mean, ".1f"), "95 % of the IQM": span, **compared})
    titles = ", ".join(REPORTED[m].title for m in columns)
    table = named_table(
        "Pooled over seeds and columns",
        lines,
        units={"IQM": "%"},
        meanings={
            "IQM": "interquartile mean over seeds and columns",
            "95 % of the IQM": "the seeds of each column resampled on their own",
            better: "probability of improvement, ties count half",
            "95 % of P": "the seeds of both sides resampled on their own",
        },
        note=f"Columns: {titles}; OMAE as 100(1 − OMAE/2), ρ as 100ρ. After Agarwal et al., Deep RL at the Edge of the "
        "Statistical Precipice (2021). These intervals resample seeds alone; the other tables' resample objects.",
    )
    return (table,)


def _share(metric: str, per_seed: Sequence[float]) -> np.ndarray:
    """The values of a column as shares in percent: 100 is right, higher is better."""
    values = np.asarray(per_seed)
    return {"omae": 100 * (1 - values / WORST_OMAE), "soi_rho": 100 * values}.get(metric, values)
