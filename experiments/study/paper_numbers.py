"""The printed numbers of Touch-R1 (arXiv 2605.27154), each group under the table or section where it is printed.

Nothing here is computed.  Shares are percentages, OMAE is in levels, ρ is Spearman's.
"""

from collections.abc import Mapping, Sequence

from experiments.core.results import Table, named_table

COLUMNS = ("H-Acc", "R-Acc", "P-Acc", "Mat-Acc", "OMAE", "L2-EM", "SFD", "SOI-ρ", "CSC")
"""Columns of the main table, before Avg."""

Row = tuple[float, ...]

MAIN: Mapping[str, tuple[Row, float]] = {
    "GPT-4o": ((48.2, 41.5, 39.7, 58.4, 0.71, 11.3, 53.0, 0.18, 39.6), 35.4),
    "Gemini-2.5-Pro": ((51.1, 44.7, 42.3, 60.2, 0.67, 13.8, 56.4, 0.22, 41.8), 37.6),
    "Claude-3.5-Sonnet": ((46.3, 39.1, 37.5, 55.8, 0.74, 9.8, 50.7, 0.15, 36.9), 33.5),
    "LLaVA-OneVision-7B": ((37.6, 32.4, 30.1, 45.8, 0.86, 5.7, 45.9, 0.08, 30.2), 26.9),
    "Qwen2.5-VL-7B": ((39.4, 33.7, 31.8, 47.2, 0.83, 6.2, 47.1, 0.09, 31.4), 28.0),
    "InternVL2.5-8B": ((40.8, 35.2, 33.0, 49.6, 0.81, 7.5, 48.6, 0.11, 33.1), 29.4),
    "Octopi-7B": ((53.4, 45.9, 43.1, 51.7, 0.62, 14.5, 58.2, 0.27, 38.4), 38.1),
    "Octopi-13B": ((58.1, 50.3, 47.6, 54.9, 0.55, 17.9, 62.5, 0.34, 41.2), 41.7),
    "AnyTouch+Qwen": ((60.2, 52.7, 50.4, 62.1, 0.51, 19.3, 64.1, 0.39, 49.7), 45.0),
    "VTV-LLM-7B": ((61.5, 54.1, 51.8, 63.0, 0.49, 20.2, 65.4, 0.41, 50.6), 46.3),
    "SToLa": ((63.7, 57.4, 54.6, 64.3, 0.45, 22.1, 66.8, 0.43, 51.9), 47.5),
    "Touch-R1-7B": ((76.8, 68.4, 65.1, 74.6, 0.24, 39.5, 78.2, 0.66, 71.3), 60.1),
}
"""Table "Main results on TouchReason-Bench": the columns, and Avg."""

LADDER: Mapping[str, tuple[float, float, float]] = {
    "Qwen2.5-VL-7B": (0.83, 31.4, 28.0),
    "+ Cold-start SFT": (0.46, 52.6, 47.8),
    "+ GRPO (0/1)": (0.42, 54.3, 50.1),
    "+ Ordinal Reward": (0.31, 56.1, 54.6),
    "+ Consistency Reward": (0.27, 69.2, 58.3),
    "+ Format Reward": (0.26, 70.4, 59.2),
    "Touch-R1": (0.24, 71.3, 60.1),
}
"""Ablation table (a), "Cumulative additions": OMAE, CSC, Avg."""

PER_ATTRIBUTE: Mapping[str, tuple[Row, float]] = {
    "Qwen2.5-VL-7B": ((31.2, 28.9, 25.7, 26.1), 28.0),
    "+ Cold-start SFT": ((49.4, 47.2, 45.8, 48.7), 47.8),
    "+ GRPO (0/1)": ((51.7, 49.8, 48.3, 50.6), 50.1),
    "+ Ordinal Reward": ((56.3, 54.1, 52.7, 55.4), 54.6),
    "+ Consistency Reward": ((60.2, 57.8, 55.9, 59.4), 58.3),
    "Touch-R1": ((62.4, 59.7, 57.6, 60.7), 60.1),
}
"""Ablation table (b), "Per-attribute accuracy (Tier-1)": hardness, roughness, protrusion, material; their Avg."""

