"""Settings of every study, whichever model it trains: data, stages, seeds."""

import dataclasses
import enum
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from experiments.core.concurrency import SEED_BYTES
from experiments.core.context import Context
from experiments.core.errors import DataError
from experiments.core.memory import require_memory
from experiments.study.dataset import Dataset
from experiments.study.sources import SourceConfig, open_source
from experiments.study.stages import StudySFT
from sensors_io.pipeline import ClipConfig
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import ATTRIBUTES, Flag
from sensors_io.selection import Shown
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.distributed.processes import GIB
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.pretrained import load_encoder
from touchr1_jax.models.touch_policy import TouchConfig
from touchr1_jax.rl.config import AnyAlgorithm, GRPOConfig
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import OptimizerConfig
from touchr1_jax.training.train_encoder import EncoderTrainingConfig
from touchr1_jax.training.train_sft import SFTConfig
from touchr1_jax.types import Params
from touchr1_jax.validation import at_least, by_name, unused

GRPO_SHARE = 0.35  # share of the training objects that SFT never sees under recipe `paper`

GRPO_ATTRIBUTES = ORDINAL
"""Attributes that GRPO asks about under recipe `paper`; the arms may differ in how they pay for the answers."""

Recipe = Literal["touch", "paper"]
"""Stages of training.

`paper`: SFT end to end, then GRPO on contacts that SFT never saw, about hardness, roughness and protrusion, as
published.
`touch`: the encoders learn levels by a linear head, then SFT teaches the decoder alone to read what they encode, then
GRPO on the same contacts, about all attributes, half of the questions with a part of the sensors, anchored by the
likelihood of the verified answers.  All stages learn from all training contacts; SFT of the decoder, GRPO and the
control end with their best checkpoint on validation objects.
"""

DECODER = SFTConfig(
    steps=600,
    questions=len(ATTRIBUTES),
    conclusion_weight=5.0,
    optimizer=OptimizerConfig(learning_rate=1e-5, lr_scale=100.0, warmup_steps=10),
)
"""The decoder's phase: 64 questions a step."""

SFT_STEPS_PER_GRPO_STEP = 1.2
"""Seconds of a step of GRPO over seconds of a step of the decoder's SFT, measured at the default sizes."""

