"""Shapes of the decoder: those of Qwen2.5's kind, and of Qwen3's."""

import dataclasses
from typing import ClassVar

from touchr1_jax.models.layers import SizeError, check_layers, check_sizes
from touchr1_jax.validation import above


@dataclasses.dataclass(frozen=True, kw_only=True)
class DecoderConfig:
    """Shape of the decoder; the defaults are the CPU-scale policy, the names are Qwen2.5's."""

    qkv_bias: ClassVar[bool] = True
    """Queries, keys and values have a bias."""
    qk_norm: ClassVar[bool] = False
    """Queries and keys are normalised, head by head, before they are turned."""
    interleaved: ClassVar[bool] = False
    """Time, row and column take turns among the rotary frequencies, see `layers.mrope`."""

    vocab_size: int
    hidden_size: int = 96
    num_layers: int = 2
    num_heads: int = 3
    num_kv_heads: int = 1
    head_dim: int = 32
    intermediate_size: int = 192
    mrope_section: tuple[int, int, int] = (4, 6, 6)
    rope_theta: float = 1e4
    norm_epsilon: float = 1e-6
    tie_embedding: bool = True

    def __post_init__(self) -> None:
        check_sizes(self, "hidden_size", "num_heads", "num_kv_heads", "head_dim", "intermediate_size")
        check_layers(self, least=1)
        if self.num_heads % self.num_kv_heads:
            raise SizeError(
                f"num_heads is {self.num_heads}: must be a multiple of num_kv_heads {self.num_kv_heads}; change either"
            )
        above(self, 0, "rope_theta", "norm_epsilon")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Qwen3DecoderConfig(DecoderConfig):
    """Shape of Qwen3's decoder (arXiv 2505.09388, §2), with the rotary positions of Qwen3-VL."""

    qkv_bias: ClassVar[bool] = False
    qk_norm: ClassVar[bool] = True
    interleaved: ClassVar[bool] = True
