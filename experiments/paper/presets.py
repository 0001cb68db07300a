"""Scales of the paper's experiments (two cores, `smoke`, one accelerator, the paper's sizes), and their curves.

    SCALES = {"smoke": SMOKE, "gpu": GPU, "paper": PAPER}, refused on a machine that lacks what `NEEDS` says

`gpu` is sized for one accelerator of 80 GB and one or two hours per seed.  `paper` has the sizes that Touch-R1
(arXiv 2605.27154) names: 1,000 objects and 14,700 sequences by four sensors, 8 frames of 448², a decoder of
Qwen2.5-VL 7B's shape, groups of 8, 240,000 questions for SFT and 120,000 for GRPO, three seeds where the paper has one.

Departures of `paper`: towers and decoder start from random parameters, since a study loads no released weights, so
learning rates are ten times the paper's; answers have the fixed form of `touchr1_jax.text` and 20 tokens; the paper
gives no batch sizes, so these are ours.  Neither scale has been run, because no such machine was available.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from experiments.core.context import Context
from experiments.core.results import Results
from experiments.core.runner import Experiment
from experiments.study import paper_numbers as paper
from experiments.study.ablation import SFT_CURVES
from experiments.study.stages import StudySFT
from experiments.study.study import SMOKE, StudyConfig
from experiments.study.training import DECODER
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.questions.draw import Quota
from touchr1_jax.distributed.processes import Accelerators
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.qwen.config import RELEASED
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import ModelConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.training.optimizer import OptimizerConfig
from touchr1_jax.training.train_encoder import EncoderTrainingConfig

BENCH = StudyConfig(
    encoders=EncoderTrainingConfig(),
    decoder=dataclasses.replace(DECODER, steps=1200, save_every=300),
    grpo_steps=200,
)
"""The default: longer phases of the encoders and the decoder than in `ablation_ordinal`, whose score on validation
objects still rises at its end; policies that several studies share may cost more than a main job."""

SMALL_QUOTA = Quota(identify=48, scale=18, compose=16, compare=12, order=6, one_sensor=16, conflict=8)
"""Questions of the bench at `smoke`; every other scale asks all 4,800."""

NEEDS: Mapping[str, Accelerators] = {
    "gpu": Accelerators(number=1, memory_gib=70.0),
    "paper": Accelerators(number=16, memory_gib=130.0),
}
"""An H100 or H200; sixteen H200, of which a step needs 43 GB each (`scale_paper`)."""


def _study(
    steps: tuple[int, int], batch: tuple[int, int, int], lr_scale: tuple[float, float], **other: Any
) -> StudyConfig:
    """A study on accelerators, by whole batches: micro-batches of SFT serve a processor's cache.

    `steps` and `lr_scale` are of SFT and of GRPO, `batch` contacts of SFT, prompts of GRPO and those of a micro-batch.
    """
    contacts, prompts, micro_prompts = batch
    optimizer = OptimizerConfig(learning_rate=1e-5, lr_scale=lr_scale[0])
    sft = StudySFT(steps=steps[0], batch_size=contacts, micro_contacts=contacts, optimizer=optimizer)
    grpo = GRPOConfig(
        prompts=prompts,
        micro_prompts=micro_prompts,
        lr_scale=lr_scale[1],
        bfloat16=True,
        remat=True,
    )
    decoder = dataclasses.replace(sft, questions=len(ATTRIBUTES))
    return StudyConfig(
        encoders=EncoderTrainingConfig(steps=0),  # SFT end to end trains them
        sft=sft,
        decoder=decoder,
        grpo=grpo,
        grpo_steps=steps[1],
        read_threads=12,
        **other,
    )


GPU_MODEL = ModelConfig(
    tactile=TactileViTConfig(sensors=0, width=384, num_layers=8, num_heads=6, mlp_ratio=4),
    vision=VisionConfig(image_px=224, width=384, num_layers=6, num_heads=6, mlp_ratio=4),
    decoder=DecoderConfig(
        vocab_size=0,
        hidden_size=768,
        num_layers=12,
        num_heads=12,
        num_kv_heads=4,
        head_dim=64,
        intermediate_size=3072,
        mrope_section=(8, 12, 12),
    ),
    frames=8,
    image_px=224,
)
"""135 million parameters."""


def _resized(width: int, layers: int) -> ModelConfig:
    """`GPU_MODEL` with other widths and depths of the tactile encoder and the decoder; heads keep their size."""
    decoder, tactile = GPU_MODEL.decoder, GPU_MODEL.tactile
    return dataclasses.replace(
        GPU_MODEL,
        tactile=dataclasses.replace(tactile, width=width // 2, num_heads=width // 128, num_layers=layers),
        decoder=dataclasses.replace(
            decoder,
            hidden_size=width,
            num_heads=width // decoder.head_dim,
            intermediate_size=4 * width,
            num_layers=layers,
        ),
    )


GPU_SMALL, GPU_LARGE = _resized(512, 10), _resized(1024, 16)
"""Less and more than `GPU_MODEL`, about as 3 and 14 billion are to 7."""

GPU = _study(
    steps=(4_000, 2_000),
    batch=(64, 64, 32),
    lr_scale=(30.0, 50.0),
    scenes=SceneConfig(objects=10_000, sites=1, image_px=224, view_px=224),
    clip_memory_gib=40.0,
    model=GPU_MODEL,
)

PAPER_MODEL = ModelConfig(
    tactile=TactileViTConfig(sensors=0, width=1280, num_layers=32, num_heads=16, mlp_ratio=4),
    vision=VisionConfig(image_px=448, width=1280, num_layers=32, num_heads=16, mlp_ratio=4),
    decoder=dataclasses.replace(RELEASED["7B"].decoder, vocab_size=0),
    frames=int(paper.HYPERPARAMETERS["frames of a sequence"]),
    image_px=int(paper.HYPERPARAMETERS["picture side"]),
)

PAPER_CONTACTS, PAPER_PROMPTS = 128, 128
"""Contacts of a batch of SFT, with two questions each, and prompts of a step of GRPO: ours."""

PAPER = _study(
    steps=(paper.SFT_QA // (2 * PAPER_CONTACTS), paper.RL_QA // PAPER_PROMPTS),
    batch=(PAPER_CONTACTS, PAPER_PROMPTS, 16),
    lr_scale=(10.0, 10.0),
    recipe="paper",
    seeds=3,
    scenes=SceneConfig(objects=paper.OBJECTS, sequences=paper.SEQUENCES, image_px=448, view_px=448),
    clip_memory_gib=0.0,
    model=PAPER_MODEL,
)

SCALES: Mapping[str, StudyConfig] = {"smoke": SMOKE, "gpu": GPU, "paper": PAPER}

_REWARDED = ("reward", "accuracy", "middle_rate", "echo_share")
GRPO_CURVES = (*_REWARDED, "entropy", "grounding", "degenerate_share", "parse_rate", "kl")
CURVES: Mapping[str, tuple[str, ...]] = {**SFT_CURVES, "grpo": GRPO_CURVES}
"""Of each phase the scalars that are drawn."""

DIFFERENCES: tuple[tuple[str, str, str], ...] = (
    ("policy", "Qwen2.5-VL, 7 billion pretrained parameters", "0.4 million parameters by default, from scratch"),
    ("base", "the pretrained model, asked without training", "the commonest level of each attribute"),
    (
        "data",
        "14,700 recorded sequences by four sensors",
        "generated objects, 2,400 by default, a press by four sensors",
    ),
    ("questions", "4,800, authored and audited", "all four attributes of every unseen object"),
    ("learning rate", "1e-6 in GRPO, 1e-5 in SFT", "by default the same times 200 falling to 10, and times 100"),
    ("grounding γ, clip", "not given", ".01, .2"),
    ("tactile use", "in no equation", "an arm of its own, above the paper's last row"),
    ("Avg of the ladder", "equals the mean of its four accuracies", "that mean"),
    ("seeds, intervals", "none", "paired seeds; seeds and objects, corrected over the table"),
)
"""Topic, in the paper, here: why the figures are not expected to agree beyond their signs."""

C = TypeVar("C")


def paper_experiment(
    name: str, config: C, scales: Mapping[str, C], run: Callable[[C, Context], Results], *, spreads: bool = True
) -> Experiment[C]:
    """`Experiment` with `CURVES`, the machine that each scale needs, and a quick `smoke`; arguments of `Experiment`."""
    needs = {scale: NEEDS[scale] for scale in scales if scale in NEEDS}
    options: dict[str, Any] = {"curves": CURVES, "needs": needs, "quick": ("smoke",), "spreads": spreads}
    return Experiment(name=name, config=config, scales=scales, run=run, **options)
