"""Answered levels against the true ones: confusions, reliability, and agreement between sensors."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.charts import Panel, Series, draw, estimates
from experiments.core.look import PALETTE
from experiments.core.pictures import Heatmap, heatmaps
from experiments.core.results import Cell, Picture, Table, named_table
from experiments.study.estimates import object_interval
from experiments.study.study import BLIND, SFT, Study
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import BOTTOM, ORDINAL
from touchr1_jax.bench.sampled import Votes, calibration_error, majority, pass_at_k, reliability, samples_right
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.training.evaluation import Evaluation

RESAMPLES = 1_000  # of each interval over objects; its ends are then accurate to a tenth of its width

_COLUMNS = [ATTRIBUTES.index(name) for name in ORDINAL]

Words = Mapping[str, Sequence[str]]  # attribute → names of its levels, in order


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelAnswers:
    """Answers of one policy, its seeds one after the other: levels and labels int [N, A], objects [N].

    `BOTTOM` marks answers that could not be parsed and attributes that were not asked for; `agree` [N, A] counts the
    sensors that, given alone, lead to the answer given by all together.
    """

    answer: np.ndarray
    label: np.ndarray
    objects: np.ndarray
    agree: np.ndarray | None = None


def level_report(study: Study) -> tuple[tuple[Picture, ...], tuple[Table, ...]]:
    """Confusions of every policy, accuracy by agreement of its sensors, the reliability of levels, sampled answers."""
    objects = study.data.object_ids[study.data.parts["test"]]
    rows = {name: _level_answers(study.answers[name], objects) for name in (*study.policies, BLIND)}
    language = study.policy.language
    words = {n: [level[0] for level in language.attributes[language.attribute_index(n)].levels] for n in ORDINAL}
    confusions = Picture(
        name="confusions",
        title="Confusion matrices",
        caption="Share of each answer among the test questions with one label, and their number; seeds pooled.",
        content=confusion_chart(rows, words),
    )
    pictures, tables = sampled_report(study)
    tables = (reliability_table({name: rows[name] for name in study.policies}, words), *tables)
    read = lambda of: of.agree is not None and np.any(of.answer != BOTTOM)
    with_agreement = {name: answers for name, answers in rows.items() if read(answers)}
    if not with_agreement:
        return (confusions, *pictures), tables
    if len(with_agreement) > len(PALETTE):  # more lines than colours: keep where training begins and where it ends
        with_agreement = {name: rows[name] for name in (SFT, list(study.arms)[-1]) if name in with_agreement}
    trust = Picture(
        name="trust",
        title="Accuracy by agreement of the sensors",
        caption="Right answers by the number of sensors that, given alone, lead to the same answer as all together; "
        "areas are shares of the answers, lines 95 % over objects; hardness, roughness, protrusion and all seeds "
        "pooled.",
        content=agreement_chart(with_agreement),
    )
    return (confusions, trust, *pictures), tables


def _level_answers(seeds: Sequence[Evaluation], objects: np.ndarray) -> LevelAnswers:
    agree = []
    for answers in seeds:
        if answers.alone is not None:
            same = (answers.alone == np.asarray(answers.parsed.conclude)[:, None]) & (answers.alone != BOTTOM)
            agree.append((same & answers.streams[:, :, None]).sum(1)[:, _COLUMNS])
    return LevelAnswers(
        answer=np.concatenate([np.asarray(answers.parsed.conclude)[:, _COLUMNS] for answers in seeds]),
        label=np.concatenate([answers.label[:, _COLUMNS] for answers in seeds]),
        objects=np.concatenate([objects[answers.contact] for answers in seeds]),
        agree=np.concatenate(agree) if len(agree) == len(seeds) else None,
    )


def confusion_chart(rows: Mapping[str, LevelAnswers], words: Words) -> bytes:
    """Draw one confusion matrix for each policy and attribute; attribute a of the answers is the a-th of `words`."""
    maps = [
        confusion_map(answers.answer[:, a], answers.label[:, a], levels, f"{name}: {attribute}")
        for name, answers in rows.items()
        for a, (attribute, levels) in enumerate(words.items())
    ]
    return heatmaps(maps, columns=len(words), x_label="answered", y_label="label")


def confusion_map(answer: np.ndarray, label: np.ndarray, levels: Sequence[str], title: str) -> Heatmap:
    """Labels down, answers [N] across, shares of a row; a last column if some answer could not be parsed."""
    asked = label != BOTTOM
    columns = [*levels, "unread"] if np.any(answer[asked] == BOTTOM) else list(levels)
    count = np.zeros((len(levels), len(levels) + 1), int)
    np.add.at(count, (label[asked], answer[asked]), 1)  # an unparsed answer, −1, falls into the last column
    count = count[:, : len(columns)]
    share = count / np.maximum(count.sum(1, keepdims=True), 1)
    cells = [[f"{s:.0%}\n{c}" for s, c in zip(*row, strict=True)] for row in zip(share, count, strict=True)]
    return Heatmap(share, rows=levels, columns=columns, title=title, cells=cells)


def reliability_table(rows: Mapping[str, LevelAnswers], words: Words) -> Table:
    """For every level of what was asked: how often it is answered, its precision and its recall."""
    lines: list[dict[str, Cell]] = []
    for name, answers in rows.items():
        for a, (attribute, levels) in enumerate(words.items()):
            asked = answers.label[:, a] != BOTTOM
            if not asked.any():
                continue
            answer, label, objects = answers.answer[asked, a], answers.label[asked, a], answers.objects[asked]
            lines += [
                {
                    "policy and level": f"{name}: {attribute} {level}",
                    "answered": 100 * float(np.mean(answer == k)),
                    "precision": object_interval(100.0 * (label == k)[answer == k], objects[answer == k]),
                    "recall": object_interval(100.0 * (answer == k)[label == k], objects[label == k]),
                }
                for k, level in enumerate(levels)
            ]
    return named_table(
        "Precision and recall of each level",
        lines,
        formats={"answered": ".1f"},
        units=dict.fromkeys(("answered", "precision", "recall"), "%"),
        meanings={"answered": "of all questions about the attribute"}
        | dict.fromkeys(("precision", "recall"), "95 % over objects"),
        note="A policy that favours a level has a high recall and a low precision on it.",
    )


def agreement_chart(rows: Mapping[str, LevelAnswers]) -> bytes:
    """Draw the share of right answers over the number of agreeing sensors; areas are shares of answers."""
    series = []
    for i, (name, answers) in enumerate(rows.items()):
        counts, right, weight = accuracy_by_agreement(answers)
        shift = 0.06 * (i - (len(rows) - 1) / 2)
        series.append(estimates(name, right, at=counts, size=12 + 300 * weight, shift=shift))
    every = sorted({float(count) for one in series for count in one.x})
    panel = Panel(
        series,
        x_label="sensors that, given alone, lead to the same answer",
        y_label="right (%)",
        y_limits=(0, 100),
        x_ticks={count: f"{count:g}" for count in every},
    )
    return draw([panel], size=(6.6, 3.6))


def accuracy_by_agreement(answers: LevelAnswers) -> tuple[list[int], list[Interval], np.ndarray]:
    """For each number of agreeing sensors: share of right answers with its interval, and its share of all answers."""
    if answers.agree is None:
        raise ValueError("agree is None: needs answers from single sensors; ask with each sensor alone")
    parsed = (answers.label != BOTTOM) & (answers.answer != BOTTOM)
    objects = np.broadcast_to(answers.objects[:, None], parsed.shape)[parsed]
    agree, right = answers.agree[parsed], (answers.answer == answers.label)[parsed]
    counts, intervals, weight = [], [], []
    for count in np.unique(agree):
        at = agree == count
        if len(np.unique(objects[at])) > 1:
            counts.append(int(count))
            intervals.append(clustered_bootstrap(100.0 * right[at], objects[at], resamples=RESAMPLES))
            weight.append(float(np.mean(at)))
    return counts, intervals, np.array(weight)


def sampled_report(study: Study) -> tuple[tuple[Picture, ...], tuple[Table, ...]]:
    """Scores of sampled answers and a picture of their calibration; nothing where no answers were sampled."""
    objects = study.data.object_ids[study.data.parts["test"]]
    rows = {name: study.answers[name] for name in (*study.policies, BLIND)}
    rows = {name: seeds for name, seeds in rows.items() if all(one.sampled is not None for one in seeds)}
    if not rows:
        return (), ()
    picture = Picture(
        name="calibration",
        title="Calibration",
        caption="Right majority answers over the share of the samples that agree with them; seeds pooled, areas are "
        "shares of the questions.  A calibrated policy lies on the diagonal.",
        content=calibration_chart({name: pooled_votes(seeds) for name, seeds in rows.items()}),
    )
    return (picture,), (sampled_table(rows, objects),)


def pooled_votes(seeds: Sequence[Evaluation]) -> Votes:
    """Votes of all seeds, one after the other."""
    votes = [majority(np.asarray(one.sampled), one.label) for one in seeds]
    return Votes(*(np.concatenate(x) for x in zip(*votes, strict=True)))


def sampled_table(rows: Mapping[str, Sequence[Evaluation]], objects: np.ndarray) -> Table:
    """Greedy accuracy, pass@1, pass@k, maj@k and ECE of every policy; `objects` are those of the test contacts."""
    lines: list[dict[str, Cell]] = []
    for name, seeds in rows.items():
        right = np.concatenate([samples_right(np.asarray(one.sampled), one.label) for one in seeds])
        greedy = [samples_right(np.asarray(one.parsed.conclude)[:, None], one.label)[:, 0] for one in seeds]
        of = np.concatenate([objects[one.contact] for one in seeds])
        votes, k = pooled_votes(seeds), right.shape[1]
        shown = {
            "greedy": np.concatenate(greedy),
            "pass@1": pass_at_k(right, 1),
            f"pass@{k}": pass_at_k(right, k),
            f"maj@{k}": votes.right,
        }
        cells = {title: object_interval(100.0 * x, of) for title, x in shown.items()}
        lines.append({"policy": name, **cells, "ECE": 100 * calibration_error(votes)})
    titles = [title for title in lines[0] if title != "policy"]
    return named_table(
        "Sampled answers",
        lines,
        formats={"ECE": ".1f"},
        units=dict.fromkeys(titles, "%"),
        meanings={"ECE": "mean distance between confidence, the share of samples that agree, and accuracy"},
        note="All questions, at temperature 1, with all sensors; 95 % over objects, seeds pooled.",
    )


def calibration_chart(votes: Mapping[str, Votes]) -> bytes:
    """Draw the share of right majority answers over their confidence, with the diagonal of a calibrated policy."""
    series = [Series(x=[0, 100], y=[0, 100], line=":", marker="", colour="grey")]
    for name, found in votes.items():
        bins = reliability(found)
        share = np.array([b.number for b in bins]) / len(found.right)
        x, y = ([100 * getattr(b, field) for b in bins] for field in ("confidence", "right"))
        series.append(Series(name, x=x, y=y, size=12 + 300 * share))
    panel = Panel(
        series,
        x_label="samples that agree with the majority (%)",
        y_label="right (%)",
        x_limits=(0, 103),
        y_limits=(0, 100),
    )
    return draw([panel], size=(5.2, 3.8))
