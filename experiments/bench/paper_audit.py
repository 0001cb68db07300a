"""Do the published numbers of Touch-R1 agree with one another?

    make experiment EXP=paper_audit

Every number of the paper that a conclusion hangs on is typed in `study/paper_numbers.py` under the table or section it
stands in; every inconsistency is a check that computes anew what follows from them, with rounding granted.  Nothing is
trained and no data is read.

Cost: seconds.

Expected: fourteen statements that its own numbers contradict, do not support or leave open, beside ten that they bear
out.  So results here are held to the directions of the paper, never to its values.
"""

import dataclasses

from experiments.bench.paper_arithmetic import best_weighting, columns_as_scores, error_and_distance, gain_interval
from experiments.bench.paper_arithmetic import impossible_distances as impossible
from experiments.bench.paper_charts import average_against_mean, distance_against_error
from experiments.bench.paper_checks import StatementCheck, holding, inconsistencies
from experiments.core.context import Context
from experiments.core.results import Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.study import paper_numbers as paper


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperAuditConfig:
    """Nothing to choose but how many questions a property of VTV150K's test set has."""

    vtv_items: int = paper.VTV_ITEMS

    def __post_init__(self) -> None:
        if self.vtv_items < 1:
            raise ValueError(f"vtv_items is {self.vtv_items}: must be ≥ 1; give the size of the test set")


def run(config: PaperAuditConfig, context: Context) -> Results:
    """Compute every check."""
    del context
    wrong, right = inconsistencies(), holding()
    standing = [check for check in wrong if check.verdict == "holds"]
    broken = [check for check in right if check.verdict != "holds"]
    count = {name: sum(c.verdict == name for c in wrong) for name in ("contradiction", "unsupported", "not given")}
    return Results(
        verdict=(
            f"{len(wrong)} statements do not stand: {count['contradiction']} are contradicted by the paper's own "
            f"numbers, {count['unsupported']} are not supported by them, {count['not given']} lack what is needed to "
            "tell.",
            f"{len(right)} others are borne out to the rounding: gains over other models, VTV150K's averages, the size "
            "of the data set.",
        ),
        requirements=(
            Requirement(name="known inconsistencies that do not show", measured=len(standing), bound=0, better="lower"),
            Requirement(name="statements taken to hold that fail", measured=len(broken), bound=0, better="lower"),
        ),
        tables=(
            _checks("What does not stand", wrong),
            _checks("What holds", right),
            _averages(),
            _distances(),
            _vtv(config),
        ),
        pictures=(
            Picture(
                name="distance",
                title="OMAE against the error rate",
                caption="Each wrong answer is at least one level off, so no row can lie below the diagonal; Touch-R1 "
                "and the upper rungs of its ablation do.",
                content=distance_against_error(),
            ),
            Picture(
                name="average",
                title="Avg against the mean of its columns",
                caption="OMAE as 100(1 − OMAE/2), ρ as 100ρ.",
                content=average_against_mean(),
            ),
        ),
    )


def _checks(title: str, checks: tuple[StatementCheck, ...]) -> Table:
    return Table(
        title=title,
        columns=(
            Column(name="statement, and where"),
            Column(name="verdict"),
            Column(name="published"),
            Column(name="recomputed"),
        ),
        rows=tuple((f"{c.title} ({c.where})", c.verdict, c.published, c.recomputed) for c in checks),
    )


def _averages() -> Table:
    low, high, average = columns_as_scores()
    best = best_weighting(sum_to_one=True)
    middle = (low + high) / 2
    return Table(
        title="Avg",
        columns=(
            Column(name="model"),
            Column(name="printed", format=".1f"),
            Column(name="mean of nine", format=".1f"),
            Column(name="best weights", format=".1f", meaning="the mean whose weights miss least, and are ≥ 0"),
        ),
        rows=tuple(
            (name, float(a), float(m.mean()), float(m @ best.weights))
            for name, a, m in zip(paper.MAIN, average, middle, strict=True)
        ),
        note="Best weights: "
        + ", ".join(f"{c} {w:.2f}" for c, w in zip(paper.COLUMNS, best.weights, strict=True) if w > 0.005),
    )


def _distances() -> Table:
    below = set(impossible())
    return Table(
        title="OMAE and its bound",
        columns=(
            Column(name="row"),
            Column(name="1 − Acc", format=".3f", meaning="of the mean of H-, R- and P-Acc: least possible OMAE"),
            Column(name="OMAE", format=".2f"),
            Column(name="possible"),
        ),
        rows=tuple((name, error, omae, name not in below) for name, (error, omae) in error_and_distance().items()),
    )


def _vtv(config: PaperAuditConfig) -> Table:
    ours, theirs = paper.VTV["Ours"][0], paper.VTV["VTV-LLM-7B"][0]
    rows = []
    for column, a, b in list(zip(paper.VTV_COLUMNS, ours, theirs, strict=True))[:5]:
        gain, half, p = gain_interval(a, b, config.vtv_items)
        rows.append((column, a, b, gain, f"[{gain - half:.1f}, {gain + half:.1f}]", p))
    return Table(
        title=f"Gains on VTV150K, {config.vtv_items} questions a property",
        columns=(
            Column(name="property"),
            Column(name="Touch-R1", unit="%", format=".1f"),
            Column(name="VTV-LLM", unit="%", format=".1f"),
            Column(name="gain", unit="points", format=".1f"),
            Column(name="95 %", meaning="unpaired: the answers are not published"),
            Column(name="p", format=".2f"),
        ),
        rows=tuple(rows),
    )


DEFAULT = PaperAuditConfig()

EXPERIMENT = Experiment(name="paper_audit", config=DEFAULT, scales={"smoke": DEFAULT}, run=run)
