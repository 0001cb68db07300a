"""Statements of Touch-R1 checked against its own printed numbers, and the arithmetic of these checks.

A printed number stands for every number that rounds to it.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
from scipy import optimize, special

from experiments.core.text import number
from experiments.study import paper_numbers as paper
from touchr1_jax.bench.statistics import wilson_interval

Verdict = Literal["contradiction", "not given", "unsupported", "holds"]

MainTable = Mapping[str, tuple[paper.Row, float]]  # model → the nine columns of the main table, and Avg

OURS = "Touch-R1-7B"

SHARE_ROUNDING, LEVEL_ROUNDING = 0.05, 0.005  # half of the last digit of a percentage, and of OMAE and ρ

SOLVER_ERROR = 1e-6  # Points; a smaller miss counts as none

SAME_MODELS = {"Qwen2.5-VL-7B": "Qwen2.5-VL-7B", OURS: "Touch-R1"}
"""Models of the main table → their names in the ablation tables."""


def columns_as_scores(main: MainTable = paper.MAIN) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and greatest columns that round to the printed ones, as scores of 0–100 [models, 9], and Avg [models].

    OMAE counts as 100(1 − OMAE/2), ρ as 100ρ.
    """
    printed = np.array([row for row, _ in main.values()])
    rounding = np.full(len(paper.COLUMNS), SHARE_ROUNDING)
    omae, rho = paper.COLUMNS.index("OMAE"), paper.COLUMNS.index("SOI-ρ")
    printed[:, omae], rounding[omae] = 100 - 50 * printed[:, omae], 50 * LEVEL_ROUNDING
    printed[:, rho], rounding[rho] = 100 * printed[:, rho], 100 * LEVEL_ROUNDING
    return printed - rounding, printed + rounding, np.array([avg for _, avg in main.values()])


def best_weighting(main: MainTable = paper.MAIN) -> tuple[np.ndarray, float]:
    """The weighted mean of the columns that is closest to Avg: its weights [9], and its largest miss t in points.

    Minimises t over w ≥ 0, Σ w = 1 with Σ w·low ≤ Avg + ½ digit + t and Σ w·high ≥ Avg − ½ digit − t for every model.
    A miss of 0 means that some weighted mean of the unrounded columns gives every Avg.
    """
    low, high, average = columns_as_scores(main)
    slack, n = -np.ones((len(average), 1)), low.shape[1]
    limits = np.concatenate([average + SHARE_ROUNDING, SHARE_ROUNDING - average])
    bounded, sums = np.block([[low, slack], [-high, slack]]), np.append(np.ones(n), 0)[None]
    found = optimize.linprog(np.eye(n + 1)[-1], A_ub=bounded, b_ub=limits, A_eq=sums, b_eq=np.ones(1))
    return found.x[:-1], float(found.x[-1])


def perfect_average(main: MainTable = paper.MAIN) -> float:
    """The largest Avg 100 Σ w of a perfect model under weights w ≥ 0 that give every printed Avg; a mean has 100."""
    low, high, average = columns_as_scores(main)
    limits = np.concatenate([average + SHARE_ROUNDING, SHARE_ROUNDING - average])
    found = optimize.linprog(-np.ones(low.shape[1]), A_ub=np.concatenate([low, -high]), b_ub=limits)
    if found.status != 0:
        raise ValueError(f"main allows no weights: {found.message}; ask for `best_weighting` instead")
    return -100.0 * float(found.fun)


def error_and_distance() -> dict[str, tuple[float, float]]:
    """1 − mean accuracy of the ordinal attributes, and OMAE, of every row with both; OMAE cannot be the smaller one."""
    rows = {name: (1 - math.fsum(row[:3]) / 300, row[4]) for name, (row, _) in paper.MAIN.items()}
    for name, (row, _) in paper.PER_ATTRIBUTE.items():
        rows[f"{name} (ablation)"] = (1 - math.fsum(row[:3]) / 300, paper.LADDER[name][0])
    return rows


def impossible_distances() -> list[str]:
    """Rows whose OMAE, rounding granted, is below the share of wrong answers."""
    too_small = lambda error, omae: omae + LEVEL_ROUNDING < error - SHARE_ROUNDING / 100
    return [name for name, row in error_and_distance().items() if too_small(*row)]


