"""Every claim of Touch-R1 with its number, ours, and a verdict, written from the runs in `experiments/recorded/`.

    python -m experiments.paper.reproduction        # REPRODUCTION.md, its figure, and runs/reproduction/report.html

`paper_audit` finds the statements that the paper's own numbers contradict.  A claim without a recorded run is
undecided.  A test compares REPRODUCTION.md with what this module would write.
"""

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.bench.paper_checks import inconsistencies
from experiments.core.artifacts import read_json, write_bytes, write_text
from experiments.core.charts import Panel, Rule, Series, draw, estimates
from experiments.core.look import PALETTE, SHARED
from experiments.core.recorded import RECORDED
from experiments.core.report import write_report
from experiments.core.results import Picture, Results, named_table
from experiments.core.runs import ROOT
from experiments.core.text import interval, number
from experiments.paper.claims import CLAIMS, Claim, ClaimVerdict
from touchr1_jax.bench.statistics import Interval

PAGE, FIGURE = Path("experiments/REPRODUCTION.md"), Path("experiments/figures/reproduction.svg")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClaimOutcome:
    """A row of the page."""

    claim: str
    paper: str
    ours: str
    verdict: ClaimVerdict
    why: str
    experiment: str

    @property
    def command(self) -> str:
        """The command that measures it."""
        return f"make experiment EXP={self.experiment}"


def outcomes(root: Path = ROOT) -> tuple[ClaimOutcome, ...]:
    """The outcome of every claim by the runs that a checkout has recorded, then the paper's own inconsistencies."""
    found = [_outcome(claim, _recorded(claim.experiment, root)) for claim in CLAIMS]
    for check in inconsistencies():
        verdict: ClaimVerdict = "contradicts itself" if check.verdict == "contradiction" else "undecided"
        found.append(
            ClaimOutcome(
                claim=check.title,
                paper=check.published,
                ours="–",
                verdict=verdict,
                why=f"{check.recomputed} ({check.where}).",
                experiment="paper_audit",
            )
        )
    return tuple(found)


def _outcome(claim: Claim, run: Mapping[str, Any] | None) -> ClaimOutcome:
    measured = [(change, None if run is None else change.measured(run)) for change in claim.changes]
    verdicts = {change.verdict(found) for change, found in measured}
    decided: ClaimVerdict = claim.fixed or "holds"
    if claim.fixed is None and "does not hold" in verdicts:
        decided = "does not hold"
    elif claim.fixed is None and "undecided" in verdicts:
        decided = "undecided"
    published = claim.published or "; ".join(f"{c.name} {number(c.paper, c.spec)}" for c in claim.changes)
    ours = "; ".join(f"{c.name} {interval(found, c.spec)}" for c, found in measured) or "–"
    return ClaimOutcome(
        claim=claim.text, paper=published, ours=ours, verdict=decided, why=claim.why, experiment=claim.experiment
    )


def _recorded(name: str, root: Path) -> Mapping[str, Any] | None:
    path = root / RECORDED / f"{name}.json"
    return read_json(path) if path.exists() else None


def summary(found: tuple[ClaimOutcome, ...]) -> str:
    """The number of claims of each verdict, in a sentence."""
    of = [o.verdict for o in found[: len(CLAIMS)]]
    doubts = sum(o.verdict == "contradicts itself" for o in found)
    return (
        f"Of {len(of)} claims {of.count('holds')} hold, {of.count('does not hold')} do not, "
        f"{of.count('undecided')} are undecided. In {doubts} places the paper contradicts itself."
    )


SCOPE = (
    "Our policies have at most 1.3 million parameters, are trained from scratch on generated scenes of four sensors, "
    "and are scored on unseen objects: the direction of an effect can be compared, its size cannot. Intervals are "
    "95 %, over seeds if arms are compared, otherwise over objects."
)


def recipes(root: Path = ROOT) -> str:
    """Sentences that name the recipe of each recorded study."""
    studies: dict[str, list[str]] = {"paper": [], "touch": []}
    for name in dict.fromkeys(claim.experiment for claim in CLAIMS):
        config = (_recorded(name, root) or {}).get("config", {})
        study = config.get("study", config)
        if "grpo_steps" in study:
            studies[study.get("recipe", "paper")].append(f"`{name}`")
    by_recipe = {recipe: ", ".join(names) for recipe, names in studies.items()}
    return (
        f"SFT is end to end, as published, in {by_recipe['paper'] or 'no run'}. In {by_recipe['touch'] or 'no run'} "
        "the encoders are trained first, with a linear head, then the decoder; these answer more questions right, and "
        "the objective of GRPO includes the likelihood of verified answers, which keeps it near SFT."
    )


