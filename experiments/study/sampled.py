"""Sampled answers to the test questions: pass@k and majority votes next to greedy answers, and calibration."""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.results import Cell, Picture, Table, named_table
from experiments.study.estimates import object_interval
from experiments.study.study import BLIND, Study
from touchr1_jax.bench.sampled import Votes, calibration_error, majority, pass_at_k, reliability, samples_right
from touchr1_jax.training.evaluation import Evaluation


def sampled_report(study: Study) -> tuple[tuple[Picture, ...], tuple[Table, ...]]:
    """Scores of sampled answers and a picture of their calibration; nothing where no answers were sampled."""
    objects = study.data.object_ids[study.data.parts["test"]]
    rows = {name: study.answers[name] for name in (*study.policies, BLIND)}
    rows = {name: seeds for name, seeds in rows.items() if all(one.sampled is not None for one in seeds)}
    if not rows:
        return (), ()
    picture = Picture(
        name="calibration",
        title="How sure the policies are, and how often they are right",
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
