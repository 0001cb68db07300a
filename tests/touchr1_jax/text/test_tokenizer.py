import json
import random
from unittest.mock import Mock

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import tokenizers
from tokenizers import models

from tests.touchr1_jax.text.vocabularies import SPECIALS, character_level, phrases, tags, trained_bpe
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.template import prompt_words
from touchr1_jax.text.tokenizer import Tokenizer, from_file, from_tokenizers, word_level

ANSWER = "<perceive> xense soft dm-tac x firm </perceive> <compare> firm </compare> <conclude> hard </conclude>"
LIBRARY = trained_bpe(TOUCH_LANGUAGE)
BPE = from_tokenizers(LIBRARY)
WORD = word_level(TOUCH_LANGUAGE, prompt_words())


def make(**changes) -> Tokenizer:
    fields = {"pieces": (b"", b"", b"", b"", b"a"), "pad_id": 0, "end_ids": (1,), "tactile_id": 2, "view_id": 3}
    return Tokenizer(**(fields | changes), encoder=lambda text: [])


@pytest.mark.parametrize("tokenizer", [WORD, character_level(), BPE], ids=["word", "character", "bpe"])
def test_decode_undoes_encode(tokenizer):
    assert tokenizer.decode(tokenizer.encode(ANSWER)) == ANSWER
    assert tokenizer.decode([tokenizer.pad_id, *tokenizer.end_ids, tokenizer.tactile_id, tokenizer.view_id]) == ""


def test_each_word_is_one_token():
    names = [*tags(TOUCH_LANGUAGE), *phrases(TOUCH_LANGUAGE), *prompt_words()]
    for word in " ".join(names).split():
        (token,) = WORD.encode(word)
        assert WORD.decode([token]).lstrip(" ") == word
    assert WORD.pieces[WORD.encode("<perceive>")[0]] == b"<perceive>"
    assert WORD.pieces[WORD.encode("soft")[0]] == b" soft"
    assert WORD.vocab_size < 64


def test_only_writing_and_ending_tokens_are_sampled():
    assert np.flatnonzero(WORD.banned).tolist() == [WORD.pad_id, WORD.tactile_id, WORD.view_id]
    assert WORD.banned.shape == (WORD.vocab_size,)
    padded = from_tokenizers(LIBRARY, vocab_size=BPE.vocab_size + 5)
    allowed = np.flatnonzero(~padded.banned)
    assert LIBRARY.token_to_id(SPECIALS["end"]) in allowed
    assert not {LIBRARY.token_to_id(SPECIALS[s]) for s in ("pad", "tactile", "view")} & set(allowed.tolist())
    assert allowed.max() < BPE.vocab_size


def test_bpe_decodes_like_its_library():
    rng = random.Random(0)
    specials = {LIBRARY.token_to_id(s) for s in SPECIALS.values()}
    for _ in range(500):
        ids = rng.choices(range(BPE.vocab_size), k=rng.randrange(30))
        assert BPE.decode(ids) == LIBRARY.decode([i for i in ids if i not in specials])
    for added in ("<tool_call>", "two words é"):
        assert BPE.decode([LIBRARY.token_to_id(added)]) == added


@hypothesis.given(st.text())
def test_bpe_encodes_like_its_library(text):
    assert BPE.encode(text) == LIBRARY.encode(text).ids


def test_file_gives_the_same_tokenizer(tmp_path):
    LIBRARY.save(str(tmp_path / "tokenizer.json"))
    loaded = from_file(tmp_path / "tokenizer.json", vocab_size=BPE.vocab_size + 7)
    assert loaded.pieces == BPE.pieces + (b"",) * 7
    assert (loaded.pad_id, loaded.end_ids, loaded.tactile_id) == (BPE.pad_id, BPE.end_ids, BPE.tactile_id)
    assert loaded.encode(ANSWER) == BPE.encode(ANSWER)


def test_errors_of_files_and_libraries(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.json is no file: must be the tokenizer\.json"):
        from_file(tmp_path / "nowhere.json")
    with pytest.raises(ValueError, match=r"decodes with None: must be ByteLevel"):
        from_tokenizers(tokenizers.Tokenizer(models.WordLevel({"a": 0})))
    with pytest.raises(ValueError, match=r"ends is '<eos>', which is not in the vocabulary"):
        from_tokenizers(LIBRARY, ends=("<eos>",))
    with pytest.raises(ValueError, match=rf"vocab_size is 7: must exceed the largest id, {BPE.vocab_size - 1}"):
        from_tokenizers(LIBRARY, vocab_size=7)


@pytest.mark.parametrize(
    ("part", "damage", "message"),
    [
        ("normalizer", {"type": "Precompiled", "precompiled_charsmap": "AAAA"}, "is no tokenizer .*charsmap"),
        ("model", {"type": "BPE", "vocab": {"a": 2**32 - 1}, "merges": []}, "and be ≤ 16777216"),
    ],
)
def test_a_damaged_file_neither_panics_nor_asks_for_all_memory(tmp_path, part, damage, message):
    tree = json.loads(LIBRARY.to_str())
    (tmp_path / "tokenizer.json").write_text(json.dumps({**tree, part: damage}))
    with pytest.raises(ValueError, match=message):
        from_file(tmp_path / "tokenizer.json")


def test_a_signal_while_a_file_is_read_stays_a_signal(tmp_path, monkeypatch):
    stopped = type("Stopped", (BaseException,), {})
    (tmp_path / "tokenizer.json").write_text("{}")
    monkeypatch.setattr(tokenizers, "Tokenizer", Mock(from_file=Mock(side_effect=stopped)))
    with pytest.raises(stopped):
        from_file(tmp_path / "tokenizer.json")


@pytest.mark.parametrize("text", ["how squishy", "<pad>", "soft,"])
def test_unknown_words_are_named(text):
    with pytest.raises(ValueError, match=r"are not in the vocabulary; add them to extra_words"):
        WORD.encode(text)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"end_ids": ()}, "end_ids is empty"),
        ({"pad_id": 5}, r"pad_id is 5: must lie in 0\.\.4"),
        ({"view_id": 4}, r"view_id is 4, which writes b'a': must add no text"),
        ({"pad_id": 1}, r"end_ids\[0\] and pad_id are both 1"),
    ],
)
def test_special_ids_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        make(**changes)