def markdown(found: tuple[ClaimOutcome, ...], root: Path = ROOT) -> str:
    """REPRODUCTION.md."""
    cell = lambda text: text.replace("|", "\\|")
    lines = [
        "# What of Touch-R1 holds",
        "",
        "`python -m experiments.paper.reproduction` writes this page from the runs in `recorded/`.",
        "",
        f"{summary(found)} {SCOPE} {recipes(root)}",
        "",
        "`python -m experiments show EXPERIMENT` renders the run behind a row as its report; "
        "`make experiment EXP=EXPERIMENT` measures it again. The [glossary](../docs/GLOSSARY.md) explains OMAE, CSC "
        "and Avg.",
        "",
        f"![Changes here and in the paper](figures/{FIGURE.name})",
        "",
    ]
    parts = (("Claims", found[: len(CLAIMS)]), ("Where the paper's own numbers decide", found[len(CLAIMS) :]))
    for title, rows in parts:
        columns = ("claim", "paper", "ours", "verdict", "why", "experiment")
        lines += [f"## {title}", "", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
        for o in rows:
            cells = (o.claim, o.paper, o.ours, f"**{o.verdict}**", o.why, f"`{o.experiment}`")
            lines.append(f"| {' | '.join(map(cell, cells))} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def chart(root: Path = ROOT) -> bytes:
    """Every measured change with its interval and the paper's number, in points: OMAE, ρ and skill × 100."""
    rows, ours, theirs = [], [], []
    for claim in CLAIMS:
        run = _recorded(claim.experiment, root)
        for change in claim.changes:
            found = None if run is None else change.measured(run)
            if found is None:
                continue
            scale = 1.0 if change.spec == "+.1f" else 100.0
            rows.append(f"{claim.text}: {change.name}{' × 100' if scale > 1 else ''}")
            ours.append(Interval(mean=scale * found.mean, low=scale * found.low, high=scale * found.high))
            theirs.append(np.nan if change.paper is None else scale * change.paper)
    series = [
        estimates("here, 95 %", ours, colour=PALETTE[0], marker="o", width=2.4),
        Series("paper", x=theirs, colour=PALETTE[1], marker="D", hollow=True, shift=-0.2),
    ]
    axis = "change (points; OMAE, ρ and skill × 100; OMAE should fall)"
    panel = Panel(series, rows=rows, x_label=axis, rules=[Rule(x=0, line="-", colour=SHARED)])
    return draw([panel], size=(10.5, 0.9 + 0.3 * len(rows)))


def write(root: Path = ROOT) -> Path:
    """Write the page, its figure and the report of a checkout; the path of the report."""
    found, picture = outcomes(root), chart(root)
    write_text(root / PAGE, markdown(found, root))
    write_bytes(root / FIGURE, picture)
    without_marks = lambda text: text.replace("`", "")  # Markdown's, which the report would show
    columns = ("claim", "paper", "ours", "verdict", "why", "command")
    rows = [{name: without_marks(getattr(o, name)) for name in columns} for o in found]
    caption = "Changes of every recorded claim with 95 % intervals, and the paper's where it prints one."
    results = Results(
        verdict=(summary(found), SCOPE, without_marks(recipes(root))),
        tables=(
            named_table("Claims", rows[: len(CLAIMS)]),
            named_table("Where the paper's own numbers decide", rows[len(CLAIMS) :]),
        ),
        pictures=(Picture(name="changes", title="Changes here and in the paper", caption=caption, content=picture),),
    )
    runs = {c.experiment: run["git"] for c in CLAIMS if (run := _recorded(c.experiment, root)) is not None}
    description = {
        "experiment": "reproduction",
        "scale": "recorded",
        "git": {"commit": "several", "dirty": False},
        "recorded": runs,
    }
    about = "What of Touch-R1 (arXiv 2605.27154) holds?"
    return write_report(root / "runs" / "reproduction", results, about=about, description=description)


def main() -> int:
    """Write all of it; the exit status."""
    sys.stdout.write(f"{PAGE}\n{write()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
