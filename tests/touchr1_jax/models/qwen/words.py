"""A small `tokenizer.json` in the layout of Qwen2.5-VL: byte-level BPE, special tokens of the chat template."""

from pathlib import Path

import tokenizers

from tests.touchr1_jax.text.vocabularies import trained_bpe
from touchr1_jax.text.chat import MARKS
from touchr1_jax.text.language import Language
from touchr1_jax.text.tokenizer import Tokenizer, from_tokenizers


def library(language: Language) -> tokenizers.Tokenizer:
    """Trained on answers, then given the marks that it lacks."""
    made = trained_bpe(language)
    made.add_special_tokens([mark for mark in MARKS if made.token_to_id(mark) is None])
    return made


def tokenizer(language: Language, vocab_size: int | None = None) -> Tokenizer:
    return from_tokenizers(library(language), vocab_size=vocab_size)


def write(path: Path, language: Language) -> dict[str, int]:
    """Write the file and say the ids of its marks."""
    made = library(language)
    made.save(str(path))
    return {mark: made.token_to_id(mark) for mark in MARKS}
