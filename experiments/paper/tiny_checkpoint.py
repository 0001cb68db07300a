"""A tiny checkpoint in the released format, to try the code without released weights, and how it learns to answer.

Its weights are random.  A released model knows language but not touch; so `teach` trains all weights of the decoder
to write answers, by the SFT step of the policies.  Prompts name sensors and contain neither touch nor picture, and the
levels of answers are random: the decoder can learn the form of answers, but not the right level.

`chat_template.jinja` is that of Qwen/Qwen2.5-VL-7B-Instruct, `chat_template_qwen3.jinja` that of
Qwen/Qwen3-VL-4B-Instruct (Alibaba Cloud, Apache License 2.0), both unchanged.
"""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tokenizers
from tokenizers import decoders, models, pre_tokenizers, trainers

from experiments.core.context import Context
from sensors_io.schema import SENSORS
from touchr1_jax.models.decoder_config import DecoderConfig, Qwen3DecoderConfig
from touchr1_jax.models.load import TOKENIZER_FILE, load_checkpoint
from touchr1_jax.models.qwen.config import CONFIG_FILE, AnyVision, Qwen3VisionConfig, QwenConfig, QwenVisionConfig
from touchr1_jax.models.qwen.model import init_params
from touchr1_jax.models.qwen.pictures import PREPROCESSOR_FILE
from touchr1_jax.models.qwen.weights import save_params
from touchr1_jax.models.released_policy import ReleasedModel, ReleasedPolicy, build_released_policy, plain_answers
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import touch_shapes
from touchr1_jax.text.chat import MARKS, SYSTEM
from touchr1_jax.text.language import Language
from touchr1_jax.text.template import QUESTIONS, answer_text, encode_answer
from touchr1_jax.training.feeds import random_streams
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step
from touchr1_jax.types import TouchBatch

TEMPLATE = Path(__file__).parent / "chat_template.jinja"
TEMPLATE_QWEN3 = Path(__file__).parent / "chat_template_qwen3.jinja"

VOCABULARY = 640  # words of the tokenizer; the table has more rows, as Qwen's has

ROWS = 704

SMALLEST = DecoderConfig(
    vocab_size=ROWS,
    hidden_size=64,
    num_layers=1,
    num_heads=4,
    num_kv_heads=2,
    head_dim=16,
    intermediate_size=96,
    mrope_section=(2, 3, 3),
    rope_theta=1e6,
)
"""0.1 million parameters with a vision tower."""

SMALLEST_QWEN3 = Qwen3DecoderConfig(
    vocab_size=ROWS,
    hidden_size=64,
    num_layers=3,
    num_heads=4,
    num_kv_heads=2,
    head_dim=24,
    intermediate_size=96,
    mrope_section=(4, 4, 4),
    rope_theta=5e6,
)
"""The same of Qwen3-VL's kind, with two levels of its vision tower."""


VISION_MARKS = {"vision_start": "vision_start", "vision_end": "vision_end", "image": "image_pad", "video": "video_pad"}
"""Token of `QwenConfig` → its name in the vocabulary."""

DECODER_FIELDS = {
    "hidden_size": "hidden_size",
    "intermediate_size": "intermediate_size",
    "num_layers": "num_hidden_layers",
    "num_heads": "num_attention_heads",
    "num_kv_heads": "num_key_value_heads",
    "head_dim": "head_dim",
    "norm_epsilon": "rms_norm_eps",
    "rope_theta": "rope_theta",
    "tie_embedding": "tie_word_embeddings",
    "vocab_size": "vocab_size",
}
VISION_FIELDS = {
    "depth": "depth",
    "hidden_size": "hidden_size",
    "intermediate_size": "intermediate_size",
    "num_heads": "num_heads",
    "out_size": "out_hidden_size",
    "patch_px": "patch_size",
    "merge": "spatial_merge_size",
    "patch_frames": "temporal_patch_size",
    "window_px": "window_size",
    "full_layers": "fullatt_block_indexes",
    "positions": "num_position_embeddings",
    "deepstack_layers": "deepstack_visual_indexes",
}
"""Field of our shapes → its name in a published `config.json`."""