def gain_interval(ours: float, theirs: float, items: int) -> tuple[float, float, float]:
    """Difference of two shares in percent on n items each, the half width of its 95 % interval, two-sided p.

    Unpaired, since the answers are not published: p̂₁ − p̂₂ ± 1.96 √(Σ p̂(1 − p̂)/n), p with the pooled share.
    """
    p, q = ours / 100, theirs / 100
    pooled = (p + q) / 2
    half = 1.96 * math.sqrt((p * (1 - p) + q * (1 - q)) / items)
    z = (p - q) / math.sqrt(2 * pooled * (1 - pooled) / items)
    return ours - theirs, 100 * half, float(2 * special.ndtr(-abs(z)))


def attainable(share: float, items: int) -> bool:
    """True if k/n, rounded or cut off to one decimal, prints as this percentage for some k.

    Source: Brown and Heathers, The GRIM test, Soc. Psychol. Personal. Sci. 8 (2017).
    """
    near, low, high = round(share * items / 100), share - SHARE_ROUNDING - 1e-9, share + 2 * SHARE_ROUNDING - 1e-9
    return any(low <= 100 * k / items < high for k in (near - 1, near, near + 1))


@dataclasses.dataclass(frozen=True)
class StatementCheck:
    """A statement about the paper, where it is made, what is printed, what follows from the numbers, the verdict."""

    title: str
    where: str
    published: str
    recomputed: str
    verdict: Verdict


def _check(
    title: str, where: str, published: str, recomputed: str, fails: bool, verdict: Verdict = "contradiction"
) -> StatementCheck:
    return StatementCheck(title, where, published, recomputed, verdict if fails else "holds")


def inconsistencies() -> tuple[StatementCheck, ...]:
    """Every known inconsistency, in the order of the report."""
    return (average_check(paper.MAIN), *_accuracies(), *_method(), *_claims(), *_data_and_units())


def average_check(main: MainTable) -> StatementCheck:
    """Avg of the main table against the weighted means of its columns."""
    _, miss = best_weighting(main)
    low, high, average = columns_as_scores(main)
    plain = ((low + high) / 2).mean(1)
    return _check(
        "Avg is no mean of the columns",
        "main table, Avg “over the full metric set”",
        f"Avg {average[-1]} for {OURS}",
        f"the plain mean is {plain[-1]:.1f}; every weighted mean misses at least one model by {miss:.2f} points, even "
        "allowing for rounding; weights that need not sum to 1 fit the twelve rows, but a perfect model then gets at "
        f"most {perfect_average(main):.0f} points",
        miss > SOLVER_ERROR,
    )


def _worst_average(rows: Mapping[str, tuple[paper.Row, float]]) -> float:
    return max(abs(math.fsum(row) / len(row) - average) for row, average in rows.values())


def _accuracies() -> Iterator[StatementCheck]:
    """Averages and accuracies that differ between tables, and an OMAE below its bound."""
    worst = _worst_average(paper.PER_ATTRIBUTE)
    ladder = all(paper.LADDER[name][2] == avg for name, (_, avg) in paper.PER_ATTRIBUTE.items())
    yield _check(
        "Avg is the mean of four accuracies",
        "ablation tables (a) and (b)",
        "one Avg for main table and ablation",
        f"the mean of the four columns of (b) gives the Avg of (a) and (b) within {worst:.3f} in every row",
        ladder and worst <= 2 * SHARE_ROUNDING,
    )
    gaps = [
        abs(a - b)
        for main, ablation in SAME_MODELS.items()
        for a, b in zip(paper.MAIN[main][0][:4], paper.PER_ATTRIBUTE[ablation][0], strict=True)
    ]
    yield _check(
        "The same models have two sets of accuracies",
        "main table against ablation table (b)",
        f"{OURS} hardness {paper.MAIN[OURS][0][0]} and {paper.PER_ATTRIBUTE['Touch-R1'][0][0]}",
        f"all {len(gaps)} pairs differ, by {min(gaps):.1f} to {max(gaps):.1f} points",
        min(gaps) > 2 * SHARE_ROUNDING,
    )
    rows, impossible = error_and_distance(), impossible_distances()
    error, omae = rows[OURS]
    yield _check(
        "OMAE lies below the error rate",
        "main table and ablation",
        f"{OURS}: OMAE {omae}",
        f"a wrong answer is off by at least a level, so OMAE ≥ {error:.3f}; {len(impossible)} of {len(rows)} rows are "
        "below this bound",
        OURS in impossible,
    )


