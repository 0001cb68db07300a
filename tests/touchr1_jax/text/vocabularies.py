"""Languages, vocabularies and token sequences that make parsing hard."""

import random

import hypothesis.strategies as st
import tokenizers
from tokenizers import AddedToken, decoders, models, pre_tokenizers, trainers

from touchr1_jax.text.language import TOUCH_LANGUAGE, Attribute, Language, Sensor
from touchr1_jax.text.tokenizer import Tokenizer, from_tokenizers, word_level

TRICKY = Language(
    attributes=(
        Attribute(
            name="hardness",
            levels=(
                ("soft", "a b c d", "x-y"),
                ("firm", "hard", "b c", "compare"),
                ("very hard", "harder", "not so hard"),
            ),
        ),
        Attribute(name="roughness", levels=(("soft", "c", "0_"), ("rough", "very", "d-d"))),
        Attribute(name="material", levels=(("one",), ("two",), ("b c d e",), ("perceive b",)), ordinal=False),
    ),
    sensors=(
        Sensor(name="g", phrases=("g", "g s", "not")),
        Sensor(name="x", phrases=("xx", "a-b c", "so hard")),
        Sensor(name="q", phrases=("very hard x", "c d")),
    ),
)
"""Phrases that begin, end, contain and overlap one another, shared between attributes, sensors and tags."""

LANGUAGES = {"touch": TOUCH_LANGUAGE, "tricky": TRICKY}
SPECIALS = {"pad": "<|endoftext|>", "end": "<|im_end|>", "tactile": "<|video_pad|>", "view": "<|image_pad|>"}
NOISE = (
    "",
    " ",
    "  ",
    "\n",
    "\t",
    "\x1c",
    "-",
    ".",
    ",",
    "<",
    "</",
    ">",
    "</per",
    "é",
    "…",
    "—",
    "，",
    "\u00a0",
    "𝒳",
    "🖐",
    "\u0301",
    "ſ",
    "K",
    "x",
    "A",
    "_",
    "not",
    "ER",
)


def tags(language: Language) -> list[str]:
    return [f"<{slash}{name}>" for name in language.tags for slash in ("", "/")]


def sensor_phrases(language: Language) -> list[str]:
    return [p for sensor in language.sensors for p in sensor.phrases]


def level_phrases(language: Language) -> list[str]:
    return [p for attribute in language.attributes for level in attribute.levels for p in level]


def phrases(language: Language) -> list[str]:
    return sensor_phrases(language) + level_phrases(language)


def character_level() -> Tokenizer:
    """One id per UTF-8 byte, which for ASCII is one per character: id 4 + b writes byte b, ids 0 to 3 are special."""
    pieces = (b"", b"", b"", b"", *(bytes([b]) for b in range(256)))

    def encode(text: str) -> list[int]:
        return [4 + b for b in text.encode()]

    return Tokenizer(pieces=pieces, pad_id=0, end_ids=(1,), tactile_id=2, view_id=3, encoder=encode)


def trained_bpe(language: Language, merges: int = 150) -> tokenizers.Tokenizer:
    """A byte-level BPE in the layout of Qwen2.5, trained on random answers."""
    rng = random.Random(0)
    words = [*tags(language), *phrases(language)]
    corpus = [" ".join(rng.choices(words, k=20)) for _ in range(200)]
    library = tokenizers.Tokenizer(models.BPE())
    library.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    library.decoder = decoders.ByteLevel()
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    trainer = trainers.BpeTrainer(vocab_size=256 + merges, initial_alphabet=alphabet, show_progress=False)
    library.train_from_iterator(corpus, trainer)
    library.add_special_tokens(list(SPECIALS.values()))
    library.add_tokens([AddedToken("<tool_call>", special=False), AddedToken("two words é", special=False)])
    return library


