"""Is the format reward needed once supervised fine-tuning has taught the format?

    make experiment EXP=ablation_format [ARGS="--scale smoke"]

Arms of GRPO from one SFT checkpoint per seed and the same questions: the published reward, the same without the format
term, and half of the weight on format.

Cost: about 25 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: the accuracy term already takes .1 from an answer that cannot be parsed, and the SFT checkpoint formats nearly
all of them, so `none` should keep its parse rate, and `heavy` should learn nothing else for its weight.
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
        "published": PUBLISHED,
        "none": {"accuracy": 0.6, "consistency": 0.3},
        "heavy": {"accuracy": 0.33, "consistency": 0.17, "format": 0.5},
    },
    pairs=(("published", "none"), ("heavy", "published")),
    curves=("reward", "accuracy", "parse_rate", "gamed_share", "truncated_share", "length", "entropy"),
    example="none",
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

EXPERIMENT = Experiment(name="ablation_format", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
