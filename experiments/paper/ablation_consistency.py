"""Does the cross-sensor consistency reward make answers more consistent, or only the slots that it reads?

    make experiment EXP=ablation_consistency [ARGS="--scale smoke"]

The arms of GRPO share one SFT checkpoint per seed, the questions, and the published ordinal and format rewards.  They
have no consistency term, the published term, or a gated term that counts only if the answer is right.

Cost: about 25 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: the same level in every slot satisfies the published term, so `echo_share` and the agreement of slots rise.
The published term also makes middle answers rare, because sensors disagree most about middle objects.  The gated term
should raise the consistency of conclusions (`csc`) without these two effects.
"""

from experiments.study.ablation import Ablation, ablation_experiment
from experiments.study.scores import PUBLISHED

ABLATION = Ablation(
    arms={
        "none": {"accuracy": 0.9, "format": 0.1},
        "published": PUBLISHED,
        "gated": {"accuracy": 0.6, "consistency_gated": 0.3, "format": 0.1},
    },
    pairs=(("published", "none"), ("gated", "none"), ("gated", "published")),
    curves=("reward", "accuracy", "middle_rate", "echo_share", "mode_share", "entropy", "parse_rate"),
)

EXPERIMENT = ablation_experiment("ablation_consistency", ABLATION)
