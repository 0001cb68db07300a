"""Is the format reward needed once supervised fine-tuning has taught the format?

    make experiment EXP=ablation_format [ARGS="--scale smoke"]

Arms of GRPO from one SFT checkpoint per seed and the same questions: the published reward, the same without the format
term, and half of the weight on format.

Cost: about 25 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: the accuracy term already takes .1 from an answer that cannot be parsed, and the SFT checkpoint formats nearly
all of them, so `none` should keep its parse rate, and `heavy` should learn nothing else for its weight.
"""

from experiments.grpo.ablation import PUBLISHED, Ablation, ablation_experiment

ABLATION = Ablation(
    arms={
        "published": PUBLISHED,
        "none": {"accuracy": 0.6, "consistency": 0.3},
        "heavy": {"accuracy": 0.33, "consistency": 0.17, "format": 0.5},
    },
    pairs=(("published", "none"), ("heavy", "published")),
    curves=("reward", "accuracy", "parse_rate", "gamed_share", "truncated_share", "length", "entropy"),
    example="none",
)

EXPERIMENT = ablation_experiment("ablation_format", ABLATION)