def straddling(language: Language, seed: int = 1, size: int = 250) -> Tokenizer:
    """Tokens cut out of random text anywhere: ends of one tag with the start of the next, halves of letters."""
    rng = random.Random(seed)
    atoms = [*tags(language) * 2, *phrases(language) * 2, *NOISE]
    pieces = [b"", b"", b"", b""]
    for _ in range(size):
        text = "".join(rng.choice(atoms) + rng.choice(["", " "]) for _ in range(rng.choice([1, 2, 2, 3, 4]))).encode()
        i = rng.randrange(len(text) + 1)
        pieces.append(text[i:] if rng.random() < 0.3 else text[:i] if rng.random() < 0.3 else text)
    pieces += [bytes([b]) for b in range(256)]
    return Tokenizer(
        pieces=tuple(pieces), pad_id=0, end_ids=(1,), tactile_id=2, view_id=3, encoder=lambda text: spell(pieces, text)
    )


def make_tokenizer(kind: str, language: Language) -> Tokenizer:
    made = {
        "word": lambda: word_level(language),
        "character": character_level,
        "bpe": lambda: from_tokenizers(trained_bpe(language)),
        "straddling": lambda: straddling(language),
    }
    return made[kind]()


def spell(pieces: list[bytes] | tuple[bytes, ...], text: str, seed: int = 0) -> list[int]:
    """Write a text with randomly chosen tokens; bytes that no token can write are left out."""
    rng = random.Random(seed)
    by_first: dict[int, list[int]] = {}
    for i, piece in enumerate(pieces):
        if piece:
            by_first.setdefault(piece[0], []).append(i)
    data, at, ids = text.encode(), 0, []
    while at < len(data):
        fits = [i for i in by_first.get(data[at], []) if data.startswith(pieces[i], at)]
        if fits:
            ids.append(rng.choice(fits))
        at += len(pieces[ids[-1]]) if fits else 1
    return ids


@st.composite
def answers(draw: st.DrawFn, language: Language) -> str:
    """Well-formed answers with a few things inserted, deleted or moved."""
    noise = st.sampled_from(NOISE)
    gap = st.sampled_from((" ", " ", " ", "  ", " \n", "-", "")) if draw(st.booleans()) else st.just(" ")
    tail = st.one_of(st.just(""), st.just(""), noise) if draw(st.booleans()) else st.just("")
    level = st.builds("{}{}{}".format, gap, st.sampled_from(level_phrases(language)), tail)
    sensor = st.builds("{}{}".format, gap, st.sampled_from(sensor_phrases(language)))
    report = st.builds(str.__add__, sensor, level)
    parts: list[str] = []
    for i, tag in enumerate(tags(language)):
        parts.append(tag if i == 0 else f" {tag}")
        if i % 2 == 0:
            body = st.one_of(report, report, report, level) if i == 0 else level
            parts += draw(st.lists(body, min_size=1, max_size=4 if i == 0 else 2))
    anything = st.one_of(noise, level, report, st.sampled_from(tags(language)))
    edits = st.tuples(st.integers(0, 30), st.one_of(st.none(), anything, st.just("SHOUT")))
    for place, edit in draw(st.lists(edits, max_size=3)):
        place %= len(parts)
        if edit is None:
            parts.append(parts.pop(place))
        elif edit == "SHOUT":
            parts[place] = parts[place].upper()
        else:
            parts.insert(place, edit)
    return "".join(parts)


@st.composite
def token_sequences(draw: st.DrawFn, language: Language, tokenizer: Tokenizer, length: int) -> list[int]:
    """T token ids: an answer spelled at random, or plain noise; ended, followed by anything, or cut off."""
    any_id = st.integers(0, tokenizer.vocab_size - 1)
    if draw(st.integers(0, 9)) == 0:
        ids = draw(st.lists(any_id, min_size=length, max_size=length))
    else:
        ids = spell(tokenizer.pieces, draw(answers(language)), draw(st.integers(0, 2**16)))
        ids += draw(st.sampled_from([[tokenizer.end_ids[0]], [tokenizer.end_ids[0]], []]))
        filler = draw(st.one_of(st.just(tokenizer.pad_id), any_id))
        ids += [filler] * (length - len(ids))
    return ids[:length]
