"""Does the tactile grounding term make answers depend on touch, and at which strength does it stop helping?

    make experiment EXP=ablation_grounding [ARGS="--scale smoke"]

The arms of GRPO share one SFT checkpoint per seed, the published reward and the questions: no grounding, the published
term (gradient through both branches) at γ = .01 and at γ = .04 (`strong`), and the bounded form (no gradient through
the masked branch, at most 1 nat a token) at γ = .04.

Cost: about 35 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: PAPO (arXiv 2507.06448), the source of the term, reports collapse at .04; so `strong` should show a growing
`grounding` curve and lose accuracy, `strong_bounded` should not, and γ = .01 should change little.
"""

from experiments.paper.components import UNGROUNDED
from experiments.study.ablation import Ablation, ablation_experiment
from experiments.study.scores import PUBLISHED
from touchr1_jax.rl.config import Paper

STRONG = 0.04  # the γ at which PAPO collapses without a cap

ABLATION = Ablation(
    arms=dict.fromkeys(("none", "paper", "strong", "strong_bounded"), PUBLISHED),
    algorithms={
        "none": UNGROUNDED,
        "paper": Paper(),
        "strong": Paper(gamma=STRONG),
        "strong_bounded": Paper(gamma=STRONG, grounding_stop_masked=True, grounding_cap_nat=1.0),
    },
    pairs=(("paper", "none"), ("strong", "none"), ("strong_bounded", "strong")),
    curves=("reward", "accuracy", "grounding", "grounding_peak", "entropy", "kl", "parse_rate"),
)

EXPERIMENT = ablation_experiment("ablation_grounding", ABLATION)
