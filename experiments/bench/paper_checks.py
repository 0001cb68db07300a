"""What the printed numbers of Touch-R1 say about one another, each statement computed anew.

A check holds what is printed against what follows from the rest of it.
"""

import dataclasses
import math
from typing import Literal

from experiments.bench.paper_arithmetic import (
    SHARE_ROUNDING,
    TOUCHES,
    attainable,
    best_weighting,
    columns_as_scores,
    error_and_distance,
    gain_interval,
    impossible_distances,
    perfect_average,
)
from experiments.study import paper_numbers as paper
from touchr1_jax.bench.statistics import wilson_interval

Verdict = Literal["contradiction", "not given", "unsupported", "holds"]

OURS = "Touch-R1-7B"


@dataclasses.dataclass(frozen=True, kw_only=True)
class StatementCheck:
    """One statement about the paper: where it stands, what is printed, what follows, and which of the two it is."""

    title: str
    where: str
    published: str
    recomputed: str
    verdict: Verdict


def inconsistencies() -> tuple[StatementCheck, ...]:
    """Every known inconsistency, in the order of the report."""
    return (
        _average(),
        _ladder_average(),
        _two_tables(),
        _distance(),
        _tactile_use(),
        _hyperparameters(),
        _conflict(),
        _subsets(),
        _backbones(),
        _noise(),
        _seeds(),
        _sequences(),
        _counts(),
        _pictures(),
    )


def holding() -> tuple[StatementCheck, ...]:
    """Statements of the paper that its numbers bear out."""
    gains = [
        StatementCheck(
            title=f"{column} over {whom}",
            where=where,
            published=f"{gain:+.1f}",
            recomputed=f"{_column(OURS, column) - _column(whom, column):+.1f} points",
            verdict="holds" if abs(_column(OURS, column) - _column(whom, column) - gain) < SHARE_ROUNDING else _NO,
        )
        for where, column, whom, gain in paper.GAINS
    ]
    return (*gains, _vtv_average(), _frames(), _shared_rows(), _audit())


_NO: Verdict = "contradiction"


def _column(model: str, column: str) -> float:
    row, average = paper.MAIN[model]
    return average if column == "Avg" else row[paper.COLUMNS.index(column)]


def _average() -> StatementCheck:
    mean = best_weighting(sum_to_one=True)
    low, high, average = columns_as_scores()
    plain = ((low + high) / 2).mean(1)
    return StatementCheck(
        title="Avg is no mean of the columns",
        where="main table, Avg “over the full metric set”",
        published=f"Avg {average[-1]} for {OURS}",
        recomputed=f"the plain mean is {plain[-1]:.1f}; every weighted one misses some model by {mean.miss:.2f} points "
        f"or more, rounding granted; weights free to sum to anything fit the twelve rows, but give perfection "
        f"{perfect_average():.0f} points at most",
        verdict=_NO if mean.miss > TOUCHES else "holds",
    )


def _ladder_average() -> StatementCheck:
    worst = max(abs(math.fsum(row) / len(row) - avg) for row, avg in paper.PER_ATTRIBUTE.values())
    ladder = all(paper.LADDER[name][2] == avg for name, (_, avg) in paper.PER_ATTRIBUTE.items())
    return StatementCheck(
        title="Avg is the mean of four accuracies",
        where="ablation tables (a) and (b)",
        published="one Avg for main table and ablation",
        recomputed=f"the mean of the four columns of (b) gives the Avg of (a) and (b) within {worst:.3f} in every row",
        verdict=_NO if ladder and worst <= 2 * SHARE_ROUNDING else "holds",
    )


def _two_tables() -> StatementCheck:
    pairs = {"Qwen2.5-VL-7B": "Qwen2.5-VL-7B", OURS: "Touch-R1"}
    gaps = [
        abs(a - b)
        for main, ablation in pairs.items()
        for a, b in zip(paper.MAIN[main][0][:4], paper.PER_ATTRIBUTE[ablation][0], strict=True)
    ]
    return StatementCheck(
        title="The same models have two sets of accuracies",
        where="main table against ablation table (b)",
        published=f"{OURS} hardness {paper.MAIN[OURS][0][0]} and {paper.PER_ATTRIBUTE['Touch-R1'][0][0]}",
        recomputed=f"all {len(gaps)} pairs differ, by {min(gaps):.1f} to {max(gaps):.1f} points",
        verdict=_NO if min(gaps) > 2 * SHARE_ROUNDING else "holds",
    )


