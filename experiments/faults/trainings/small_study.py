"""Does training that is killed end as if it had not been?

    main(["small_study"], package="experiments.faults.trainings")

The run that `stability_faults` kills: SFT, GRPO and a baseline without touch, as every study trains them, with networks
so small that the loop takes most of the time of a step.  A checkpoint is written every few steps, so that many kills
interrupt one.
"""

import dataclasses

from experiments.core.context import Context
from experiments.core.results import Results
from experiments.core.runner import Experiment
from experiments.study.scores import PUBLISHED
from experiments.study.stages import StudySFT
from experiments.study.study import StudyConfig, run_study
from experiments.study.training import DECODER
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import ModelConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.training.train_encoder import EncoderTrainingConfig

ARM = "paper"

MODEL = ModelConfig(
    tactile=TactileViTConfig(sensors=0, width=16, num_layers=0, num_heads=2, stem_width=4),
    vision=VisionConfig(image_px=16, patch_px=8, width=8, num_layers=0),
    decoder=DecoderConfig(
        vocab_size=0, hidden_size=24, num_layers=1, num_heads=2, num_kv_heads=1, head_dim=8, intermediate_size=32,
        mrope_section=(1, 1, 2),
    ),
    frames=4, image_px=28, completion_tokens=20,
)  # fmt: skip
"""So small that a step takes as long as the loop around it."""

SCENES = SceneConfig(
    objects=16, sites=1, frames=4, image_px=28, contact_grid=24, view_px=16, split_shares=(0.6, 0.1, 0.3),
    solver_tolerance=1e-2, solver_max_iterations=20,
)  # fmt: skip

STUDY = StudyConfig(
    seeds=1,
    scenes=SCENES,
    model=MODEL,
    probe=ProbeConfig(folds=2, iterations=4),
    encoders=EncoderTrainingConfig(steps=60, batch_size=4, save_every=3),
    sft=StudySFT(steps=60, batch_size=4, save_every=3),
    decoder=dataclasses.replace(DECODER, steps=30, batch_size=2, questions=2, save_every=3),
    grpo=GRPOConfig(prompts=2, group=3, length=20, micro_prompts=2),
    grpo_steps=60,
    grpo_save_every=3,
)

SHORT = dataclasses.replace(
    STUDY,
    encoders=dataclasses.replace(STUDY.encoders, steps=12),
    sft=dataclasses.replace(STUDY.sft, steps=12),
    decoder=dataclasses.replace(STUDY.decoder, steps=6),
    grpo_steps=12,
)


def run(config: StudyConfig, context: Context) -> Results:
    """Train and query every policy; its results are the files of the run."""
    study = run_study(config, {ARM: PUBLISHED}, context)
    return Results(
        verdict=("It came to its end.",),
        data={"questions": {name: len(answers[0].contact) for name, answers in study.answers.items()}},
    )


EXPERIMENT = Experiment(name="small_study", config=STUDY, scales={"short": SHORT}, run=run, spreads=True)