def _method() -> Iterator[StatementCheck]:
    """Terms, hyperparameters and measures that are announced and not given."""
    terms = {*paper.REWARD_WEIGHTS, *paper.ABLATED_TERMS}
    no_term = [term for term in paper.ADVERTISED_TERMS if term not in terms]
    yield _check(
        "The tactile-use reward is in no equation",
        "abstract, introduction; reward equations, ablation",
        f"credit for {', '.join(paper.ADVERTISED_TERMS)}",
        f"the weights sum to {sum(paper.REWARD_WEIGHTS.values()):g} without {', '.join(no_term)}; no ablation row",
        bool(no_term),
    )
    no_value = [name for name in paper.OBJECTIVE_NEEDS if name not in paper.HYPERPARAMETERS]
    yield _check(
        "The objective cannot be computed from what is given",
        "overall objective; implementation details",
        ", ".join(f"{name} {value:g}" for name, value in list(paper.HYPERPARAMETERS.items())[:2]),
        f"missing: {', '.join(no_value)}",
        bool(no_value),
        "not given",
    )
    no_metric = [name for name in paper.ADVERTISED_MEASURES if name not in paper.MEASURED]
    yield _check(
        "Visual–tactile conflict is never measured",
        "abstract and introduction; metrics",
        f"evaluates {', '.join(paper.ADVERTISED_MEASURES)}",
        f"no metric and no column for {', '.join(no_metric)}",
        bool(no_metric),
        "not given",
    )


def _claims() -> Iterator[StatementCheck]:
    """Subsets, models and gains that other numbers contradict or do not support."""
    questions, left = paper.SFT_QA + paper.RL_QA, paper.RECORDS - paper.PRETRAIN_FRAMES
    training = round(paper.RECORDS * (1 - paper.HELD_OUT_OBJECTS / paper.OBJECTS)) - paper.PRETRAIN_FRAMES
    yield _check(
        "Disjoint subsets do not fit",
        "training data and protocol",
        f"{paper.PRETRAIN_FRAMES:,} frames, then {questions:,} questions on other data",
        f"{left:,} frames are left, {training:,} without the held-out objects: {questions / training:.0f} questions "
        "about each frame",
        questions > left,
    )
    sizes = lambda billions: ", ".join(f"{size}B" for size in billions)
    unknown = [size for size in paper.BACKBONES if size not in paper.RELEASED_BACKBONES]
    yield _check(
        "A backbone that does not exist",
        "scaling figure",
        sizes(paper.BACKBONES),
        f"Qwen2.5-VL was released with {sizes(paper.RELEASED_BACKBONES)}; no {sizes(unknown)}",
        bool(unknown),
    )
    pairs = zip(paper.VTV["Ours"][0][:5], paper.VTV["VTV-LLM-7B"][0][:5], strict=True)
    gains, halves, p = zip(*(gain_interval(a, b, paper.VTV_ITEMS) for a, b in pairs), strict=True)
    yield _check(
        "Gains on VTV150K are within one run's noise",
        f"VTV150K table, {paper.VTV_ITEMS} questions a property",
        f"{number(min(gains), '+.1f')} to {number(max(gains), '+.1f')} points",
        f"95 % intervals of ± {min(halves):.0f} to {max(halves):.0f} points, p ≥ {min(p):.2f} (unpaired)",
        all(half > gain for gain, half in zip(gains, halves, strict=True)),
        "unsupported",
    )
    yield _check(
        "No seeds, no intervals",
        "all tables",
        "single numbers",
        f"seeds {paper.SEEDS or 'not given'}, intervals or tests {paper.INTERVALS}",
        paper.SEEDS is None and paper.INTERVALS == 0,
        "not given",
    )


