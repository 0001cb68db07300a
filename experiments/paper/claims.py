"""The claims of Touch-R1, and how a recorded run decides each.

A claim is a difference between two arms of a run, paired over seeds with Student's interval, or a figure of the run
with an interval.  A claim *holds* if the interval lies on the claimed side of 0, *does not hold* if it lies on the
other side, and is *undecided* otherwise.  A claim of several differences holds only if all of them hold.
"""

import dataclasses
import re
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from experiments.core.recorded import value_at
from experiments.core.text import number
from experiments.study import paper_numbers as paper
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.statistics import Interval, student_interval

ClaimVerdict = Literal["holds", "does not hold", "undecided", "contradicts itself"]

FOUR = ("h_acc", "r_acc", "p_acc", "mat_acc")  # whose mean the paper's ladder prints as Avg

_INTERVAL = re.compile(r"\[([^,\]]+), ([^\]]+)\]")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClaimedChange:
    """`arm` minus `against` in the mean of some metrics, or the interval at a path of the run; `paper` is its number.

    A path leads to a number, whose note holds the interval, or to a cell such as `+1.0 [0.5, 1.5]`.
    """

    name: str
    paper: float | None = None
    metrics: tuple[str, ...] = ()
    arm: str = ""
    against: str = ""
    path: str = ""
    spec: str = "+.1f"
    better: Literal["higher", "lower"] = "higher"

    def measured(self, run: Mapping[str, Any]) -> Interval | None:
        """The change in a recorded run; `None` where the run does not have it."""
        if self.path:
            found = value_at(run, self.path)
            mean, text = (found["measured"], found["note"]) if isinstance(found, Mapping) else (found.split()[0], found)
            mean, low, high = (float(str(x).replace("−", "-")) for x in (mean, *_INTERVAL.findall(text)[0]))
            return Interval(mean=mean, low=low, high=high)
        rows = {**run.get("arms", {}), **run.get("baselines", {})}
        if not {self.arm, self.against} <= set(rows):
            return None
        a, b = (np.mean([rows[name][m]["per_seed"] for m in self.metrics], axis=0) for name in (self.arm, self.against))
        return student_interval(a - b) if max(len(a), len(b)) > 1 else None

    def verdict(self, found: Interval | None) -> ClaimVerdict:
        """Where the interval lies."""
        if found is None or not found.excludes_zero:
            return "undecided"
        return "holds" if (found.mean > 0) == (self.better == "higher") else "does not hold"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Claim:
    """A statement of the paper, the experiment that measures it, its changes, and why it comes out so.

    `fixed` is the verdict where no run decides.
    """

    text: str
    experiment: str
    why: str
    changes: tuple[ClaimedChange, ...] = ()
    published: str = ""
    fixed: ClaimVerdict | None = None


LADDER = {"OMAE": ("omae",), "CSC": ("csc",), "Avg of four": FOUR}
"""Columns of the paper's ladder, in its order → metrics, whose mean it is."""


def _ladder(name: str, arm: str, against: str, row: str, below: str) -> ClaimedChange:
    """A step of the paper's ladder in one of its columns."""
    column, lower = list(LADDER).index(name), name == "OMAE"
    return ClaimedChange(
        name=name,
        paper=paper.LADDER[row][column] - paper.LADDER[below][column],
        metrics=LADDER[name],
        arm=arm,
        against=against,
        spec="+.3f" if lower else "+.1f",
        better="lower" if lower else "higher",
    )


SFT_ROW, FULL_ROW = "+ Cold-start SFT", "Touch-R1"

