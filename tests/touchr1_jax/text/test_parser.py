import dataclasses

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.text.vocabularies import LANGUAGES, character_level, make_tokenizer, token_sequences
from touchr1_jax.text.language import HARDNESS, MATERIAL, TOUCH_LANGUAGE, Attribute
from touchr1_jax.text.oracle import read
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.tokenizer import word_level

LENGTH = {"word": 40, "character": 200, "bpe": 120, "straddling": 80}
GOOD = (
    "<perceive> gelsight_mini soft xense firm tac3d hard dmtac_x soft </perceive> "
    "<compare> firm </compare> <conclude> hard </conclude>"
)
CHARACTERS = character_level()
PARSE = jax.jit(compile_parser(TOUCH_LANGUAGE, CHARACTERS))


def parse(text: str, end: bool = True, length: int = 320):
    ids = CHARACTERS.encode(text) + [CHARACTERS.end_ids[0]] * end
    return PARSE(jnp.array(ids + [CHARACTERS.pad_id] * (length - len(ids)) if end else ids))


def hardness(text: str) -> tuple[list[int], int, int, bool]:
    """Hardness slots and format by the compiled parser, which must be those of the plain one."""
    parsed, reading = parse(text), read(TOUCH_LANGUAGE, text)
    assert_same(parsed, reading)
    return [s[0] for s in reading.perceive], reading.compare[0], reading.conclude[0], reading.formatted


def assert_same(parsed, reading) -> None:
    for field in dataclasses.fields(reading):
        assert np.asarray(getattr(parsed, field.name)).tolist() == getattr(reading, field.name), field.name


@pytest.mark.long
@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("kind", LENGTH)
def test_parser_equals_oracle_on_any_tokens(kind, language):
    language = LANGUAGES[language]
    tokenizer, length = make_tokenizer(kind, language), LENGTH[kind]
    parser = jax.jit(compile_parser(language, tokenizer))

    @hypothesis.settings(max_examples=100, deadline=None)
    @hypothesis.given(token_sequences(language, tokenizer, length))
    def check(ids):
        parsed = parser(jnp.array(ids, jnp.int32))
        ends = [t for t, i in enumerate(ids) if i in tokenizer.end_ids]
        shown = ids[: ends[0]] if ends else ids
        assert_same(parsed, read(language, tokenizer.decode(shown)))
        assert bool(parsed.truncated) == (not ends)
        assert int(parsed.length) == len(shown)

    check()


def test_reads_a_good_answer():
    assert hardness(GOOD) == ([0, 1, 2, 0], 1, 2, True)
    parsed = parse(GOOD)
    assert not parsed.truncated
    assert parsed.length == len(GOOD)
    assert np.all(np.asarray(parsed.perceive)[:, 1:] == -1), "other attributes are not named"


@pytest.mark.parametrize(
    ("body", "level"),
    [
        ("hard", 2),
        ("HaRd", 2),
        ("not hard", 2),
        ("hard hard", 2),
        ("(hard)", 2),
        ("hard-ish", 2),
        ("harder", -1),
        ("hardé", -1),
        ("ĥard", -1),
        ("hard\u0301", -1),
        ("hard२", -1),
        ("hard‿", -1),
        ("hard…", 2),
        ("—hard", 2),
        ("，hard。", 2),
        ("\u00a0hard\u00a0", 2),
        ("「hard」", 2),
        ("hard✅", 2),
        ("\u200bhard", 2),
        ("hard_", -1),
        ("ha rd", -1),
        ("soft hard", -1),
        ("soft firm hard", -1),
        ("rough", -1),
        ("xense hard", 2),
        ("\ufffdhard", 2),
        ("<hard>", 2),
        ("hard</per", 2),
    ],
)
def test_level_words_match_whole_and_alone(body, level):
    _, _, conclude, formatted = hardness(GOOD.replace("> hard <", f">{body}<"))
    assert (conclude, formatted) == (level, True)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param("", ([-1] * 4, -1, -1, False), id="empty"),
        pytest.param(f"let me feel {GOOD}", ([0, 1, 2, 0], 1, 2, True), id="free text before"),
        pytest.param(GOOD.replace("> <", "> so <"), ([0, 1, 2, 0], 1, 2, True), id="free text between"),
        pytest.param(GOOD + " \n\t\r\v\f", ([0, 1, 2, 0], 1, 2, True), id="white space after"),
        pytest.param(GOOD + " \x1c", ([0, 1, 2, 0], 1, 2, False), id="only ASCII white space is white"),
        pytest.param(GOOD + " .", ([0, 1, 2, 0], 1, 2, False), id="text after"),
        pytest.param(GOOD + "<", ([0, 1, 2, 0], 1, 2, False), id="half a tag after"),
        pytest.param(GOOD + GOOD, ([-1] * 4, -1, -1, False), id="all tags repeated"),
        pytest.param(GOOD + "<conclude>", ([0, 1, 2, 0], 1, -1, False), id="one tag repeated"),
        pytest.param(GOOD.replace("<compare>", ""), ([0, 1, 2, 0], -1, 2, False), id="a tag missing"),
        pytest.param(GOOD.replace("</conclude>", ""), ([0, 1, 2, 0], 1, -1, False), id="not closed"),
        pytest.param(GOOD.replace("<compare>", "<COMPARE>"), ([0, 1, 2, 0], -1, 2, False), id="tags are lower case"),
        pytest.param(GOOD.replace("> firm <", "> \n <"), ([0, 1, 2, 0], -1, 2, False), id="empty body"),
        pytest.param(GOOD.replace("> firm <", "> ? <"), ([0, 1, 2, 0], -1, 2, True), id="no level"),
        pytest.param(GOOD.replace("> firm <", "><<"), ([0, 1, 2, 0], -1, 2, True), id="a lone bracket is text"),
        pytest.param("</conclude> hard <conclude>", ([-1] * 4, -1, -1, False), id="closed before opened"),
        pytest.param(
            "<conclude> hard </conclude> <perceive> xense soft </perceive> <compare> firm </compare>",
            ([-1, 0, -1, -1], 1, 2, False),
            id="out of order",
        ),
        pytest.param(
            "<perceive> xense soft <compare> firm </perceive> hard </compare> <conclude> soft </conclude>",
            ([-1, -1, -1, -1], -1, 0, False),
            id="interleaved bodies overlap",
        ),
        pytest.param(
            "xense <perceive> hard gelsight \f mini soft, then DM-Tac x: hard </perceive>",
            ([0, -1, -1, 2], -1, -1, False),
            id="a level belongs to the sensor named before it in the body",
        ),
        pytest.param(
            "<perceive> xense soft tac3d firm xense hard </perceive>", ([-1, -1, 1, -1], -1, -1, False), id="two levels"
        ),
        pytest.param(
            "<perceive> xense soft tac3d firm xense soft </perceive>",
            ([-1, 0, 1, -1], -1, -1, False),
            id="one level twice",
        ),
        pytest.param("a<compare>soft</compare>b", ([-1] * 4, 0, -1, False), id="tags inside words"),
    ],
)
def test_structure(text, expected):
    assert hardness(text) == expected


