"""Does ordinal credit (1 / 0.4 / 0) beat 0/1 credit on ordinal error and accuracy?

    make experiment EXP=ablation_ordinal
    make experiment EXP=ablation_ordinal ARGS="--data physiclear --data-dir DIR"

Three arms of GRPO start from the same SFT checkpoint of each seed and see the same questions in the same order; they
differ only in the reward.  `zero_one` gives 1 for the right level, `ordinal` also 0.4 for a neighbour, both with the
published consistency term.  `debiased` subtracts from the ordinal credit what a constant answer would earn, so that no
level is favoured, and rewards consistency only if the answer is right.  All arms give −0.1 for an answer that cannot
be parsed, and are compared with the control that continues SFT for as many seconds (`sft_continued`).

Cost: about 18 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: ordinal credit favours the middle level, which is next to both others (the answer "middle" earns more than
"low" if p(low) < p(middle) + 2/3 p(high)), so `ordinal` should give more middle answers than `zero_one`.  If only
middle answers lower OMAE, the policy does not use touch better.  `debiased` should reach the same OMAE without
more middle answers.
"""

from experiments.paper.components import ZERO_ONE
from experiments.study.ablation import Ablation, ablation_experiment
from experiments.study.scores import PUBLISHED

ABLATION = Ablation(
    arms={
        "zero_one": ZERO_ONE,
        "ordinal": PUBLISHED,
        "debiased": {"accuracy_debiased": 0.6, "consistency_gated": 0.3, "format": 0.1},
    },
    pairs=(("ordinal", "zero_one"), ("debiased", "zero_one"), ("debiased", "ordinal")),
    curves=("reward", "accuracy", "middle_rate", "entropy", "kl", "grounding", "degenerate_share", "length"),
    example="ordinal",
)

EXPERIMENT = ablation_experiment("ablation_ordinal", ABLATION)
