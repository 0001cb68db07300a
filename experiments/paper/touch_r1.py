"""What does the paper's training gain on released Qwen-VL weights, and how much of it comes from touch?

    make experiment EXP=touch_r1 ARGS="--weights DIR"
    make experiment EXP=touch_r1 ARGS="--weights DIR --data records --data-dir RECORDS"
    make experiment EXP=touch_r1 ARGS="--scale small|smoke|smoke_qwen3"

DIR holds a released Qwen2.5-VL or dense Qwen3-VL: config, tokenizer, chat template, picture settings and safetensors
(see `python -m touchr1_jax.models.load DIR`).  The experiment freezes its towers and adds a tactile encoder.
SFT trains the encoder and low-rank adapters on verified answers; GRPO with the published rewards and the
counterfactual KL continues to train the adapters.  The adapters are never merged into the released weights during
scoring, resuming or saving, because rounding to the weights' type would lose small changes.  `--lora.targets` names
the adapted layers of the decoder, `--lora.vision-targets` those of the vision tower, `--lora.rank-stabilised` scales
by rsLoRA, and `--model.four-bits` holds the decoder's frozen kernels in four bits (QLoRA).  The policy is scored on
unseen objects and compared with the released model, which sees the picture and no touch, with the same training without
touch, and with constants; it is evaluated again under each control of touch.  The run saves it in `policies/NAME/SEED`,
with adapters in PEFT's format, and evaluates the saved policy again.
`python -m experiments ask RUN/touch_r1/0 INPUT` asks it about new data;
`python -m experiments export RUN/touch_r1/0 FOLDER` merges it into whole weights.

`--scale smoke` makes a tiny checkpoint of the released format if none is given, `smoke_qwen3` one of Qwen3-VL.  Both
test the code, and their figures mean nothing: with random, frozen embeddings, no decoder can give the right token a
probability above 0.8 %, so greedy answers parse but GRPO samples noise.  `--scale small` first trains such a checkpoint
to write answers, without touch or pictures, and then trains it on touch, which tests training without released
weights.

With `--rollouts.url http://HOST:8000`, a vLLM server with the same weights samples the rollouts of GRPO (README of
`touchr1_jax`); all stages then number the tokens of a prompt consecutively, as the server does.

Pictures stay on disk: `--read-threads` threads prefetch batches, and the log shows how long steps wait for them.
Several devices: `--distributed --mesh.fsdp N` as in every study, with `--grpo.micro-prompts` a multiple of N; each
process first reads all weights.

Cost: not measured, because neither such weights nor such a machine were available; sized for the 3B or 7B on one H200,
where GRPO needs 28 or 52 GB by the count at the start of every run.  `--scale smoke` under two minutes; `--scale
small` 24 to 29 of one core per seed, of which scenes and teaching take 4 each.

Expected: the released model without touch is near the constant, and SFT is much better; the paper reports a further
gain from GRPO, which small policies lack (`grpo_verdict`).  At `small`, 65 % of the ordinal questions about unseen
objects are answered right by SFT, by GRPO and by continued SFT; 34 % by the checkpoint before training on touch, 38 %
by the same training without touch, and 34 % by a constant.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from experiments.core.context import Context
from experiments.core.progress import in_megabytes
from experiments.core.results import Estimate, Results, at_most
from experiments.core.runner import Experiment
from experiments.core.text import interval
from experiments.paper import released_policy as released
from experiments.paper.presets import CURVES
from experiments.paper.tiny_checkpoint import SMALLEST, SMALLEST_QWEN3, teach, write_tiny
from experiments.paper.touch_gain import (
    TouchGain,
    control_answers,
    control_variants,
    study_touch_gain,
    touch_gain_table,
)
from experiments.study.controls import decision_table, seconds_table
from experiments.study.dataset import Dataset
from experiments.study.estimates import compare_rows, estimate
from experiments.study.examples import rollout_examples
from experiments.study.levels import level_report
from experiments.study.scores import PUBLISHED, score, score_study, study_results, study_settings
from experiments.study.stages import StudySFT
from experiments.study.study import BLIND, CONTINUED, SFT, EvalVariant, check_arms, train_study
from experiments.study.training import TrainingConfig, open_data, require_encoder, starting_model
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.load import WeightsError, load_checkpoint
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.released_policy import ReleasedModel, ReleasedPolicy, build_released_policy, instruction
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import touch_shapes, with_lora
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.served import check_served
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.training.optimizer import OptimizerConfig
from touchr1_jax.training.rollout_server import RolloutsConfig
from touchr1_jax.training.train_encoder import EncoderTrainingConfig
from touchr1_jax.training.train_sft import SFTConfig
from touchr1_jax.types import Params

ARM, ZERO, WRITTEN = "touch_r1", "zero_shot", "written"

DRAWN = "These are drawn weights of a tiny model: this run tries the code, and its figures mean nothing."

TAUGHT = (
    "These are weights of a tiny model that was taught to write answers, without touch or pictures, before anything "
    "else: the figures show that this training learns from touch, and nothing about a released model."
)

COMPARED = ("acc", "omae", "csc", "mat_acc")

PAIRS = ((ARM, SFT), (ARM, CONTINUED), (SFT, ZERO), (SFT, BLIND), (SFT, "constant"))
"""Each step of training, and the earlier one or the baseline that it is compared with."""

GRPO = GRPOConfig(prompts=16, micro_prompts=2, length=96, lr_scale=10.0, bfloat16=True, remat=True)
"""At ten times the paper's learning rate, which is for whole weights."""


