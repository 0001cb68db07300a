"""A tiny checkpoint in the released format with drawn weights, to try the code where there are no released ones.

`chat_template.jinja` is that of Qwen/Qwen2.5-VL-7B-Instruct (Alibaba Cloud, Apache License 2.0), unchanged.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tokenizers
from tokenizers import decoders, models, pre_tokenizers, trainers

from experiments.paper.released_policy import plain_answers
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.load import TOKENIZER_FILE
from touchr1_jax.models.qwen.config import CONFIG_FILE, QwenConfig, QwenVisionConfig
from touchr1_jax.models.qwen.model import init_params
from touchr1_jax.models.qwen.pictures import PREPROCESSOR_FILE
from touchr1_jax.models.qwen.weights import SINGLE, save_params
from touchr1_jax.text.chat import MARKS, SYSTEM
from touchr1_jax.text.language import Language
from touchr1_jax.text.template import QUESTIONS

TEMPLATE = Path(__file__).parent / "chat_template.jinja"

VOCABULARY = 640
"""Words of the tokenizer; the table has more rows, as Qwen's has."""

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


def write_tiny(
    directory: Path, language: Language, system: str = SYSTEM, seed: int = 0, decoder: DecoderConfig = SMALLEST
) -> None:
    """Write config, tokenizer, template, picture settings and weights in bfloat16.

    Args:
      directory: made if need be.
      language: the tokenizer is trained on its answers, so that they are short.
      system: text that the tokenizer is trained on too.
      seed: of the weights.
      decoder: shape of the decoder; its vocabulary is `ROWS`.
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
    }
    (directory / PREPROCESSOR_FILE).write_text(json.dumps(pictures), encoding="utf-8")
    shutil.copy(TEMPLATE, directory)
    params = jax.jit(lambda key: init_params(config, key))(jax.random.key(seed))
    save_params(directory / SINGLE, jax.tree.map(lambda x: x.astype(jnp.bfloat16), params), config)


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
    """A decoder with the smallest vision tower beside it; the ids are the tokenizer's."""
    ids = library.get_vocab(with_added_tokens=True)
    return QwenConfig(
        decoder=decoder,
        vision=QwenVisionConfig(
            out_size=decoder.hidden_size,
            depth=1,
            hidden_size=32,
            num_heads=2,
            intermediate_size=44,
            patch_px=8,
            window_px=32,
            full_layers=(0,),
        ),
        vision_start_id=ids["<|vision_start|>"],
        vision_end_id=ids["<|vision_end|>"],
        image_id=ids["<|image_pad|>"],
        video_id=ids["<|video_pad|>"],
    )


def published_config(config: QwenConfig) -> dict[str, Any]:
    """The contents of a `config.json` that `parse_config` reads as this."""
    d, v = config.decoder, config.vision
    return {
        "architectures": ["Qwen2_5_VLForConditionalGeneration"],
        "model_type": "qwen2_5_vl",
        "torch_dtype": "bfloat16",
        "hidden_act": "silu",
        "hidden_size": d.hidden_size,
        "intermediate_size": d.intermediate_size,
        "num_hidden_layers": d.num_layers,
        "num_attention_heads": d.num_heads,
        "num_key_value_heads": d.num_kv_heads,
        "rms_norm_eps": d.norm_epsilon,
        "rope_theta": d.rope_theta,
        "rope_scaling": {"type": "mrope", "mrope_section": list(d.mrope_section)},
        "tie_word_embeddings": d.tie_embedding,
        "use_sliding_window": False,
        "vocab_size": d.vocab_size,
        "vision_start_token_id": config.vision_start_id,
        "vision_end_token_id": config.vision_end_id,
        "image_token_id": config.image_id,
        "video_token_id": config.video_id,
        "vision_config": {
            "depth": v.depth,
            "hidden_act": "silu",
            "hidden_size": v.hidden_size,
            "intermediate_size": v.intermediate_size,
            "num_heads": v.num_heads,
            "in_chans": 3,
            "out_hidden_size": v.out_size,
            "patch_size": v.patch_px,
            "spatial_merge_size": v.merge,
            "temporal_patch_size": v.patch_frames,
            "window_size": v.window_px,
            "fullatt_block_indexes": list(v.full_layers),
            "tokens_per_second": v.tokens_per_second,
        },
    }
