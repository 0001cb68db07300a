"""Sizes of what is timed on an accelerator."""

import dataclasses

from experiments.engine.attention import Flash
from experiments.engine.peers import JobSize
from touchr1_jax.models.qwen.config import QwenVisionConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class GpuConfig:
    """Sizes; the defaults are the 7B's attention and vision tower, and a policy of the 1.5B's shape.

    Raises:
      ValueError: pictures that are no whole windows, frames that do not fill time steps, too few rounds.
    """

    anywhere: bool = False
    """Run without a GPU too, to try the code: the figures then say nothing about one."""
    rounds: int = 5
    """Timings of each piece, after two that are not timed."""
    side: int = 8192
    """Of the matrices of the plain product."""
    prompts: int = 4
    """Prompts whose attention is timed."""
    tokens: int = 4480
    """Of each: four streams of 1,024, a view of 256, 128 of text."""
    heads: int = 28
    kv_heads: int = 4
    head_dim: int = 128
    flash: Flash = "cudnn"
    streams: int = 4
    frames: int = 8
    """Of each stream."""
    contacts: int = 16
    """That the tactile encoder reads at once; the vision tower reads one."""
    tactile: TactileViTConfig = TactileViTConfig(sensors=0, width=768, num_layers=12, num_heads=12, mlp_ratio=4)
    tactile_px: int = 112
    vision: QwenVisionConfig = QwenVisionConfig(out_size=3584)
    vision_px: int = 448
    size: JobSize = JobSize(
        prompts=8,
        group=8,
        length=256,
        vocab_size=151_936,
        hidden_size=1536,
        num_layers=28,
        num_heads=12,
        num_kv_heads=2,
        head_dim=128,
        intermediate_size=8960,
    )
    """Of the policy, and its prompts, rollouts and tokens."""
    prefix: int = 1024
    """Prompt tokens of the policy."""
    micro_prompts: int = 1

    def __post_init__(self) -> None:
        cell = self.vision.cell_px
        if self.vision_px % cell:
            raise ValueError(f"vision_px is {self.vision_px}: must be a multiple of {cell}, a token's pixels; round it")
        if self.frames % self.vision.patch_frames:
            raise ValueError(
                f"frames is {self.frames}: must be a multiple of {self.vision.patch_frames}, the frames of a patch"
            )
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}: must be at least 1; raise it")