def _distance() -> StatementCheck:
    rows, impossible = error_and_distance(), impossible_distances()
    error, omae = rows[OURS]
    return StatementCheck(
        title="OMAE lies below the error rate",
        where="main table and ablation",
        published=f"{OURS}: OMAE {omae}",
        recomputed=f"a wrong answer is off by a level at least, so OMAE ≥ {error:.3f}; {len(impossible)} of "
        f"{len(rows)} rows are below their bound",
        verdict=_NO if OURS in impossible else "holds",
    )


def _tactile_use() -> StatementCheck:
    in_equations = {*paper.REWARD_WEIGHTS, *paper.ABLATED_TERMS}
    gone = [term for term in paper.ADVERTISED_TERMS if term not in in_equations]
    return StatementCheck(
        title="The tactile-use reward is in no equation",
        where="abstract, introduction; reward equations, ablation",
        published=f"credit for {', '.join(paper.ADVERTISED_TERMS)}",
        recomputed=f"weights {sum(paper.REWARD_WEIGHTS.values()):g} in all, none for {', '.join(gone)}; no row of its "
        "own",
        verdict=_NO if gone else "holds",
    )


def _hyperparameters() -> StatementCheck:
    gone = [name for name in paper.OBJECTIVE_NEEDS if name not in paper.HYPERPARAMETERS]
    return StatementCheck(
        title="The objective cannot be computed from what is given",
        where="overall objective; implementation details",
        published=", ".join(f"{name} {value:g}" for name, value in list(paper.HYPERPARAMETERS.items())[:2]),
        recomputed=f"missing: {', '.join(gone)}",
        verdict="not given" if gone else "holds",
    )


def _conflict() -> StatementCheck:
    gone = [name for name in paper.ADVERTISED_MEASURES if name not in paper.MEASURED]
    return StatementCheck(
        title="Visual–tactile conflict is never measured",
        where="abstract and introduction; metrics",
        published=f"evaluates {', '.join(paper.ADVERTISED_MEASURES)}",
        recomputed=f"no metric and no column for {', '.join(gone)}",
        verdict="not given" if gone else "holds",
    )


def _subsets() -> StatementCheck:
    asked = paper.SFT_QA + paper.RL_QA
    left = paper.RECORDS - paper.PRETRAIN_FRAMES
    training = round(paper.RECORDS * (1 - paper.HELD_OUT_OBJECTS / paper.OBJECTS)) - paper.PRETRAIN_FRAMES
    return StatementCheck(
        title="Disjoint subsets do not fit",
        where="training data and protocol",
        published=f"{paper.PRETRAIN_FRAMES:,} frames, then {asked:,} questions on other data",
        recomputed=f"{left:,} frames are left, {training:,} without the held-out objects: "
        f"{asked / training:.0f} questions about each",
        verdict=_NO if asked > left else "holds",
    )


def _backbones() -> StatementCheck:
    unknown = [size for size in paper.BACKBONES if size not in paper.RELEASED_BACKBONES]
    return StatementCheck(
        title="A backbone that does not exist",
        where="scaling figure",
        published=", ".join(f"{size}B" for size in paper.BACKBONES),
        recomputed=f"Qwen2.5-VL was released with {', '.join(f'{s}B' for s in paper.RELEASED_BACKBONES)}; no "
        + ", ".join(f"{size}B" for size in unknown),
        verdict=_NO if unknown else "holds",
    )


def _noise() -> StatementCheck:
    gains = [
        gain_interval(a, b, paper.VTV_ITEMS)
        for a, b in zip(paper.VTV["Ours"][0][:5], paper.VTV["VTV-LLM-7B"][0][:5], strict=True)
    ]
    return StatementCheck(
        title="Gains on VTV150K are within one run's noise",
        where=f"VTV150K table, {paper.VTV_ITEMS} questions a property",
        published=f"{min(g for g, _, _ in gains):+.1f} to {max(g for g, _, _ in gains):+.1f} points",
        recomputed=f"95 % intervals of ± {min(h for _, h, _ in gains):.0f} to {max(h for _, h, _ in gains):.0f} "
        f"points, p ≥ {min(p for _, _, p in gains):.2f} (unpaired)",
        verdict="unsupported" if all(half > gain for gain, half, _ in gains) else "holds",
    )