CONTINUED_RATE = 0.2
"""Share of the decoder's rate at which the control continues, by default GRPO's own peak: at the whole rate 200 steps
lose about a point on validation objects, and a control that gets worse would refute nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingConfig(SourceConfig):
    """Data, their tactile input, SFT and GRPO."""

    seeds: int = 5
    """Training seeds, paired between arms."""
    scenes: SceneConfig = SceneConfig(objects=2400, sites=1)
    clip_memory_gib: float = 1.5
    """Clips that stay in memory once they were read; all of a study's default."""
    read_threads: int = 1
    """Threads that read clips ahead; on two cores a second one would only take time from the step."""
    noise_contacts: int = 64
    """Contacts whose pixels and forces give noise its statistics; they are in memory at once."""
    show: Shown = "pictures"
    """`fields` shows the policy depth and deformation as images in the place of pictures, where records have both."""
    model: TouchConfig = TouchConfig()
    encoder: Path | None = None
    """Run of `pretrain_encoder`, or its `encoder.npz`, that SFT starts from; its shape replaces `model.tactile`."""
    probe: ProbeConfig = ProbeConfig()
    encoders: EncoderTrainingConfig = EncoderTrainingConfig()
    """Training of the encoders by a linear head, under recipe `touch`; 0 steps leave it out."""
    sft: StudySFT = StudySFT(steps=0)
    """SFT end to end, after that of the encoders where there is any; recipe `paper` needs it."""
    recipe: Recipe = "touch"
    """`paper` is the published recipe; `touch` trains in phases and anchors GRPO (see `Recipe`)."""
    decoder: SFTConfig = DECODER
    """The decoder's phase of SFT on encoded contacts; the control that continues SFT has its batches and rates too."""
    anchor: float = 1.0
    """Weight of the verified answers' likelihood in GRPO, under recipe `touch`."""
    grpo: GRPOConfig = GRPOConfig()
    more_rewards: Annotated[dict[str, float], by_name(float)] = dataclasses.field(default_factory=dict)
    """Rewards that every arm earns besides its own, as in `overlong 0.1 diversity 0.05`."""
    grpo_steps: int = 150
    grpo_save_every: int = 50
    """Steps between checkpoints, of which recipe `touch` takes the best on validation objects."""
    lora: LoraConfig = LoraConfig(rank=0)
    """Adapters that SFT and GRPO train in the place of the adapted towers' weights; rank 0 trains the weights."""
    samples: int = 8
    """Sampled answers to each test question, for pass@k, maj@k and calibration; 0 asks for greedy answers only."""

    @property
    def blind(self) -> StudySFT:
        """SFT of the control without touch: as many questions as in the policy's SFT, asked as in its last phase."""
        if self.recipe == "paper":
            return self.sft
        last = {field.name: getattr(self.decoder, field.name) for field in dataclasses.fields(SFTConfig)}
        end_to_end = self.sft.steps * self.sft.batch_size * self.sft.questions
        more = math.ceil(end_to_end / (self.decoder.batch_size * self.decoder.questions))
        return StudySFT(**last | {"steps": self.decoder.steps + more})

    @property
    def continued(self) -> SFTConfig:
        """SFT of the decoder for as many seconds as an arm of GRPO takes, at `CONTINUED_RATE` of its rate."""
        optimizer = self.decoder.optimizer
        optimizer = dataclasses.replace(optimizer, lr_scale=CONTINUED_RATE * optimizer.lr_scale)
        steps = round(self.grpo_steps * SFT_STEPS_PER_GRPO_STEP)
        return dataclasses.replace(self.decoder, steps=steps, optimizer=optimizer)

    def algorithm(self, preset: AnyAlgorithm) -> AnyAlgorithm:
        """The algorithm of an arm: its preset, under recipe `touch` with the anchor."""
        return dataclasses.replace(preset, anchor=self.anchor) if self.recipe == "touch" else preset

    @property
    def grpo_loop(self) -> LoopConfig:
        """Steps of GRPO and when they are saved."""
        return LoopConfig(steps=self.grpo_steps, save_every=self.grpo_save_every)

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 1, "seeds", "grpo_save_every", "read_threads", "noise_contacts")
        at_least(self, 0, "clip_memory_gib", "grpo_steps", "samples", "anchor")
        if not self.sft.steps and (self.recipe == "paper" or not self.encoders.steps):
            raise ValueError(
                f"sft.steps is 0: must be at least 1 where recipe {self.recipe!r} trains the encoders by nothing else; "
                "set it, for example to 1350"
            )
        unused(self.decoder, "decoder", pack=0, curriculum=0.0)
        for name in ("sft", "decoder"):
            if (questions := getattr(self, name).questions) > len(ATTRIBUTES):
                raise ValueError(
                    f"{name}.questions is {questions}: must be at most {len(ATTRIBUTES)}, one each; lower it"
                )
        require_derived("tactile.sensors", self.model.tactile.sensors)
        if self.grpo.length != self.model.completion_tokens:
            raise ValueError(
                f"grpo.length is {self.grpo.length}: must be model.completion_tokens = {self.model.completion_tokens}, "
                "the length that SFT teaches; set both"
            )


def require_derived(field: str, value: int) -> None:
    """Refuse a number of the model that the data or the language determine."""
    if value:
        raise ValueError(f"model.{field} is {value}: must be 0, the data and the language determine it; leave it out")


