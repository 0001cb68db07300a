"""Does the tactile-use reward R_tu make the policy use touch?

    make experiment EXP=ablation_tactile_use [ARGS="--scale smoke"]

R_tu rewards answers that score higher with touch than without it.  The arms of GRPO share one SFT checkpoint per seed,
the published reward and the questions: no R_tu; the abstract's literal bonus, added to the reward before
normalisation; the recommended bonus, added to the advantage after normalisation.  Each question is also sampled
without touch, with noise, and with another object's touch.

Cost: about 60 minutes on two cores with five seeds (the controls more than double the rollouts); `--scale smoke` two.

Expected: if a group has only two reward values, right and wrong, division by σ cancels the literal bonus
(`bonus_cancelled_share` and `bonus_telling_share`) but not the recommended one.  The difference between the curves
`touch_score` and `control_*` should be larger under `recommended` than under `none`.
"""

from experiments.study.ablation import Ablation, ablation_experiment
from experiments.study.scores import PUBLISHED
from touchr1_jax.rl.config import Paper, TactileUse

ABLATION = Ablation(
    arms=dict.fromkeys(("none", "literal", "recommended"), PUBLISHED),
    algorithms={
        "none": Paper(),
        "literal": Paper(tactile_use=TactileUse.LITERAL),
        "recommended": Paper(tactile_use=TactileUse.RECOMMENDED, tactile_margin=0.13),
    },
    pairs=(("literal", "none"), ("recommended", "none"), ("recommended", "literal")),
    curves=("reward", "accuracy", "touch_score", "control_drop", "control_noise", "control_order", "entropy"),
)

EXPERIMENT = ablation_experiment("ablation_tactile_use", ABLATION)