def adapted_sft(
    steps: int,
    *,
    micro_contacts: int,
    batch_size: int = 32,
    questions: int = 2,
    lr_scale: float = 10.0,
) -> StudySFT:
    """SFT by adapters, by default at ten times the paper's learning rate, which is for whole weights."""
    return StudySFT(
        steps=steps,
        batch_size=batch_size,
        questions=questions,
        micro_contacts=micro_contacts,
        remat=True,
        optimizer=OptimizerConfig(learning_rate=1e-5, lr_scale=lr_scale),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchR1Config(TrainingConfig):
    """The weights, and how they are trained; the defaults are for one H200.

    Raises:
      ValueError: nothing to train, or two precisions.
    """

    weights: Path | None = None
    """Folder of a released Qwen2.5-VL or Qwen3-VL."""
    tiny: bool = False
    """Make a tiny checkpoint of that format where no weights are given, to try the code."""
    tiny_decoder: DecoderConfig = SMALLEST
    """Shape of its decoder."""
    teaching_steps: int = 0
    """Steps of its training to write answers, before anything else; 0 leaves its weights as they were drawn."""
    seeds: int = 1
    scenes: SceneConfig = SceneConfig(objects=2400, sites=1, image_px=224, view_px=224)
    clip_memory_gib: float = 8.0
    read_threads: int = 8
    noise_contacts: int = 16
    model: ReleasedModel = ReleasedModel()
    encoders: EncoderTrainingConfig = EncoderTrainingConfig(steps=0)
    """None: what a released decoder reads is learned end to end, with its adapters."""
    sft: StudySFT = adapted_sft(1_500, micro_contacts=4)
    decoder: SFTConfig = adapted_sft(1_000, batch_size=16, questions=4, micro_contacts=4)
    grpo: GRPOConfig = GRPO
    grpo_steps: int = 1_000
    lora: LoraConfig = LoraConfig()
    """Adapters of the released towers, the same from SFT to the end of GRPO."""
    rollouts: RolloutsConfig = RolloutsConfig()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.lora.rank:
            raise ValueError("lora.rank is 0: must be at least 1, released towers are frozen; raise it")
        if self.grpo.bfloat16 != (self.model.dtype == "bfloat16"):
            raise ValueError(
                f"grpo.bfloat16 is {self.grpo.bfloat16}: must be {not self.grpo.bfloat16} for weights in "
                f"{self.model.dtype}; set both alike"
            )
        if self.rollouts.url is not None:
            check_served(self.grpo)
            if self.model.four_bits:
                raise ValueError(
                    "model.four_bits is True: must be False where a server draws rollouts from the weights as they are "
                    "released; leave out either"
                )


def run(config: TouchR1Config, context: Context) -> Results:
    """Load, train, score, write."""
    arms = {ARM: PUBLISHED}
    source = released_folder(config, context)
    variants = {
        ZERO: EvalVariant(of=SFT, evaluate=released.zero_shot),
        WRITTEN: EvalVariant(of=ARM, evaluate=released.written),
        **control_variants(ARM),
    }
    check_arms(arms, variants)
    policy, data, tactile = begin(config, source, context)
    memory = released.memory_bytes(config, policy, data, context.devices.shape)
    context.print(", ".join(f"{name}: {size / 1e9:.3g} GB" for name, size in memory.items()))
    order: dict[str, Any] = {"tactile": tactile, "rollouts": released.rollout_server(config.rollouts, context)}
    study = train_study(config, data, policy, arms, context, variants=variants, **order)
    scored = score_study(study)
    zero = [score(study, answers) for answers in study.variants[ZERO]]
    zero_shot = {metric: estimate([seed[metric] for seed in zero], scored.objects) for metric in zero[0]}
    baselines, rows = {ZERO: zero_shot, **scored.baselines}, {**scored.rows, ZERO: zero}
    pictures, tables = level_report(study)
    gain = study_touch_gain(study, ARM)
    both = zip(study.answers[ARM], study.variants[WRITTEN], strict=True)
    differing = sum(int((a.tokens != b.tokens).any(-1).sum()) for a, b in both)
    of = f"of {len(study.answers[ARM][0].tokens)} a seed"
    return study_results(
        study,
        scored,
        baselines=baselines,
        settings={
            **study_settings(config),
            "weights": f"{source.name}, {config.model.dtype}",
            "rollouts": config.rollouts.url or "by the step",
            "adapters": f"rank {config.lora.rank} on {', '.join((*config.lora.targets, *config.lora.vision_targets))}",
        },
        comparisons=tuple(c for pair in PAIRS for c in compare_rows(*pair, COMPARED, rows, scored.objects)),
        verdict=verdict(config, {**scored.arms, **baselines}, gain),
        requirements=(at_most("answers of the written policy that differ", differing, 0, note=of),),
        tables=(
            touch_gain_table({f"{ARM}, all": gain}),
            released.memory_table(memory),
            *decision_table(study),
            *tables,
            *seconds_table(study, context),
        ),
        pictures=pictures,
        curves=CURVES,
        examples=rollout_examples(study, ARM, PUBLISHED, {c: a[0] for c, a in control_answers(study, ARM).items()}),
    )


def begin(config: TouchR1Config, source: Path, context: Context) -> tuple[ReleasedPolicy, Dataset, Params | None]:
    """The policy, its data, and its pretrained tactile encoder; weights and sizes are checked before data are made.

    Raises:
      WeightsError, SizeError: as `load_checkpoint` and the checks of `released_policy`.
    """
    server = released.rollout_server(config.rollouts, context)
    model = dataclasses.replace(config.model, in_order=config.model.in_order or server is not None)
    with context.progress_callback("reading weights, MB") as report:
        found = load_checkpoint(source, jnp.dtype(model.dtype), in_megabytes(report), four_bits=model.four_bits)
    released.require_same(source, context)
    ahead = build_released_policy(model, found, SENSORS)
    ahead.check(touch_shapes(model, model.view_px, SENSORS))
    released.grpo_shape(config, ahead, context.devices.shape)
    if server is not None:
        server.check(with_lora(ahead, config.lora), config.grpo, context.devices)
    require_encoder(config.encoder, context)
    data = open_data(config, model.view_px, context)
    model, tactile = starting_model(model, config.encoder, data.clip.sensors)
    policy = build_released_policy(model, found, data.clip.sensors)
    return with_lora(policy, config.lora), data, tactile


def released_folder(config: TouchR1Config, context: Context) -> Path:
    """The weights to begin from, made where a trial has none.

    Raises:
      WeightsError: there are none.
    """
    if config.weights is not None:
        return config.weights
    if not config.tiny:
        raise WeightsError(
            "weights is None: must be the folder of a released Qwen2.5-VL or Qwen3-VL (config, tokenizer, chat "
            "template, picture settings, safetensors); pass --weights DIR, or --scale smoke to try the code on a tiny "
            "one"
        )
    made = context.directory / "tiny"

    def make() -> None:
        write_tiny(made, TOUCH_LANGUAGE, instruction(TOUCH_LANGUAGE), config.tiny_decoder)
        teach(made, config.teaching_steps, context)

    if not context.done("tiny"):
        context.processes.write_once(make)
        context.save_stage("tiny", {})
    return made


def verdict(
    config: TouchR1Config, rows: Mapping[str, Mapping[str, Estimate]], gain: TouchGain | None
) -> tuple[str, ...]:
    """Accuracy after each stage, and the gain from touch."""
    acc = lambda name: rows[name]["acc"].mean
    sentences = [
        f"Of ordinal questions about unseen objects the model answers {acc(ZERO):.1f} % right as it was released and "
        f"without touch, {acc(SFT):.1f} % after SFT, {acc(ARM):.1f} % after GRPO, {acc(CONTINUED):.1f} % after SFT for "
        "as many seconds more; trained without touch "
        f"{acc(BLIND):.1f} %, a constant {acc('constant'):.1f} %."
    ]
    if gain is not None:
        sentences.append(
            f"Accuracy gains at least {interval(gain.least.gain, '.1f')} points from touch (least over the controls: "
            f"{gain.least.control})."
        )
    if config.weights is None:
        sentences.insert(0, TAUGHT if config.teaching_steps else DRAWN)
    return tuple(sentences)


DEFAULT = TouchR1Config()

SMOKE = dataclasses.replace(
    DEFAULT,
    tiny=True,
    scenes=SceneConfig(objects=30, sites=1, image_px=56, view_px=32),
    read_threads=2,
    clip_memory_gib=0.0,
    model=ReleasedModel(
        tactile=TactileViTConfig(sensors=0, width=32, num_layers=1, num_heads=2, stem_width=4),
        frames=4,
        image_px=56,
        completion_tokens=48,
        view_px=32,
    ),
    sft=adapted_sft(8, batch_size=4, micro_contacts=2),
    decoder=adapted_sft(4, batch_size=4, micro_contacts=4),
    grpo=dataclasses.replace(GRPO, prompts=2, group=4, micro_prompts=1, length=48),
    grpo_steps=4,
    lora=LoraConfig(rank=4),
)

SMALL = dataclasses.replace(
    DEFAULT,
    tiny=True,
    tiny_decoder=dataclasses.replace(
        SMALLEST,
        hidden_size=96,
        num_layers=2,
        num_heads=3,
        num_kv_heads=1,
        head_dim=32,
        intermediate_size=192,
        mrope_section=(4, 6, 6),
    ),
    teaching_steps=500,
    scenes=SceneConfig(objects=900, sites=1),
    read_threads=1,
    clip_memory_gib=1.5,
    model=ReleasedModel(tactile=TactileViTConfig(sensors=0), frames=4, image_px=112, completion_tokens=36, view_px=32),
    sft=adapted_sft(1_000, batch_size=16, micro_contacts=2, lr_scale=100.0),
    decoder=adapted_sft(300, batch_size=16, questions=4, micro_contacts=4, lr_scale=100.0),
    grpo=dataclasses.replace(GRPO, prompts=8, micro_prompts=4, length=36, lr_scale=200.0),
    grpo_steps=150,
)
"""Decoder and encoder of the size of the studies' policies; SFT's rate and length were chosen on validation objects,
those of GRPO are not tuned."""

EXPERIMENT = Experiment(
    name="touch_r1",
    config=DEFAULT,
    scales={"smoke": SMOKE, "smoke_qwen3": dataclasses.replace(SMOKE, tiny_decoder=SMALLEST_QWEN3), "small": SMALL},
    run=run,
    curves=CURVES,
    quick=("smoke",),
    spreads=True,
)