def write_tiny(directory: Path, language: Language, system: str = SYSTEM, decoder: DecoderConfig = SMALLEST) -> None:
    """Write config, tokenizer, template, picture settings and drawn weights in bfloat16.

    The tokenizer is trained on the language's answers and the system's text, so that they are short.
    The decoder's shape says which model it is; its vocabulary is `ROWS`.
    """
    directory.mkdir(parents=True, exist_ok=True)
    library = trained_tokenizer(language, system)
    library.save(str(directory / TOKENIZER_FILE))
    config = tiny_config(library, decoder)
    (directory / CONFIG_FILE).write_text(json.dumps(published_config(config)), encoding="utf-8")
    vision = config.vision
    pictures = {
        "min_pixels": vision.cell_px**2,
        "max_pixels": 64 * vision.cell_px**2,
        "patch_size": vision.patch_px,
        "temporal_patch_size": vision.patch_frames,
        "merge_size": vision.merge,
        "image_mean": vision.pixel_mean,
        "image_std": vision.pixel_std,
    }
    (directory / PREPROCESSOR_FILE).write_text(json.dumps(pictures), encoding="utf-8")
    template = TEMPLATE if isinstance(vision, QwenVisionConfig) else TEMPLATE_QWEN3
    shutil.copy(template, directory / TEMPLATE.name)
    params = jax.jit(lambda key: init_params(config, key))(jax.random.key(0))
    save_params(directory, jax.tree.map(lambda x: x.astype(jnp.bfloat16), params), config)


def trained_tokenizer(language: Language, system: str) -> tokenizers.Tokenizer:
    """A byte-level BPE in the layout of Qwen2.5, trained on answers, questions and the system's text."""
    library = tokenizers.Tokenizer(models.BPE())
    library.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    library.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=VOCABULARY - len(MARKS),
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    library.train_from_iterator([system, *QUESTIONS.values(), *plain_answers(language)], trainer)
    library.add_special_tokens(list(MARKS))
    return library


def tiny_config(library: tokenizers.Tokenizer, decoder: DecoderConfig = SMALLEST) -> QwenConfig:
    """A decoder and the smallest vision tower; the ids are the tokenizer's."""
    ids = library.get_vocab(with_added_tokens=True)
    sizes = {"out_size": decoder.hidden_size, "hidden_size": 32, "num_heads": 2, "intermediate_size": 44, "patch_px": 8}
    vision: AnyVision = QwenVisionConfig(**sizes, depth=1, window_px=32, full_layers=(0,))
    if isinstance(decoder, Qwen3DecoderConfig):
        vision = Qwen3VisionConfig(**sizes, depth=2, positions=16, deepstack_layers=(0, 1))
    marks = {f"{name}_id": ids[f"<|{word}|>"] for name, word in VISION_MARKS.items()}
    return QwenConfig(decoder=decoder, vision=vision, **marks)


def published_config(config: QwenConfig) -> dict[str, Any]:
    """The contents of a `config.json` that `parse_config` reads as `config`."""
    d, v = config.decoder, config.vision
    older = isinstance(v, QwenVisionConfig)
    text = {
        "hidden_act": "silu",
        "rope_scaling": {"type": "mrope" if older else "default", "mrope_section": list(d.mrope_section)},
        **{published: getattr(d, ours) for ours, published in DECODER_FIELDS.items()},
    }
    tower = {published: getattr(v, ours) for ours, published in VISION_FIELDS.items() if hasattr(v, ours)}
    return {
        "architectures": [f"Qwen{'2_5_' if older else '3'}VLForConditionalGeneration"],
        "model_type": v.model_type,
        "torch_dtype": "bfloat16",
        **(text if older else {"text_config": text, "tie_word_embeddings": d.tie_embedding}),
        **{f"{name}_token_id": getattr(config, f"{name}_id") for name in VISION_MARKS},
        "vision_config": {"hidden_act": "silu" if older else "gelu_pytorch_tanh", **tower},
    }


