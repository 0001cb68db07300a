"""Rationales from measurements, in the three segments of the answer language, so that items can train a policy by SFT.

`perceive` gives the numbers of each sensor and the level that one of them suggests by its thresholds, `compare` the
median of these levels, and `conclude` the label: the first two may differ from it, since one number is not the truth.
"""

import collections
from collections.abc import Mapping, Sequence

from touchr1_jax.bench.items import Ask, Citation, Item, Touch
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.bench.questions.contacts import MeasuredContact
from touchr1_jax.bench.questions.thresholds import ThresholdReader
from touchr1_jax.bench.questions.wording import PLACES, answer_words, language_of, level_words, question
from touchr1_jax.text.language import SENSORS

DIGITS = 3
"""Significant digits of every number in a rationale."""

SUPPORT: Mapping[str, str] = {"hardness": "stiffness", "roughness": "fine texture", "protrusion": "relief"}
"""Quantity that is cited in addition to the one that is read: force over deformation, fine and coarse relief."""

UNCLEAR = "no reading"
"""Text in place of a level where the quantity with thresholds was not measured."""

PHRASES = {sensor.name: sensor.phrases[0] for sensor in SENSORS}
"""Names of the sensors in the answer language."""


def compose_item(ask: Ask, contacts: Mapping[Touch, MeasuredContact], reader: ThresholdReader) -> Item:
    """The item with its question, rationale and evidence; `contacts` must include all touches of the question."""
    shown = [contacts[touch] for touch in ask.touches]
    evidence: list[Citation] = []
    write = _about_one if len(shown) == 1 else _about_several
    bodies = (*write(ask, shown, reader, evidence), answer_words(ask))
    tags = language_of(ask.kind).tags
    rationale = " ".join(f"<{tag}> {body} </{tag}>" for tag, body in zip(tags, bodies, strict=True))
    return Item(ask=ask, question=question(ask), rationale=rationale, evidence=tuple(evidence))


def _about_one(
    ask: Ask, shown: Sequence[MeasuredContact], reader: ThresholdReader, evidence: list[Citation]
) -> tuple[str, str]:
    contact, reports = shown[0], []
    levels: dict[str, list[int]] = {name: [] for name in ask.attributes}
    for sensor in ask.sensors:
        parts = []
        for name in ask.attributes:
            numbers = _numbers(0, contact, sensor, name, reader, evidence)
            if reader.can_read(contact, sensor, name):
                levels[name].append(reader.level(contact, sensor, name))
                parts.append(f"{numbers}: {level_words(name)[levels[name][-1]]}")
            else:
                parts.append(f"{numbers}: {UNCLEAR} of {name}")
        reports.append(f"{PHRASES[sensor]} {', '.join(parts)}")
    together = [_together(name, found) for name, found in levels.items() if found]
    return "; ".join(reports), " and ".join(together) or UNCLEAR


def _about_several(
    ask: Ask, shown: Sequence[MeasuredContact], reader: ThresholdReader, evidence: list[Citation]
) -> tuple[str, str]:
    name, reports, votes = ask.attributes[0], [], []
    for sensor in ask.sensors:
        numbers = [_numbers(t, contact, sensor, name, reader, evidence) for t, contact in enumerate(shown)]
        reports.append(f"{PHRASES[sensor]} " + " against ".join(numbers))
        if not all(reader.can_read(contact, sensor, name) for contact in shown):
            continue
        read = reader.thresholds[sensor, name]
        values = [contact.measured[sensor].quantities[read.quantity] for contact in shown]
        votes.append(tuple(sorted(range(len(shown)), key=lambda t: values[t] if read.rising else -values[t])))
    if not votes:
        return "; ".join(reports), UNCLEAR
    order, count = collections.Counter(votes).most_common(1)[0]
    places = [PLACES[t] for t in order]
    text = places[-1] if ask.kind == "compare" else " ".join(places)
    return "; ".join(reports), f"{count} of {len(votes)} sensors say {text}"


def _numbers(
    touch: int, contact: MeasuredContact, sensor: str, name: str, reader: ThresholdReader, evidence: list[Citation]
) -> str:
    """A sensor's measurements that bear on an attribute, in words, the one that is read first; adds the evidence."""
    measured = contact.measured[sensor]
    attributes = ORDINAL if name == "material" else (name,)
    read = [reader.thresholds[sensor, a].quantity for a in attributes if (sensor, a) in reader.thresholds]

    def cite(quantity: str) -> str:
        value, unit = float(f"{measured.quantities[quantity]:.{DIGITS}g}"), measured.units[quantity]
        at = (round(measured.at[0], 3), round(measured.at[1], 3))  # no digits beyond the resolution of a window
        citation = Citation(touch=touch, sensor=sensor, quantity=quantity, value=value, unit=unit, at=at)
        if citation not in evidence:
            evidence.append(citation)
        return f"{value:g} {unit}" if quantity == "force" else f"{quantity} {value:g} {unit}"

    quantities = dict.fromkeys(read + [SUPPORT[attribute] for attribute in attributes])
    words = ", ".join(cite(quantity) for quantity in quantities if quantity in measured.quantities) or "contact"
    return f"{words} at {cite('force')}" if "force" in measured.quantities else words


def _together(name: str, levels: Sequence[int]) -> str:
    """All readings of an attribute as one: the lower median of ordinal levels, the commonest of the others."""
    if name in ORDINAL:
        level, how = sorted(levels)[(len(levels) - 1) // 2], "median"
    else:
        level, how = min(set(levels), key=lambda level: (-levels.count(level), level)), "commonest"
    readings = "reading" if len(levels) == 1 else "readings"
    return f"{name} by the {how} of {len(levels)} {readings} {level_words(name)[level]}"
