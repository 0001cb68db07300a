"""Is the format reward needed once supervised fine-tuning has taught the format?

    make experiment EXP=ablation_format [ARGS="--scale smoke"]

The arms of GRPO share one SFT checkpoint per seed and the questions: the published reward, the same without the format
term, half of the weight on format, and the published reward with constrained decoding, so that every rollout is
formatted.  Evaluation is unconstrained for all arms.  The report ends with the seconds of every arm.

Cost: about 35 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: the accuracy term already subtracts .1 for an answer that cannot be parsed, and the SFT checkpoint formats
nearly all answers, so `none` should keep its parse rate, and `heavy` should gain nothing from its weight.  Constrained
rollouts are never penalised for their format, so the policy may forget the format in unconstrained decoding.
"""

from experiments.paper.components import published_without
from experiments.study.ablation import Ablation, ablation_experiment
from experiments.study.scores import PUBLISHED
from touchr1_jax.rl.config import Paper

ABLATION = Ablation(
    arms={
        "published": PUBLISHED,
        "none": published_without("format"),
        "heavy": {"accuracy": 0.33, "consistency": 0.17, "format": 0.5},
        "constrained": PUBLISHED,
    },
    algorithms={"constrained": Paper(constrained=True)},
    pairs=(("published", "none"), ("heavy", "published"), ("constrained", "published")),
    curves=("reward", "accuracy", "parse_rate", "gamed_share", "truncated_share", "length", "entropy"),
    example="none",
)

EXPERIMENT = ablation_experiment("ablation_format", ABLATION)
