"""Shapes of the published training, and the ways to lay it out that are compared.

Touch-R1 (arXiv 2605.27154) trains Qwen2.5-VL 7B on 16 H200 with 8 frames of 448² pixels from four sensors and groups of
eight.  A frame of 448² is 16 · 16 tokens of Qwen2.5-VL, which reads two frames at a time: 4 · 256 tokens a sensor, and
256 for the view.  Lengths of question and answer are not published; here 128 and 512.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax

from touchr1_jax.distributed.abstract import AbstractStep, PromptShape, abstract_grpo
from touchr1_jax.distributed.memory import GRPOShape
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.qwen.config import QwenConfig, QwenVisionConfig, released
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.types import Parsed, Target

PAPER_PROMPT = PromptShape(streams=4, stream_tokens=1024, view_tokens=256, text_tokens=128)
TINY_PROMPT = PromptShape(streams=2, stream_tokens=4, view_tokens=4, text_tokens=8)

TINY = QwenConfig(
    decoder=DecoderConfig(
        vocab_size=256,
        hidden_size=32,
        num_layers=4,
        num_heads=4,
        num_kv_heads=2,
        head_dim=8,
        intermediate_size=64,
        mrope_section=(1, 1, 2),
        tie_embedding=False,
    ),
    vision=QwenVisionConfig(out_size=32, depth=1, hidden_size=32, num_heads=2, intermediate_size=64, full_layers=(0,)),
    vision_start_id=250,
    vision_end_id=251,
    image_id=252,
    video_id=253,
)
"""A model of the same make that compiles in seconds."""

OPTIMIZER = optax.adamw(1e-6)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setup:
    """One way to lay the training out: a mesh, and adapters on a frozen base where there are any."""

    mesh: MeshConfig
    lora: LoraConfig | None = None

    @property
    def name(self) -> str:
        """Such as `fsdp 8 × tensor 2`."""
        axes = {"data": self.mesh.data, "fsdp": self.mesh.fsdp, "tensor": self.mesh.tensor}
        mesh = " × ".join(f"{axis} {size}" for axis, size in axes.items() if size > 1)
        return f"{mesh or 'one device'}{'' if self.lora is None else f', LoRA {self.lora.rank}'}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """A model, its prompts, and the sizes of a step."""

    model: QwenConfig
    prompt: PromptShape
    group: int
    length: int
    micro_rows: int
    """Prompts of a micro-batch on each device."""
    prompts: int

    def shape(self, setup: Setup) -> GRPOShape:
        """What the memory of a step depends on."""
        rows = setup.mesh.data * setup.mesh.fsdp
        grpo = GRPOConfig(
            prompts=self.prompts,
            micro_prompts=min(self.prompts, rows * self.micro_rows),
            group=self.group,
            length=self.length,
            remat=True,
            bfloat16=True,
            algorithm=Paper(),
        )
        return GRPOShape(decoder=self.model.decoder, grpo=grpo, mesh=setup.mesh, prompt_tokens=self.prompt.tokens)

    def step(self, setup: Setup) -> AbstractStep:
        """The step in shapes alone."""
        return abstract_grpo(self.model, self.prompt, self.shape(setup), OPTIMIZER, lora=setup.lora)

    def of_depth(self, layers: int) -> "Training":
        """The same with another number of layers."""
        decoder = dataclasses.replace(self.model.decoder, num_layers=layers)
        return dataclasses.replace(self, model=dataclasses.replace(self.model, decoder=decoder))


def model_of(size: str) -> QwenConfig:
    """The released model of a size, or the tiny one."""
    return TINY if size == "tiny" else released(size)


def score_of(streams: int):
    """A reward of the right form for a step that is compiled and never run: how many tokens the label divides."""

    def score(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
        level = jnp.where(target.asked, tokens[0] % 3, -1)
        right = jnp.mean(tokens % 3 == jnp.max(target.label))
        parsed = Parsed(
            perceive=jnp.tile(level, (streams, 1)),
            compare=level,
            conclude=level,
            formatted=tokens[0] > 0,
            truncated=tokens[-1] > 0,
            length=jnp.sum(tokens > 0),
        )
        return right, {"right": right}, parsed

    return score