def _seeds() -> StatementCheck:
    return StatementCheck(
        title="No seeds, no intervals",
        where="all tables",
        published="single numbers",
        recomputed=f"seeds {paper.SEEDS or 'not given'}, intervals or tests {paper.INTERVALS}",
        verdict="not given" if paper.SEEDS is None and paper.INTERVALS == 0 else "holds",
    )


def _sequences() -> StatementCheck:
    each = paper.SENSORS * paper.MOTIONS
    return StatementCheck(
        title="Sequences do not fit the protocol",
        where="overview and acquisition",
        published=f"{paper.SEQUENCES:,} sequences of {paper.OBJECTS:,}+ objects, {paper.SENSORS} sensors, a press and "
        "six motions",
        recomputed=f"that makes {paper.OBJECTS * each:,}; {paper.SEQUENCES:,} are {paper.SEQUENCES / each:.0f} objects",
        verdict=_NO if paper.OBJECTS * each > paper.SEQUENCES else "holds",
    )


def _counts() -> StatementCheck:
    shares = {name: row[:4] for name, (row, _) in paper.VTV.items()}
    fit = {name: sum(attainable(share, paper.VTV_ITEMS) for share in row) for name, row in shares.items()}
    peers = sum(fit.values()) - fit["Ours"]
    return StatementCheck(
        title="Shares that no count gives",
        where=f"VTV150K table, four properties of {paper.VTV_ITEMS} questions",
        published=f"{', '.join(str(share) for share in shares['Ours'])} for Touch-R1",
        recomputed=f"{fit['Ours']} of its 4 are k/{paper.VTV_ITEMS} to a decimal; of the others' {4 * (len(fit) - 1)}, "
        f"{peers}",
        verdict="unsupported" if fit["Ours"] < 4 else "holds",
    )


def _pictures() -> StatementCheck:
    errors = [e for row in paper.VIDEO_L1.values() for e in row]
    return StatementCheck(
        title="L1 worse than a grey picture's",
        where="video prediction table",
        published=f"L1 {min(errors)} to {max(errors)}",
        recomputed=f"a constant ½ is off by ½ at most on pictures in 0–1; {sum(e > 0.5 for e in errors)} of "
        f"{len(errors)} are above, so their unit is not given",
        verdict="not given" if min(errors) > 0.5 else "holds",
    )


def _vtv_average() -> StatementCheck:
    worst = max(abs(math.fsum(row) / len(row) - avg) for row, avg in paper.VTV.values())
    return StatementCheck(
        title="VTV150K's Average is the mean of its nine columns",
        where="VTV150K table",
        published=f"{len(paper.VTV)} averages",
        recomputed=f"off by {worst:.2f} at the worst",
        verdict="holds" if worst <= 2 * SHARE_ROUNDING else _NO,
    )


def _frames() -> StatementCheck:
    return StatementCheck(
        title="Records are sequences of 90 frames",
        where="acquisition",
        published=f"{paper.RECORDS:,}",
        recomputed=f"{paper.SEQUENCES:,} × {paper.RECORDS / paper.SEQUENCES:g}",
        verdict="holds" if paper.RECORDS % paper.SEQUENCES == 0 else _NO,
    )


def _shared_rows() -> StatementCheck:
    pairs = {"Qwen2.5-VL-7B": "Qwen2.5-VL-7B", OURS: "Touch-R1"}
    same = all(
        (_column(main, "OMAE"), _column(main, "CSC"), _column(main, "Avg")) == paper.LADDER[rung]
        for main, rung in pairs.items()
    )
    return StatementCheck(
        title="The ladder's ends are the main table's",
        where="ablation table (a)",
        published="OMAE, CSC, Avg of two models",
        recomputed="equal" if same else "different",
        verdict="holds" if same else _NO,
    )


def _audit() -> StatementCheck:
    passed = round(paper.AUDITED * paper.AUDIT_PASSED / 100)
    interval = wilson_interval(passed, paper.AUDITED)
    return StatementCheck(
        title="Audit of the questions",
        where="QA generation and quality verification",
        published=f"{paper.AUDIT_PASSED} % of {paper.AUDITED:,}",
        recomputed=f"{passed:,} passed, 95 % interval {100 * interval.low:.1f}–{100 * interval.high:.1f} %",
        verdict="holds" if attainable(paper.AUDIT_PASSED, paper.AUDITED) else _NO,
    )