CLAIMS: tuple[Claim, ...] = (
    Claim(
        text="SFT gives the strongest initial boost",
        experiment="ablation_cumulative",
        changes=(_ladder("Avg of four", "sft", "constant", SFT_ROW, "Qwen2.5-VL-7B"),),
        why="Answers follow touch only after SFT. The base is a constant answer here and a blind model in the paper.",
    ),
    Claim(
        text="The whole objective raises Avg over SFT",
        experiment="main_table",
        published=number(paper.LADDER[FULL_ROW][2] - paper.LADDER[SFT_ROW][2], "+.1f"),
        changes=(ClaimedChange(name="Avg of nine", metrics=("avg",), arm="full", against="sft"),),
        why="GRPO with the published rewards adds nothing to the best SFT checkpoint.",
    ),
    Claim(
        text="GRPO is better than the same time spent on SFT",
        experiment="main_table",
        published="never compared",
        changes=(ClaimedChange(name="Avg of nine", metrics=("avg",), arm="full", against="sft_continued"),),
        why="The paper lacks this control: SFT continued for the same time. None of sixteen variants beats it "
        "(`grpo_verdict`).",
    ),
    Claim(
        text="GRPO with 0/1 credit helps a little",
        experiment="ablation_cumulative",
        changes=(_ladder("Avg of four", "zero_one", "sft", "+ GRPO (0/1)", SFT_ROW),),
        why="The gain is not significant against SFT continued for the same time.",
    ),
    Claim(
        text="The ordinal reward lowers OMAE",
        experiment="ablation_cumulative",
        changes=(_ladder("OMAE", "ordinal", "zero_one", "+ Ordinal Reward", "+ GRPO (0/1)"),),
        why="Near misses earn a part of the reward, but answers do not become better by it.",
    ),
    Claim(
        text="The consistency reward raises cross-sensor consistency",
        experiment="ablation_cumulative",
        changes=(_ladder("CSC", "consistency", "ordinal", "+ Consistency Reward", "+ Ordinal Reward"),),
        why="It rewards equal slots, so slots copy each other; conclusions from single sensors stay the same.",
    ),
    Claim(
        text="The format reward brings a small but stable gain",
        experiment="ablation_cumulative",
        changes=(_ladder("Avg of four", "format", "consistency", "+ Format Reward", "+ Consistency Reward"),),
        why="After SFT nearly every answer is already formatted.",
    ),
    Claim(
        text="Tactile grounding adds to accuracy",
        experiment="ablation_cumulative",
        changes=(_ladder("Avg of four", "grounding", "format", FULL_ROW, "+ Format Reward"),),
        why="The KL divergence from answers with a masked stream grows without answers becoming better.",
    ),
    Claim(
        text="The whole objective lowers OMAE and raises CSC over SFT",
        experiment="ablation_cumulative",
        changes=(
            _ladder("OMAE", "grounding", "sft", FULL_ROW, SFT_ROW),
            _ladder("CSC", "grounding", "sft", FULL_ROW, SFT_ROW),
        ),
        why="The policy stays near SFT, which the likelihood of verified answers in the objective anchors.",
    ),
    Claim(
        text="The gains spread over hardness, roughness, protrusion and material",
        experiment="ablation_cumulative",
        changes=tuple(
            ClaimedChange(
                name=title,
                paper=paper.PER_ATTRIBUTE[FULL_ROW][0][i] - paper.PER_ATTRIBUTE[SFT_ROW][0][i],
                metrics=(metric,),
                arm="grounding",
                against="sft",
            )
            for i, (metric, title) in enumerate(zip(FOUR, ATTRIBUTES, strict=True))
        ),
        why="No attribute gains, and material loses a little.",
    ),
    Claim(
        text="Credit for the use of touch helps",
        experiment="ablation_cumulative",
        published="no row",
        changes=(ClaimedChange(name="Avg of four", metrics=FOUR, arm="tactile_use", against="grounding"),),
        why="In no equation of the paper; implemented here as its abstract describes.",
    ),
    Claim(
        text="Touch overrules a misleading picture",
        experiment="conflict",
        published="never measured",
        changes=(
            ClaimedChange(
                name="accuracy over a policy without touch",
                path="requirements > full over tactile_blind, deceptive questions or full model over vision-only, "
                "deceptive questions",
            ),
        ),
        why="On objects that look like another material, policies with touch follow touch, others the picture.",
    ),
    Claim(
        text="Right answers depend on touch",
        experiment="conflict",
        published="never measured",
        changes=(
            ClaimedChange(name="least loss of accuracy", path="requirements > least gain from touch, all questions"),
        ),
        why="Accuracy falls when touch is removed or replaced by noise or another object's touch.",
    ),
    Claim(
        text="Larger models are better in L2-EM, SOI-ρ, CSC and Avg",
        experiment="scaling",
        published="rises from 3B to 14B",
        changes=tuple(
            ClaimedChange(name=title, metrics=(metric,), arm="large", against="small", spec=spec)
            for metric, title, spec in zip(
                ("l2_em", "soi_rho", "csc", "avg"),
                ("L2-EM", "SOI-ρ", "CSC", "Avg"),
                ("+.1f", "+.2f", "+.1f", "+.1f"),
                strict=True,
            )
        ),
        why="From .28 to 1.3 million parameters with three seeds, far below the paper's sizes.",
    ),
    Claim(
        text="Touch predicts its future frames",
        experiment="video_prediction",
        published=f"L1 {paper.VIDEO['Ours', 5, 'touch'][0]}, {paper.VIDEO['Geng et al.', 5, 'touch'][0]} before",
        changes=(
            ClaimedChange(
                name="skill over copying the last frame, 5 ahead",
                path="tables > Scores on unseen objects > touch, 5 ahead > skill",
                spec=".3f",
            ),
        ),
        why="Prediction is better than copying. The paper's L1 has an unknown unit and cannot be compared.",
    ),
    Claim(
        text="Pretraining on future frames captures contact",
        experiment="pretrain_encoder",
        published="no ablation",
        changes=(
            ClaimedChange(
                name="linear probes over a random encoder", path="requirements > probes over a random encoder"
            ),
        ),
        why="Latents are predicted, but probes on them are worse than on an untrained encoder.",
    ),
    Claim(
        text="Pretraining on future frames helps fine-tuning",
        experiment="stage_one",
        published="no ablation",
        changes=tuple(
            ClaimedChange(
                name=f"gain over a random encoder with {count} labels",
                path=f"tables > Fine-tuned encoders on 480 unseen objects > dynamics, {count} > over random",
            )
            for count in (10, 30, 100, 300)
        ),
        why="It helps from 100 labels on. Contrast between sensors, which the paper lacks, helps at every count.",
    ),
    Claim(
        text="Traces probe, compare and revise on their own",
        experiment="qualitative",
        published="two chosen examples",
        fixed="undecided",
        why="Here SFT teaches the form of the traces, so the form cannot emerge; the report counts every case.",
    ),
    Claim(
        text="Touch-R1 beats GPT-4o, Octopi, SToLa and VTV-LLM",
        experiment="paper_audit",
        published="+12.6 to +24.7 Avg",
        fixed="undecided",
        why="No weights, code, data or answers are public; the gains on VTV150K lie within one run's noise.",
    ),
)