VTV_COLUMNS = ("Hardness", "Protrusion", "Elasticity", "Friction", "Combined", "SFD", "SOI", "OSC", "TSA")

VTV: Mapping[str, tuple[Row, float]] = {
    "GPT-4o": ((34.7, 32.6, 32.6, 18.7, 2.1, 40.9, 38.4, 16.6, 36.0), 28.0),
    "Gemini-2.5-Pro-Exp": ((36.2, 34.7, 39.1, 21.0, 4.3, 42.6, 29.4, 18.5, 40.0), 29.5),
    "LLaVA-OneVision-7B": ((27.5, 32.6, 26.0, 20.2, 0.7, 40.9, 28.2, 11.7, 30.0), 24.2),
    "LLaVA-Video-Qwen2-7B": ((30.4, 29.7, 28.9, 18.1, 2.1, 33.6, 29.4, 17.2, 36.0), 25.0),
    "InternVL2.5-VL-8B": ((18.1, 23.9, 21.0, 13.7, 0.0, 24.5, 17.9, 11.1, 24.0), 17.1),
    "VideoLLaMA3-7B": ((15.2, 21.7, 14.4, 10.8, 0.0, 11.4, 12.8, 7.4, 20.0), 12.6),
    "Qwen2.5-VL-7B": ((25.3, 28.9, 17.3, 15.9, 1.4, 22.9, 28.2, 16.0, 30.0), 20.6),
    "VTV-LLM-7B": ((73.9, 75.0, 67.3, 56.5, 35.6, 71.3, 57.6, 43.2, 64.0), 60.4),
    "Ours": ((78.6, 79.3, 71.8, 61.2, 41.9, 76.5, 63.4, 48.7, 68.0), 65.5),
}
"""Table "Comparison on VTV150K": the columns, and Average."""

VTV_ITEMS = 138
"""Questions per property of that benchmark's test set; its size is that of VTV-LLM, the paper does not give one."""

VIDEO_L1: Mapping[str, Row] = {
    "SVG": (0.782, 0.834, 0.757, 0.812, 0.807, 0.861, 0.762, 0.819),
    "Geng et al.": (0.628, 0.681, 0.617, 0.668, 0.691, 0.746, 0.663, 0.721),
    "Ours": (0.574, 0.627, 0.552, 0.608, 0.638, 0.694, 0.612, 0.671),
}
"""Table "Tactile video prediction": all L1 of a method, both horizons, modalities and data sets."""

VIDEO: Mapping[tuple[str, int, str], Row] = {
    ("SVG", 3, "touch"): (0.834, 0.529, 0.428),
    ("Geng et al.", 3, "touch"): (0.681, 0.661, 0.146),
    ("Ours", 3, "touch"): (0.627, 0.696, 0.118),
    ("SVG", 3, "touch + vision"): (0.812, 0.553, 0.409),
    ("Geng et al.", 3, "touch + vision"): (0.668, 0.674, 0.132),
    ("Ours", 3, "touch + vision"): (0.608, 0.715, 0.106),
    ("SVG", 5, "touch"): (0.861, 0.468, 0.454),
    ("Geng et al.", 5, "touch"): (0.746, 0.648, 0.331),
    ("Ours", 5, "touch"): (0.694, 0.676, 0.291),
    ("SVG", 5, "touch + vision"): (0.819, 0.501, 0.441),
    ("Geng et al.", 5, "touch + vision"): (0.721, 0.663, 0.314),
    ("Ours", 5, "touch + vision"): (0.671, 0.692, 0.277),
}
"""The same table, TouchReason-Video: (method, frames ahead, modality) → L1, SSIM, LPIPS."""

