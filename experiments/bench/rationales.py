"""Rationales from measurements: what each sensor measured, what that says, what all say together, and the answer.

They are written in the three segments that policies answer in, so that a file of items is also a file for supervised
fine-tuning.  `perceive` says what each sensor's own number suggests by `readings`, `compare` the median of that, and
`conclude` the label: the first two may differ from it, since one number of one sensor is not the truth.
"""

import collections
from collections.abc import Mapping, Sequence

from experiments.bench.contacts import MeasuredContact
from experiments.bench.thresholds import ThresholdReader
from experiments.bench.wording import PLACES, answer_words, language_of, question
from sensors_io.measures import UNITS, Measured
from touchr1_jax.bench.items import Ask, Citation, Item, Touch
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.text.language import SENSORS, TOUCH_LANGUAGE

DIGITS = 3
"""Of every number in a rationale."""

SUPPORT: Mapping[str, str] = {"hardness": "stiffness", "roughness": "fine texture", "protrusion": "relief"}
"""Beside the quantity that is read: how force answers to deformation, and the energy of fine and coarse relief."""

UNCLEAR = "no reading"
"""What is perceived where the quantity that would be read was not measured."""


def compose_item(ask: Ask, contacts: Mapping[Touch, MeasuredContact], readings: ThresholdReader) -> Item:
    """The item with its question, rationale and evidence.

    Args:
      ask: what is asked.
      contacts: by touch, those that the question shows among them.
      readings: of the training objects.
    """
    shown = [contacts[touch] for touch in ask.touches]
    evidence: list[Citation] = []
    write = _single if len(shown) == 1 else _several
    perceive, compare = write(ask, shown, readings, evidence)
    tags = language_of(ask.kind).tags
    bodies = (perceive, compare, answer_words(ask))
    rationale = " ".join(f"<{tag}> {body} </{tag}>" for tag, body in zip(tags, bodies, strict=True))
    return Item(ask=ask, question=question(ask), rationale=rationale, evidence=tuple(evidence))


def _single(
    ask: Ask, shown: Sequence[MeasuredContact], readings: ThresholdReader, evidence: list[Citation]
) -> tuple[str, str]:
    contact, reports = shown[0], []
    levels: dict[str, list[int]] = {name: [] for name in ask.attributes}
    for sensor in ask.sensors:
        parts = []
        for name in ask.attributes:
            numbers = _numbers(0, contact, sensor, name, readings, evidence)
            if readings.can_read(contact, sensor, name):
                levels[name].append(readings.level(contact, sensor, name))
                parts.append(f"{numbers}: {_word(name, levels[name][-1])}")
            else:
                parts.append(f"{numbers}: {UNCLEAR} of {name}")
        reports.append(f"{_phrase(sensor)} {', '.join(parts)}")
    together = [_together(name, said) for name, said in levels.items() if said]
    return "; ".join(reports), " and ".join(together) or UNCLEAR


def _several(
    ask: Ask, shown: Sequence[MeasuredContact], readings: ThresholdReader, evidence: list[Citation]
) -> tuple[str, str]:
    name, reports, votes = ask.attributes[0], [], []
    for sensor in ask.sensors:
        numbers = [_numbers(t, contact, sensor, name, readings, evidence) for t, contact in enumerate(shown)]
        reports.append(f"{_phrase(sensor)} " + " against ".join(numbers))
        if not all(readings.can_read(contact, sensor, name) for contact in shown):
            continue
        scale = readings.scales[sensor, name]
        values = [contact.measured[sensor].quantities[scale.quantity] for contact in shown]
        votes.append(tuple(sorted(range(len(shown)), key=lambda t: values[t] if scale.rising else -values[t])))
    if not votes:
        return "; ".join(reports), UNCLEAR
    order, count = collections.Counter(votes).most_common(1)[0]
    called = [PLACES[t] for t in order]
    text = called[-1] if ask.kind == "compare" else " ".join(called)
    return "; ".join(reports), f"{count} of {len(votes)} sensors say {text}"


def _numbers(
    touch: int, contact: MeasuredContact, sensor: str, name: str, readings: ThresholdReader, evidence: list[Citation]
) -> str:
    """What a sensor measured that speaks for an attribute, in words, what is read first; noted as evidence."""
    measured = contact.measured[sensor]
    attributes = ORDINAL if name == "material" else (name,)
    read = [readings.scales[sensor, a].quantity for a in attributes if (sensor, a) in readings.scales]
    beside = [SUPPORT[attribute] for attribute in attributes]
    spoken = [quantity for quantity in dict.fromkeys(read + beside) if quantity in measured.quantities]
    words = ", ".join(_cite(touch, sensor, measured, quantity, evidence) for quantity in spoken) or "contact"
    return (
        f"{words} at {_cite(touch, sensor, measured, 'force', evidence)}" if "force" in measured.quantities else words
    )


def _cite(touch: int, sensor: str, measured: Measured, quantity: str, evidence: list[Citation]) -> str:
    """One measurement in words, a force without its name; noted as evidence."""
    value, unit = float(f"{measured.quantities[quantity]:.{DIGITS}g}"), UNITS[quantity]
    citation = Citation(touch=touch, sensor=sensor, quantity=quantity, value=value, unit=unit, at=_place(measured.at))
    if citation not in evidence:
        evidence.append(citation)
    return f"{value:g} {unit}" if quantity == "force" else f"{quantity} {value:g} {unit}"


def _place(at: tuple[float, float]) -> tuple[float, float]:
    """To a thousandth of the window, so that files hold no digits that nobody measured."""
    return round(at[0], 3), round(at[1], 3)


def _together(name: str, levels: Sequence[int]) -> str:
    """What the readings of all sensors say: the lower median of ordinal levels, the commonest of the others."""
    if name in ORDINAL:
        said, how = sorted(levels)[(len(levels) - 1) // 2], "median"
    else:
        said, how = min(set(levels), key=lambda level: (-levels.count(level), level)), "commonest"
    return f"{name} by the {how} of {len(levels)} {'reading' if len(levels) == 1 else 'readings'} {_word(name, said)}"


def _word(name: str, level: int) -> str:
    return TOUCH_LANGUAGE.attributes[TOUCH_LANGUAGE.attribute_index(name)].levels[level][0]


def _phrase(sensor: str) -> str:
    """How the language calls a sensor."""
    names = {known.name: known.phrases[0] for known in SENSORS}
    return names[sensor]