def open_data(config: TrainingConfig, view_px: int, context: Context, at_once: int = 1) -> Dataset:
    """Records of the configured source, with clips of the model's size and pictures of `view_px` rows and columns.

    `at_once` is the number of seeds that are trained at the same time, for the estimate of the memory.

    Frames past the strain limit stay in: leaving them out would let the length of the force ramp give hardness away.

    Raises:
      DataError: records of a sensor that answers cannot name, a part without any label of hardness or the like, or
        one object alone with such a label to test on.
      ConfigurationError: other records than the run began with.
    """
    clip = ClipConfig(
        frames=config.model.frames,
        image_px=config.model.image_px,
        view_px=view_px,
        rejected=(Flag.NOT_CONVERGED, Flag.SATURATED),
        show=config.show,
    )
    parts = {"clips at most": round(config.clip_memory_gib * GIB)}
    more = {f"{at_once} seeds at a time": (at_once - 1) * SEED_BYTES} if at_once > 1 else {}
    context.print(require_memory(parts | more))
    grpo_share, memory_gib = GRPO_SHARE if config.recipe == "paper" else None, config.clip_memory_gib
    data = open_source(config, clip, grpo_share, context, memory_gib=memory_gib, threads=config.read_threads)
    known = [sensor.name for sensor in TOUCH_LANGUAGE.sensors]
    if unknown := [name for name in data.clip.sensors if name not in known]:
        raise DataError(
            f"{data.store.path} holds records of {', '.join(unknown)}: answers name {', '.join(known)}; import the "
            "records under one of these names, or add the sensor to `touchr1_jax.text.language`"
        )
    scored = [ATTRIBUTES.index(name) for name in ORDINAL]
    if bare := [part for part in data.parts if data.labels(part)[:, scored].max() < 0]:  # else found after training
        raise DataError(
            f"part {bare[0]!r} of {data.store.path} holds no object with a label of {', '.join(ORDINAL)}: every part "
            "needs one, for scores are of them; label some by `python -m sensors_io label RECORDS --labels LABELS.csv "
            "--annotator NAME`, or deal the splits out anew"
        )
    test = data.object_ids[data.parts["test"]][data.labels("test")[:, scored].max(1) >= 0]
    if len({*test}) < 2:
        raise DataError(
            f"part 'test' of {data.store.path} holds {str(test[0])!r} alone with a label of {', '.join(ORDINAL)}: must "
            "hold two objects, for intervals are over objects; label more, or deal the splits out anew"
        )
    return data


def require_encoder(encoder: Path | None, context: Context) -> None:
    """Refuse, before data are made, a file that is no encoder, or another one than the run began with.

    `runs/pretrain_encoder/latest` is another one after the next run of that experiment.

    Raises:
      EncoderError, ConfigurationError: naming the file.
    """
    if encoder is not None:
        digest = hashlib.sha256(load_encoder(encoder).to_bytes()).hexdigest()[:16]
        context.require_same("encoder", digest, f"{encoder}, the encoder,")


M = TypeVar("M", bound=TouchConfig)


def starting_model(model: M, encoder: Path | None, sensors: tuple[str, ...]) -> tuple[M, Params | None]:
    """The sizes to train and the tactile encoder to start from, if one is given: then its shape is the encoder's."""
    if encoder is None:
        return model, None
    pretrained = load_encoder(encoder).for_sensors(sensors)
    return dataclasses.replace(model, tactile=pretrained.config), pretrained.params


def preset_name(config: GRPOConfig) -> str:
    """Name of the algorithm's preset, and what differs from it and from the default sizes, as reports print it."""
    sizes = {f.name: f.default for f in dataclasses.fields(GRPOConfig) if f.name != "algorithm"}
    return algorithm_name(config.algorithm, _changes(config, sizes))


def algorithm_name(algorithm: AnyAlgorithm, further: Sequence[str] = ()) -> str:
    """Name of an algorithm's preset, and what differs from it, with `further` changes."""
    changes = [*_changes(algorithm, vars(type(algorithm)())), *further]
    return " ".join([type(algorithm).__name__.lower(), *([f"with {', '.join(changes)}"] if changes else [])])


def _changes(config: object, defaults: Mapping[str, Any]) -> list[str]:
    word = lambda value: value.value if isinstance(value, enum.Enum) else value
    now = {name: getattr(config, name) for name in defaults}
    return [f"{name}={word(now[name])}" for name, default in defaults.items() if now[name] != default]
