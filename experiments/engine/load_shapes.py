"""Shapes of checkpoints to read: the released ones, and smaller ones of the same family."""

import dataclasses
from collections.abc import Mapping

from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.qwen.config import RELEASED, QwenConfig, QwenVisionConfig, released


def behind_the_tower(decoder: DecoderConfig) -> QwenConfig:
    """A decoder behind the released vision tower."""
    return QwenConfig(decoder=decoder, vision=QwenVisionConfig(out_size=decoder.hidden_size))


SHAPES: Mapping[str, QwenConfig] = {
    "tiny": QwenConfig(
        decoder=DecoderConfig(vocab_size=512, hidden_size=64, num_heads=2, intermediate_size=96, tie_embedding=False),
        vision=QwenVisionConfig(
            out_size=64, depth=2, hidden_size=32, num_heads=2, intermediate_size=48, full_layers=(1,)
        ),
        vision_start_id=0,
        vision_end_id=1,
        image_id=2,
        video_id=3,
    ),
    "0.5B": behind_the_tower(
        dataclasses.replace(
            RELEASED["3B"],
            hidden_size=896,
            num_layers=24,
            num_heads=14,
            head_dim=64,
            intermediate_size=4864,
            mrope_section=(8, 12, 12),
        )
    ),
    "1.5B": behind_the_tower(
        dataclasses.replace(RELEASED["3B"], hidden_size=1536, num_layers=28, num_heads=12, intermediate_size=8960)
    ),
    "3B": released("3B"),
    "7B": released("7B"),
}
"""By the size of the decoder; 0.5B and 1.5B are those of Qwen2.5 behind the tower of Qwen2.5-VL."""
