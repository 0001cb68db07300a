"""Questions in plain words: which attribute they ask for, and whether they compare two objects."""

import dataclasses
import re
from collections.abc import Mapping, Sequence

MORE: Mapping[str, tuple[str, ...]] = {
    "hardness": ("hard", "harder", "hardest", "hardness", "stiff", "stiffer", "stiffest", "firmer"),
    "roughness": ("rough", "rougher", "roughest", "roughness", "coarse", "coarser", "texture"),
    "protrusion": ("protruding", "protrusion", "protrude", "protrudes", "bumpier", "bumps", "relief"),
    "material": ("material", "made", "substance"),
}
"""Words that ask for an attribute, besides its name and the words of its levels."""

LESS: Mapping[str, tuple[str, ...]] = {
    "hardness": ("soft", "softer", "softest", "softness"),
    "roughness": ("smooth", "smoother", "smoothest", "smoothness"),
    "protrusion": ("flat", "flatter", "flattest", "flatness"),
}
"""Words that ask for the lower end of an attribute."""

_COMPARING = re.compile(r"\b(more|less|most|least|\w+(?:er|est))\b")
_VAGUE = ("other", "food", "paper", "medium")  # levels whose words mean something else in most questions


class QuestionError(ValueError):
    """A question, or a touch, that a policy cannot be asked about; the message lists what can be asked."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AskedAttribute:
    """An attribute that a question asks for: `sign` −1 for its lower end, `compares` where it asks for a difference."""

    name: str
    sign: int
    compares: bool


def read_question(question: str, attributes: Mapping[str, Sequence[str]]) -> AskedAttribute:
    """The attribute that a question in plain words asks for.

    Args:
      question: such as "How hard is it?" or "Which is softer?".
      attributes: those that can be asked for, with the words of their levels.

    Raises:
      QuestionError: the question names none of them, several, or compares by both ends of one.
    """
    text = question.lower()
    words = set(re.findall(r"[a-z]+", text))
    found = {}
    for name, levels in attributes.items():
        up, down = {name, *MORE.get(name, ()), *levels} - {*_VAGUE}, {*LESS.get(name, ())}
        if words & (up | down):
            found[name] = -1 if words & down else 1
    if len(found) != 1:
        named = f"names {' and '.join(found)}: ask for one at a time" if found else "names no attribute"
        raise QuestionError(
            f"question is {question!r}: it {named}; ask for {', '.join(attributes)}, as in 'How hard is it?', "
            "'Which material is it?' or, of two objects, 'Which is softer?'"
        )
    [(name, sign)] = found.items()
    comparing = set(_COMPARING.findall(text)) & {
        "more",
        "less",
        "most",
        "least",
        *MORE.get(name, ()),
        *LESS.get(name, ()),
    }
    if comparing and words & {*MORE.get(name, ())} and words & {*LESS.get(name, ())}:
        raise QuestionError(f"question is {question!r}: it names both ends of {name}; ask as in 'Which is softer?'")
    return AskedAttribute(name=name, sign=-sign if words & {"less", "least"} else sign, compares=bool(comparing))
