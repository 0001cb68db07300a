"""Vocabularies as bytes: the bytes that each id adds to the decoded text, and the encoding of text."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import SupportsIndex

import numpy as np
import tokenizers
from tokenizers import decoders, models, pre_tokenizers

from touchr1_jax.text.language import Language

PAD, END, TACTILE, VIEW = "<pad>", "<end>", "<tactile>", "<view>"
"""Special tokens of the tokenizers made here; each adds nothing to the text."""

MOST_IDS = 1 << 24
"""A hundred times the largest vocabulary; an id of 2³² in a damaged file would ask for 34 GB."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Tokenizer:
    """A vocabulary: decode(ids) = utf8(pieces[ids[0]] + pieces[ids[1]] + …), undecodable bytes replaced.

    Args:
      pieces: [V] the bytes that each id adds to the text; special tokens and unused ids add none.
      pad_id: fills up; never sampled.
      end_ids: any of them ends a completion.
      tactile_id: stands in the prompt where a tactile embedding goes; never sampled.
      view_id: stands in the prompt where an embedding of the RGB view goes; never sampled.
      encoder: text → ids, without special tokens.

    Raises:
      ValueError: a special id outside the vocabulary, with text of its own, or with two meanings.
    """

    pieces: tuple[bytes, ...]
    pad_id: int
    end_ids: tuple[int, ...]
    tactile_id: int
    view_id: int
    encoder: Callable[[str], list[int]]

    def __post_init__(self) -> None:
        if not self.end_ids:
            raise ValueError("end_ids is empty: a completion needs a token that ends it; name at least one")
        named = {"pad_id": self.pad_id, "tactile_id": self.tactile_id, "view_id": self.view_id}
        named |= {f"end_ids[{i}]": end for i, end in enumerate(self.end_ids)}
        owner: dict[int, str] = {}
        for field, token in named.items():
            if not 0 <= token < len(self.pieces):
                raise ValueError(f"{field} is {token}: must lie in 0..{len(self.pieces) - 1}; correct the id")
            if self.pieces[token]:
                raise ValueError(
                    f"{field} is {token}, which writes {self.pieces[token]!r}: must add no text; choose a special token"
                )
            if owner.setdefault(token, field) != field:
                raise ValueError(f"{field} and {owner[token]} are both {token}: give each its own token")

    @property
    def vocab_size(self) -> int:
        """V, the number of ids."""
        return len(self.pieces)

    @property
    def banned(self) -> np.ndarray:
        """Ids never to be sampled, bool [V]: those that neither write nor end (padding, placeholders, unused rows)."""
        return np.array([not piece and i not in self.end_ids for i, piece in enumerate(self.pieces)])

    def encode(self, text: str) -> list[int]:
        """Ids of a text, without special tokens."""
        return self.encoder(text)

    def decode(self, ids: Iterable[SupportsIndex]) -> str:
        """The text of ids; special tokens add nothing."""
        return b"".join(self.pieces[i] for i in ids).decode("utf-8", errors="replace")


def word_level(language: Language, extra_words: Iterable[str] = ()) -> Tokenizer:
    """A tokenizer with one id per blank-separated word: tags, sensor names, level words, then `extra_words`.

    Each piece starts with a blank, so that pieces put together are spaced text; the first tag, which starts an answer,
    has none.  `encode` raises ValueError on a word that is not in the vocabulary.
    """
    tags = [tag for name in language.tags for tag in (f"<{name}>", f"</{name}>")]
    phrases = [p for sensor in language.sensors for p in sensor.phrases]
    phrases += [p for attribute in language.attributes for level in attribute.levels for p in level]
    return word_tokenizer([*tags, *phrases, *extra_words])


def word_tokenizer(phrases: Iterable[str]) -> Tokenizer:
    """A tokenizer with one id for each blank-separated word of some phrases; the first word has no blank before it."""
    words = list(dict.fromkeys(" ".join(phrases).split()))
    library, specials = word_library(words), [PAD, END, TACTILE, VIEW]
    vocabulary = library.get_vocab()

    def encode(text: str) -> list[int]:
        unknown = [word for word in text.split() if word not in vocabulary or word in specials]
        if unknown:
            raise ValueError(f"words {unknown} of {text!r} are not in the vocabulary; add them to extra_words")
        return library.encode(text).ids

    pieces = [b""] * len(specials) + [(w if w == words[0] else f" {w}").encode() for w in words]
    return Tokenizer(pieces=tuple(pieces), pad_id=0, end_ids=(1,), tactile_id=2, view_id=3, encoder=encode)


