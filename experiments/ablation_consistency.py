"""Does the cross-sensor consistency reward make answers more consistent, or only the slots that it reads?

    make experiment EXP=ablation_consistency [ARGS="--scale smoke"]

Arms of GRPO from one SFT checkpoint per seed and the same questions, with the published ordinal and format rewards:
without the consistency term, with the published one, and with the one that counts only where the answer is right.

Cost: about 25 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: the published term can be met by writing one level into every slot (`echo_share` rises, and with it the
agreement of slots), and it drives the middle level out, since sensors disagree most about middle objects; the gated
term should raise consistency of conclusions (`csc`) without either.
"""

import dataclasses

from experiments.grpo.ablation import PUBLISHED, Ablation, run_ablation
from experiments.policies.stages import SFTConfig
from experiments.policies.study import StudyConfig
from experiments.reporting.results import Results
from experiments.running.context import Context
from experiments.running.runner import Experiment
from sensors_io.scenes import SceneConfig
from touchr1_jax.rl.config import GRPOConfig

ABLATION = Ablation(
    arms={
        "none": {"accuracy": 0.9, "format": 0.1},
        "published": PUBLISHED,
        "gated": {"accuracy": 0.6, "consistency_gated": 0.3, "format": 0.1},
    },
    pairs=(("published", "none"), ("gated", "none"), ("gated", "published")),
    curves=("reward", "accuracy", "middle_rate", "echo_share", "mode_share", "entropy", "parse_rate"),
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

EXPERIMENT = Experiment(name="ablation_consistency", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
