"""A process of sixteen devices that compiles a tiny Qwen2.5-VL GRPO step of one and four layers, and prints."""

import dataclasses
import json

import optax

from tests.touchr1_jax import tiny
from tests.touchr1_jax.distributed.problems import score
from touchr1_jax.distributed.abstract import AbstractStep, PromptShape, abstract_grpo, compile_grpo
from touchr1_jax.distributed.memory import ARGUMENTS, GRPOShape, grpo_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.qwen.config import QwenConfig, QwenVisionConfig
from touchr1_jax.rl.config import GRPOConfig

OPTIMIZER = optax.adamw(1e-6)
DECODER = DecoderConfig(
    vocab_size=512,
    hidden_size=64,
    num_heads=4,
    num_kv_heads=2,
    head_dim=16,
    intermediate_size=256,
    mrope_section=(2, 3, 3),
    tie_embedding=False,
)
VISION = QwenVisionConfig(out_size=64, depth=1, hidden_size=32, num_heads=2, intermediate_size=64, full_layers=(0,))
PROMPT = PromptShape(streams=tiny.S, stream_tokens=4, view_tokens=4, text_tokens=48)
GRPO = GRPOConfig(prompts=16, micro_prompts=16, group=8, length=16, remat=True, max_logits=16 * 512)


def tiny_step(layers: int, mesh: MeshConfig, lora: LoraConfig | None = None) -> tuple[GRPOShape, AbstractStep]:
    """A step of a decoder of so many layers."""
    decoder = dataclasses.replace(DECODER, num_layers=layers)
    ids = {"vision_start_id": 500, "vision_end_id": 501, "image_id": 502, "video_id": 503}
    shape = GRPOShape(decoder=decoder, grpo=GRPO, mesh=mesh, prompt_tokens=PROMPT.tokens)
    return shape, abstract_grpo(QwenConfig(decoder=decoder, vision=VISION, **ids), PROMPT, shape, OPTIMIZER, lora=lora)


def main() -> None:
    """Print counted arguments and compiled figures by number of layers."""
    found = {}
    for layers in (1, 4):
        shape, step = tiny_step(layers, MeshConfig(fsdp=8, tensor=2))
        lines = grpo_bytes(shape, step.state, step.batch, step.frozen)
        compiled = compile_grpo(step, shape, score, OPTIMIZER)
        found[layers] = {"counted": sum(lines[name] for name in ARGUMENTS), "compiled": compiled}
    print(json.dumps(found))  # noqa: T201


if __name__ == "__main__":
    main()