def word_library(words: Iterable[str]) -> tokenizers.Tokenizer:
    """The special tokens and then these words, in their order, as a tokenizer of the `tokenizers` library."""
    vocabulary = {word: i for i, word in enumerate([PAD, END, TACTILE, VIEW, *words])}
    library = tokenizers.Tokenizer(models.WordLevel(vocabulary, unk_token=PAD))
    library.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    return library


def from_tokenizers(
    library: tokenizers.Tokenizer,
    *,
    pad: str = "<|endoftext|>",
    ends: Sequence[str] = ("<|im_end|>",),
    tactile: str = "<|video_pad|>",
    view: str = "<|image_pad|>",
    vocab_size: int | None = None,
) -> Tokenizer:
    """A byte-level BPE of the `tokenizers` library as bytes; the defaults name the special tokens of Qwen2.5-VL.

    Args:
      library: a tokenizer with a byte-level decoder.
      pad, ends, tactile, view: special tokens in the roles of `Tokenizer`.
      vocab_size: rows of the model's embedding where it has more than the tokenizer (Qwen pads its tables).

    Raises:
      ValueError: no byte-level decoder, a special token that is not in the vocabulary, or too small a `vocab_size`.
    """
    if not isinstance(library.decoder, decoders.ByteLevel):
        raise ValueError(f"the tokenizer decodes with {library.decoder}: must be ByteLevel; use a byte-level BPE")
    tokens = library.get_vocab(with_added_tokens=True)
    size = max(tokens.values()) + 1 if vocab_size is None else vocab_size
    if not max(tokens.values()) < size <= MOST_IDS:
        need = f"must exceed the largest id, {max(tokens.values())}, and be ≤ {MOST_IDS}"
        raise ValueError(f"vocab_size is {size}: {need}; use the model's")
    alphabet = _byte_alphabet()
    special = {i for i, token in library.get_added_tokens_decoder().items() if token.special}
    pieces = [b""] * size
    for token, i in tokens.items():
        pieces[i] = b"" if i in special else _to_bytes(token, alphabet)

    def find(role: str, token: str) -> int:
        if token not in tokens:
            raise ValueError(f"{role} is {token!r}, which is not in the vocabulary; name one of its special tokens")
        return tokens[token]

    return Tokenizer(
        pieces=tuple(pieces),
        pad_id=find("pad", pad),
        end_ids=tuple(find("ends", end) for end in ends),
        tactile_id=find("tactile", tactile),
        view_id=find("view", view),
        encoder=lambda text: library.encode(text, add_special_tokens=False).ids,
    )


def from_file(path: str | Path, *, vocab_size: int | None = None) -> Tokenizer:
    """The tokenizer of a Qwen2.5-VL checkpoint, from its `tokenizer.json`.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: no tokenizer in it, or as `from_tokenizers`.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path} is no file: must be the tokenizer.json of a checkpoint; correct the path")
    try:
        library = tokenizers.Tokenizer.from_file(str(path))
    except BaseException as error:  # the library raises nothing more particular; its panics are no `Exception`
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise ValueError(f"{path} is no tokenizer ({error}): must be that of a checkpoint; fetch it again") from error
    return from_tokenizers(library, vocab_size=vocab_size)


def _byte_alphabet() -> dict[str, int]:
    """Printable stand-in → byte, as GPT-2's `bytes_to_unicode`: printable bytes for themselves, others from U+0100."""
    printable = [*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)]
    others = [b for b in range(256) if b not in printable]
    return {chr(b): b for b in printable} | {chr(256 + i): b for i, b in enumerate(others)}


def _to_bytes(token: str, alphabet: dict[str, int]) -> bytes:
    """A token's bytes; one with a character outside the alphabet (only added tokens) stands for itself."""
    if all(c in alphabet for c in token):
        return bytes(alphabet[c] for c in token)
    return token.encode()
