"""A policy on a tiny Qwen2.5-VL: two sensors, one decoder layer, prompts in the chat template."""

import functools

import jax
import jax.numpy as jnp

from tests.touchr1_jax import tiny
from tests.touchr1_jax.drawn import draw_params
from tests.touchr1_jax.models.qwen import words
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.policy import Slots, init_policy
from touchr1_jax.models.qwen.config import QwenConfig, QwenVisionConfig
from touchr1_jax.models.qwen.pictures import PixelBudget
from touchr1_jax.models.qwen.policy import qwen_fns, qwen_policy
from touchr1_jax.text.chat import build_chat_layout
from touchr1_jax.types import Params

TOKENIZER = words.tokenizer(tiny.LANGUAGE, vocab_size=448)
MARKS = [TOKENIZER.encode(mark)[0] for mark in ("<|vision_start|>", "<|vision_end|>")]
CONFIG = QwenConfig(
    decoder=DecoderConfig(
        vocab_size=TOKENIZER.vocab_size,
        hidden_size=24,
        num_layers=1,
        num_heads=4,
        num_kv_heads=2,
        head_dim=6,
        intermediate_size=32,
        mrope_section=(1, 1, 1),
        rope_theta=1e6,
    ),
    vision=QwenVisionConfig(
        out_size=24,
        depth=2,
        hidden_size=16,
        num_heads=2,
        intermediate_size=20,
        patch_px=4,
        window_px=8,
        full_layers=(1,),
    ),
    vision_start_id=MARKS[0],
    vision_end_id=MARKS[1],
    image_id=TOKENIZER.view_id,
    video_id=TOKENIZER.tactile_id,
)
POLICY = qwen_policy(CONFIG, tiny.CONFIG.tactile, view_px=(16, 16), budget=PixelBudget(least=64, most=1024))
VIEW_TOKENS = POLICY.config.vision.tokens
LAYOUT = build_chat_layout(TOKENIZER, tiny.LANGUAGE, tactile_tokens=tiny.N, view_tokens=VIEW_TOKENS)
SLOTS = Slots(LAYOUT.touch, LAYOUT.view, LAYOUT.stream_text)
FNS = qwen_fns(POLICY, LAYOUT, TOKENIZER, jnp.float32)


@functools.cache
def params() -> Params:
    """Loud, so that nothing is uniform."""
    shapes = jax.eval_shape(
        lambda k: init_policy(POLICY, k, tiny.touch_batch(), LAYOUT.ids[0], LAYOUT.mask[0], SLOTS), jax.random.key(0)
    )
    return draw_params(shapes, loud=0.3)