def _data_and_units() -> Iterator[StatementCheck]:
    """Counts that the protocol does not give, and an error without its unit."""
    each = paper.SENSORS * paper.MOTIONS
    yield _check(
        "Sequences do not fit the protocol",
        "overview and acquisition",
        f"{paper.SEQUENCES:,} sequences of {paper.OBJECTS:,}+ objects, {paper.SENSORS} sensors, a press and six "
        "motions",
        f"the protocol gives {paper.OBJECTS * each:,}; {paper.SEQUENCES:,} suffice for {paper.SEQUENCES / each:.0f} "
        "objects",
        paper.OBJECTS * each > paper.SEQUENCES,
    )
    printed = (paper.RECORDS, paper.SEQUENCES, paper.SFT_QA, paper.RL_QA)
    yield _check(
        "The announced release is another data set",
        "authors' page; acquisition, training data and protocol",
        ", ".join(f"{count:,} {name}" for name, count in paper.ANNOUNCED.items()),
        f"the paper prints {', '.join(f'{count:,}' for count in printed)}",
        tuple(paper.ANNOUNCED.values()) != printed,
    )
    shares = {name: row[:4] for name, (row, _) in paper.VTV.items()}
    fit = {name: sum(attainable(share, paper.VTV_ITEMS) for share in row) for name, row in shares.items()}
    others = sum(fit.values()) - fit["Ours"]
    yield _check(
        "Shares that no count gives",
        f"VTV150K table, four properties of {paper.VTV_ITEMS} questions",
        f"{', '.join(str(share) for share in shares['Ours'])} for Touch-R1",
        f"{fit['Ours']} of its 4 equal k/{paper.VTV_ITEMS} to one decimal, {others} of the "
        f"{4 * (len(fit) - 1)} of other models do",
        fit["Ours"] < 4,
        "unsupported",
    )
    errors = [e for row in paper.VIDEO_L1.values() for e in row]
    yield _check(
        "L1 worse than a grey picture's",
        "video prediction table",
        f"L1 {min(errors)} to {max(errors)}",
        f"if pixels are in 0–1, a grey picture has an L1 of at most ½; {sum(e > 0.5 for e in errors)} of {len(errors)} "
        "values are larger, so their unit is unknown",
        min(errors) > 0.5,
        "not given",
    )


def confirmed() -> tuple[StatementCheck, ...]:
    """Statements of the paper that its numbers confirm."""

    def cell(model: str, column: str) -> float:
        row, average = paper.MAIN[model]
        return average if column == "Avg" else row[paper.COLUMNS.index(column)]

    gains = []
    for where, column, model, claimed in paper.GAINS:
        gain = cell(OURS, column) - cell(model, column)
        wrong = not abs(gain - claimed) < SHARE_ROUNDING
        shown, found = number(claimed, "+.1f"), f"{number(gain, '+.1f')} points"
        gains.append(_check(f"{column} over {model}", where, shown, found, wrong))
    worst, ends = _worst_average(paper.VTV), ("OMAE", "CSC", "Avg")
    differ = any(
        tuple(cell(main, column) for column in ends) != paper.LADDER[name] for main, name in SAME_MODELS.items()
    )
    passed = round(paper.AUDITED * paper.AUDIT_PASSED / 100)
    interval = wilson_interval(passed, paper.AUDITED)
    return (
        *gains,
        _check(
            "VTV150K's Average is the mean of its nine columns",
            "VTV150K table",
            f"{len(paper.VTV)} averages",
            f"off by {worst:.2f} at the worst",
            worst > 2 * SHARE_ROUNDING,
        ),
        _check(
            "Records are sequences of 90 frames",
            "acquisition",
            f"{paper.RECORDS:,}",
            f"{paper.SEQUENCES:,} × {paper.RECORDS / paper.SEQUENCES:g}",
            paper.RECORDS % paper.SEQUENCES != 0,
        ),
        _check(
            "The ladder's ends are the main table's",
            "ablation table (a)",
            "OMAE, CSC, Avg of two models",
            "different" if differ else "equal",
            differ,
        ),
        _check(
            "Audit of the questions",
            "QA generation and quality verification",
            f"{paper.AUDIT_PASSED} % of {paper.AUDITED:,}",
            f"{passed:,} passed, 95 % interval {100 * interval.low:.1f}–{100 * interval.high:.1f} %",
            not attainable(paper.AUDIT_PASSED, paper.AUDITED),
        ),
    )
