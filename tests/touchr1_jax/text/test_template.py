import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.text.vocabularies import character_level, trained_bpe
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import QUESTIONS, answer_text, build_layout, encode_answer, prompt_words, question_ids
from touchr1_jax.text.tokenizer import from_tokenizers, word_level

WORD = word_level(TOUCH_LANGUAGE, prompt_words())
TOKENIZERS = {"word": WORD, "character": character_level(), "bpe": from_tokenizers(trained_bpe(TOUCH_LANGUAGE))}
HARDNESS = np.array([True, False, False, False])


def answer(asked=HARDNESS, streams=(1, 1, 1, 1), perceive=(0, 0, 1, 0), compare=0, conclude=0) -> str:
    def full(levels):
        return np.broadcast_to(np.asarray(levels)[..., None], (*np.shape(levels), 4))

    slots = {"perceive": full(perceive), "compare": full(compare), "conclude": full(conclude)}
    return answer_text(TOUCH_LANGUAGE, asked=np.asarray(asked), streams=np.asarray(streams), **slots)


def test_answer_text():
    assert answer() == (
        "<perceive> gelsight_mini soft xense soft tac3d firm dmtac_x soft </perceive> "
        "<compare> soft </compare> <conclude> soft </conclude>"
    )
    assert answer(asked=(1, 0, 0, 1), streams=(0, 1, 0, 0), compare=1) == (
        "<perceive> xense soft plastic </perceive> <compare> firm metal </compare> <conclude> soft plastic </conclude>"
    )
    assert answer(streams=(0, 0, 0, 0)).startswith("<perceive> nothing </perceive>")


@pytest.mark.parametrize("kind", TOKENIZERS)
def test_every_answer_parses_to_its_slots(kind):
    tokenizer, rng = TOKENIZERS[kind], np.random.default_rng(0)
    parser = jax.jit(compile_parser(TOUCH_LANGUAGE, tokenizer))
    sizes = [len(attribute.levels) for attribute in TOUCH_LANGUAGE.attributes]
    for _ in range(60):
        asked, streams = rng.random(4) < 0.5, rng.random(4) < 0.7
        asked[rng.integers(4)] = True
        perceive, compare, conclude = (rng.integers(sizes, size=n) for n in ((4, 4), 4, 4))
        slots = {"perceive": perceive, "compare": compare, "conclude": conclude}
        text = answer_text(TOUCH_LANGUAGE, asked=asked, streams=streams, **slots)
        ids, mask = encode_answer(tokenizer, text, 400)
        parsed = parser(jnp.array(ids))
        assert parsed.formatted
        assert not parsed.truncated
        assert parsed.length == mask.sum() - 1
        np.testing.assert_array_equal(parsed.perceive, np.where(streams[:, None] & asked, perceive, -1))
        np.testing.assert_array_equal(parsed.compare, np.where(asked, compare, -1))
        np.testing.assert_array_equal(parsed.conclude, np.where(asked, conclude, -1))


def test_encoded_answer_is_padded_after_its_end():
    ids, mask = encode_answer(WORD, answer(), 24)
    assert (ids.shape, ids.dtype, mask.dtype) == ((24,), np.int32, bool)
    assert WORD.decode(ids) == answer()
    assert mask.tolist() == [True] * 17 + [False] * 7
    assert ids[16:].tolist() == [WORD.end_ids[0], *[WORD.pad_id] * 7]
    exact, _ = encode_answer(WORD, answer(), 17)
    assert exact.tolist() == ids[:17].tolist()


def test_answer_errors():
    with pytest.raises(ValueError, match=r"length is 16: the answer .* takes 17 tokens with its end"):
        encode_answer(WORD, answer(), 16)
    with pytest.raises(ValueError, match=r"perceive\[tac3d\], hardness: level 3 must lie in 0\.\.2"):
        answer(perceive=(0, 0, 3, 0))
    with pytest.raises(ValueError, match=r"conclude, hardness: level -1 must lie in 0\.\.2; answer only for"):
        answer(conclude=-1)


@pytest.mark.parametrize("kind", TOKENIZERS)
def test_layout(kind):
    tokenizer = TOKENIZERS[kind]
    layout = build_layout(tokenizer, TOUCH_LANGUAGE, tactile_tokens=8, view_tokens=8)
    q, length = layout.ids.shape
    assert (q, layout.mask.shape, layout.stream_text.shape) == (4, (4, length), (length,))
    np.testing.assert_array_equal(layout.asked, np.eye(4, dtype=bool))
    for row, attribute in enumerate(TOUCH_LANGUAGE.attributes):
        ids = layout.ids[row]
        assert np.flatnonzero(ids == tokenizer.tactile_id).tolist() == layout.touch.reshape(-1).tolist()
        assert np.flatnonzero(ids == tokenizer.view_id).tolist() == layout.view.tolist()
        np.testing.assert_array_equal(ids == tokenizer.pad_id, ~layout.mask[row])
        question = tokenizer.encode(QUESTIONS[attribute.name])
        assert ids[-len(question) :].tolist() == question, "the last position is the question's last word"
    for s, sensor in enumerate(TOUCH_LANGUAGE.sensors):
        at = np.flatnonzero(layout.stream_text == s)
        assert tokenizer.decode(layout.ids[0, at]).strip() == sensor.name
        np.testing.assert_array_equal(layout.touch[s], at[-1] + 1 + np.arange(8))
    assert np.all(layout.stream_text[layout.touch] == -1)


def test_word_prompt_is_short():
    layout = build_layout(WORD, TOUCH_LANGUAGE, tactile_tokens=8, view_tokens=8)
    assert layout.ids.shape == (4, 48)
    assert layout.mask.sum(1).tolist() == [48, 48, 48, 48]


def test_questions_are_padded_on_the_left():
    rows = (("hardness",), ("hardness", "material"))
    layout = build_layout(WORD, TOUCH_LANGUAGE, tactile_tokens=1, view_tokens=0, asked=rows)
    np.testing.assert_array_equal(layout.asked, [[1, 0, 0, 0], [1, 0, 0, 1]])
    assert layout.view.shape == (0,)
    assert layout.mask.tolist() == [[True] * 8 + [False] * 5 + [True] * 4, [True] * 17]
    assert WORD.decode(layout.ids[1, 8:]) == " how hard is it and which material is it"


def test_question_errors():
    with pytest.raises(ValueError, match="asked is empty"):
        question_ids(WORD, TOUCH_LANGUAGE, ())
    with pytest.raises(ValueError, match="attribute 'weight' is not in the language"):
        question_ids(WORD, TOUCH_LANGUAGE, ("weight",))
    with pytest.raises(ValueError, match="attribute 'material' has no question; add it"):
        question_ids(WORD, TOUCH_LANGUAGE, ("material",), {"hardness": "how hard is it"})