STAGE = "teach"

UNUSED_TOUCH = ReleasedModel(
    tactile=TactileViTConfig(sensors=0, width=8, num_layers=0, num_heads=1, stem_width=1),
    frames=1,
    image_px=28,
    completion_tokens=48,
    view_px=16,
    dtype="float32",
)
"""Smallest encoder of touch and picture: it is shown nothing, learns nothing, and is dropped."""


AGREEMENT = 0.7
"""Probability that a sensor of a drawn answer perceives the answer's level; else it perceives any."""

TEACHING_BATCH = 32
TEACHING_OPTIMIZER = OptimizerConfig(learning_rate=1e-5, lr_scale=300.0)


def teach(directory: Path, steps: int, context: Context, batch_size: int = TEACHING_BATCH) -> None:
    """Train the decoder of a checkpoint on drawn answers, and write its weights back in bfloat16."""
    if not steps:
        return
    found = load_checkpoint(directory, jnp.float32)
    policy = build_released_policy(UNUSED_TOUCH, found, SENSORS)
    shown = empty_touch(batch_size)
    params = policy.init(0, shown)
    optimizer = make_optimizer(TEACHING_OPTIMIZER, steps)
    step = make_sft_step(policy.fns, optimizer)
    state = SFTState(params=params, opt_state=optimizer.init(params), step=jnp.zeros((), jnp.int32))
    with context.timed(STAGE):
        for t in context.each(STAGE, range(steps)):
            state, metrics = step(state, drawn_batch(policy, shown, np.random.default_rng((0, t))))
            context.log(STAGE, t, **jax.device_get(metrics))
    taught = {"vision": state.params["vision"]["tower"], "decoder": state.params["decoder"]}
    save_params(directory, jax.tree.map(lambda x: x.astype(jnp.bfloat16), taught), found.config)


def drawn_batch(policy: ReleasedPolicy, shown: TouchBatch, rng: np.random.Generator) -> SFTBatch:
    """One question with a drawn answer for each contact of a batch without touch."""
    layout, (p, s) = policy.layout, shown.stream_mask.shape
    asked = rng.integers(len(layout.asked), size=p)
    streams = random_streams(np.ones((p, s), bool), 0.5, rng)
    pairs = [_answer(policy, layout.asked[q], present, rng) for q, present in zip(asked, streams, strict=True)]
    tokens, masks = (np.stack(x)[:, None] for x in zip(*pairs, strict=True))
    written: dict[str, Any] = {
        "ids": layout.ids[asked][:, None],
        "mask": layout.mask[asked][:, None],
        "streams": streams[:, None],
        "tokens": tokens,
        "token_mask": masks,
    }
    return SFTBatch(touch=shown, **written)


def _answer(
    policy: ReleasedPolicy, asked: np.ndarray, streams: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """An answer whose sensors mostly agree: it compares to what most of them perceive, and concludes the same."""
    levels = np.array(policy.levels)
    drawn_for, other = rng.integers(levels), rng.integers(levels, size=(len(streams), len(levels)))
    perceive = np.where(rng.random(other.shape) < AGREEMENT, drawn_for, other)
    most = np.array([np.bincount(perceive[streams, a]).argmax() for a in range(len(levels))])
    text = answer_text(policy.language, asked=asked, streams=streams, perceive=perceive, compare=most, conclude=most)
    return encode_answer(policy.tokenizer, text, policy.model.completion_tokens)


def empty_touch(contacts: int) -> TouchBatch:
    """Contacts without recorded frames and without a picture, with the names of all sensors."""
    shapes = touch_shapes(UNUSED_TOUCH, UNUSED_TOUCH.view_px, SENSORS)
    zeros = jax.tree.map(lambda x: np.zeros((contacts, *x.shape[1:]), x.dtype), shapes)
    return dataclasses.replace(zeros, stream_mask=np.ones_like(zeros.stream_mask))
