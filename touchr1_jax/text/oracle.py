"""A plain parser of decoded text on the host, for reports and as a test oracle of the compiled parser.

It shares no code with `lexer` and `parser`, only the definitions in their docstrings.
"""

import dataclasses
import re
import unicodedata

from touchr1_jax.text.language import Language

_LETTER, _OTHER = "\x80", "\x81"  # stand for every character beyond ASCII that continues a word, and that ends one
_WORD = rf"[a-z0-9_{_LETTER}]"
_FOLD = {upper: upper + 32 for upper in range(ord("A"), ord("Z") + 1)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """The levels that a text states, as in `types.Parsed`; −1 is ⊥."""

    perceive: list[list[int]]  # [S][A]
    compare: list[int]  # [A]
    conclude: list[int]  # [A]
    formatted: bool


def read(language: Language, text: str) -> Reading:
    """Parse the text of a completion before its end token."""
    tags = [f"<{slash}{name}>" for name in language.tags for slash in ("", "/")]
    found = list(re.finditer("|".join(map(re.escape, tags)), text))
    spans = {tag: [match.span() for match in found if match.group() == tag] for tag in tags}
    blank = re.sub("|".join(map(re.escape, tags)), lambda tag: "." * len(tag.group()), text)
    bodies = [_body(blank, spans[f"<{name}>"], spans[f"</{name}>"]) for name in language.tags]
    in_order = [match.group() for match in found] == tags
    tail = text[found[-1].end() :] if found else ""
    return Reading(
        perceive=_perceive(language, bodies[0]),
        compare=_slot(language, _phrases(language, bodies[1])),
        conclude=_slot(language, _phrases(language, bodies[2])),
        formatted=in_order and all(body.strip(" \t\n\r\v\f") for body in bodies) and not tail.strip(" \t\n\r\v\f"),
    )


def _body(text: str, opens: list[tuple[int, int]], closes: list[tuple[int, int]]) -> str:
    if len(opens) != 1 or len(closes) != 1 or closes[0][0] < opens[0][1]:
        return ""
    return text[opens[0][1] : closes[0][0]]


def _phrases(language: Language, body: str) -> list[str]:
    """Phrases in a body, left to right, the longest first."""
    sensors = [phrase for sensor in language.sensors for phrase in sensor.phrases]
    levels = [phrase for attribute in language.attributes for words in attribute.levels for phrase in words]
    by_length = sorted({*sensors, *levels}, key=len, reverse=True)
    choices = "|".join(re.escape(phrase).replace(r"\ ", r"[ \t\n\r\v\f]+") for phrase in by_length)
    pattern = f"(?<!{_WORD})(?:{choices})(?!{_WORD})"
    plain = "".join(char if char.isascii() else _kind(char) for char in body).translate(_FOLD)
    return [re.sub(r"[ \t\n\r\v\f]+", " ", match) for match in re.findall(pattern, plain)]


def _kind(char: str) -> str:
    kind = unicodedata.category(char)
    return _LETTER if kind[0] in "LMN" or kind == "Pc" else _OTHER


def _perceive(language: Language, body: str) -> list[list[int]]:
    named: list[list[str]] = [[] for _ in language.sensors]
    sensor = None
    for phrase in _phrases(language, body):
        sensor = next((s for s, known in enumerate(language.sensors) if phrase in known.phrases), sensor)
        if sensor is not None:
            named[sensor].append(phrase)
    return [_slot(language, phrases) for phrases in named]


def _slot(language: Language, phrases: list[str]) -> list[int]:
    slot = []
    for attribute in language.attributes:
        levels = {k for k, words in enumerate(attribute.levels) for phrase in phrases if phrase in words}
        slot.append(levels.pop() if len(levels) == 1 else -1)
    return slot