GAINS: tuple[tuple[str, str, str, float], ...] = (
    ("Abstract", "Avg", "Octopi-13B", 18.4),
    ("Abstract", "Avg", "GPT-4o", 24.7),
    ("Main results", "Avg", "SToLa", 12.6),
    ("Main results", "Avg", "Gemini-2.5-Pro", 22.5),
    ("Main results", "CSC", "SToLa", 19.4),
    ("Main results", "L2-EM", "SToLa", 17.4),
)
"""Where the text claims a gain of Touch-R1, in which column, over whom, how much."""

OBJECTS, SENSORS, MOTIONS = 1_000, 4, 7
"""Section 3.1, "Overview" and "Acquisition": at least so many objects; each is pressed, and moved with six motions."""

SEQUENCES, RECORDS = 14_700, 1_323_000
"""Section 3.1, "Acquisition": what is left after filtering."""

HELD_OUT_OBJECTS = 200
"""Section 4.1, "Benchmarks"."""

PRETRAIN_FRAMES, SFT_QA, RL_QA = 1_000_000, 240_000, 120_000
"""Section 4.1, "Training data and protocol": three disjoint subsets of the training split."""

ANNOUNCED = {"frames": 2_820_000, "sequences": 12_183, "questions for SFT": 230_000, "for reinforcement": 100_000}
"""Counts that the authors' page announces for their release, which is still empty."""

REWARD_WEIGHTS: Mapping[str, float] = {"accuracy": 0.6, "cross-sensor consistency": 0.3, "format": 0.1}
"""Section 3.2, the equation of the total reward."""

ADVERTISED_TERMS = ("accuracy", "cross-sensor consistency", "format", "tactile use")
"""Abstract and introduction: what credit is said to be given for."""

ABLATED_TERMS = ("accuracy", "cross-sensor consistency", "format")
"""Ablation table (a): rewards with a row of their own."""

HYPERPARAMETERS: Mapping[str, float] = {
    "group size": 8,
    "KL coefficient β": 1e-3,
    "learning rate, pretraining": 1e-4,
    "learning rate, SFT": 1e-5,
    "learning rate, GRPO": 1e-6,
    "frames of a sequence": 8,
    "picture side": 448,
}
"""Section 4.1, "Implementation details"; an appendix that was not published is said to hold more."""

OBJECTIVE_NEEDS = ("group size", "KL coefficient β", "learning rate, GRPO", "clip ε", "grounding weight γ")
"""What the objective of Section 3.2 cannot be computed without."""

ADVERTISED_MEASURES = ("property identification", "ordinal reasoning", "comparison", "cross-sensor", "conflict")
"""Abstract and Section 1: what the benchmark evaluates."""

MEASURED: Mapping[str, tuple[str, ...]] = {
    "property identification": ("H-Acc", "R-Acc", "P-Acc", "Mat-Acc"),
    "ordinal reasoning": ("OMAE", "L2-EM"),
    "comparison": ("SFD", "SOI-ρ"),
    "cross-sensor": ("CSC",),
}
"""Section 4.1, "Metrics": what each is measured by."""

BACKBONES = (3, 7, 14)
"""Figure "Scaling behavior": billions of parameters."""

RELEASED_BACKBONES = (3, 7, 32, 72)
"""Qwen2.5-VL's released sizes, billions (arXiv 2502.13923 and the later 32B release)."""

SEEDS: int | None = None
INTERVALS = 0
"""Sections 4.1–4.3: number of training seeds, not given; intervals or tests, none in any table."""

AUDITED, AUDIT_PASSED = 2_000, 91.6
"""Section 3.1, "QA Generation and Quality Verification"."""


def differences_table(rows: Sequence[tuple[str, str, str]]) -> Table:
    """Differences between the paper's experiment and this one: topic, in the paper, here."""
    return named_table(
        "What differs from the paper", [{"subject": topic, "paper": a, "here": b} for topic, a, b in rows]
    )