@pytest.mark.long
def test_truncated_answer_is_read_as_it_stands():
    parsed = parse(GOOD, end=False)
    assert parsed.truncated
    assert parsed.formatted
    assert parsed.conclude[0] == 2
    assert not parse(GOOD[:-1], end=False).formatted


@pytest.mark.long
def test_tokens_belong_to_the_segment_that_is_not_over():
    """A closing tag ends its own segment; one of `compare` before that of `perceive` ends none."""
    tokenizer = word_level(TOUCH_LANGUAGE)
    parser = compile_parser(TOUCH_LANGUAGE, tokenizer)
    of = lambda text: parser.segments(jnp.array([*tokenizer.encode(text), *tokenizer.end_ids])).tolist()
    assert of("<perceive> soft </perceive> <compare> soft </compare> <conclude> soft") == [0] * 3 + [1] * 3 + [2] * 3
    assert of("</compare> soft </perceive> soft </compare> soft") == [0, 0, 0, 2, 2, 2, 2]
    assert of("soft firm") == [0, 0, 0]


def test_shapes_and_types():
    parsed = jax.eval_shape(PARSE, jax.ShapeDtypeStruct((24,), jnp.int32))
    assert (parsed.perceive.shape, parsed.compare.shape, parsed.conclude.shape) == ((4, 4), (4,), (4,))
    assert {parsed.perceive.dtype, parsed.compare.dtype, parsed.length.dtype} == {jnp.dtype(jnp.int32)}
    assert {parsed.formatted.dtype, parsed.truncated.dtype} == {jnp.dtype(bool)}


def test_errors():
    tokenizer = word_level(TOUCH_LANGUAGE)
    with pytest.raises(ValueError, match=r"tokens have shape \(2, 5\).*vmap"):
        compile_parser(TOUCH_LANGUAGE, tokenizer)(jnp.zeros((2, 5), jnp.int32))
    many = Attribute(name="shade", levels=tuple((f"s{k}",) for k in range(32)))
    with pytest.raises(ValueError, match=r"attribute shade has 32 levels.*at most 31"):
        compile_parser(dataclasses.replace(TOUCH_LANGUAGE, attributes=(HARDNESS, many)), tokenizer)
    with pytest.raises(ValueError, match="sensors is empty"):
        compile_parser(dataclasses.replace(TOUCH_LANGUAGE, sensors=()), tokenizer)


def test_thirty_one_levels_fit():
    shade = Attribute(name="shade", levels=tuple((f"s{k}",) for k in range(31)))
    language = dataclasses.replace(TOUCH_LANGUAGE, attributes=(MATERIAL, shade))
    parser = jax.jit(compile_parser(language, CHARACTERS))
    for k in (0, 1, 29, 30):
        text = f"<conclude> s{k:02d} </conclude>" if k > 9 else f"<conclude>  s{k} </conclude>"
        assert parser(jnp.array(CHARACTERS.encode(text))).conclude.tolist() == [-1, k]
