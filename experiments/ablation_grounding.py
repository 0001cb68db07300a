"""Does the tactile grounding term make answers depend on touch, and at which strength does it stop helping?

    make experiment EXP=ablation_grounding [ARGS="--scale smoke"]

Arms of GRPO from one SFT checkpoint per seed, the published reward, the same questions: no grounding, the published
term at γ = .01, four times that with gradient through both branches, and the bounded form (masked branch held fixed,
1 nat a token at most) at the same .04.

Cost: about 35 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: PAPO (arXiv 2507.06448), where the term comes from, reports that .04 collapses; so `strong` should show a
growing `grounding` curve and lose accuracy, `strong_bounded` should not, and γ = .01 should change little.
"""

import dataclasses

from experiments.grpo.ablation import PUBLISHED, Ablation, run_ablation
from experiments.policies.stages import SFTConfig
from experiments.policies.study import StudyConfig
from experiments.reporting.results import Results
from experiments.running.context import Context
from experiments.running.runner import Experiment
from sensors_io.scenes import SceneConfig
from touchr1_jax.rl.config import GRPOConfig, Paper

STRONG = 0.04
"""The γ at which PAPO collapses without a cap."""

ABLATION = Ablation(
    arms=dict.fromkeys(("none", "paper", "strong", "strong_bounded"), PUBLISHED),
    algorithms={
        "none": Paper(gamma=0.0),
        "paper": Paper(),
        "strong": Paper(gamma=STRONG),
        "strong_bounded": Paper(gamma=STRONG, grounding_stop_masked=True, grounding_cap_nat=1.0),
    },
    pairs=(("paper", "none"), ("strong", "none"), ("strong_bounded", "strong")),
    curves=("reward", "accuracy", "grounding", "grounding_peak", "entropy", "kl", "parse_rate"),
)


def run(config: StudyConfig, context: Context) -> Results:
    """Train and compare the arms."""
    return run_ablation(ABLATION, config, context)


DEFAULT = StudyConfig()
SMOKE = dataclasses.replace(
    DEFAULT,
    seeds=2,
    scenes=SceneConfig(objects=60, sites=1),
    sft=SFTConfig(steps=12, batch_size=8),
    blind=SFTConfig(steps=12, batch_size=8),
    grpo=dataclasses.replace(GRPOConfig.paper(), prompts=4, micro_prompts=2),
    grpo_steps=4,
)

EXPERIMENT = Experiment(name="ablation_grounding", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
