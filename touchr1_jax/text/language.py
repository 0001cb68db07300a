"""The answer language as data: tags, sensors, attributes and the words of their levels.

    <perceive> gelsight_mini soft , xense soft </perceive> <compare> soft </compare> <conclude> soft </conclude>

A new tag, sensor, attribute or level word is an entry here; nothing else in the code changes.
"""

import dataclasses
import re

SEGMENTS = ("perceive", "compare", "conclude")
"""The roles of the three segments, in order: per-sensor evidence, cross-sensor summary, answer."""

_PHRASE = re.compile(r"[a-z0-9_]+(?:[ \-][a-z0-9_]+)*")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attribute:
    """A property that can be asked for: `levels[k]` are the phrases that name level k, the canonical one first.

    `ordered` marks a property that depends on the order of the frames, so that a shuffle of them is a control for it.
    """

    name: str
    levels: tuple[tuple[str, ...], ...]
    ordinal: bool = True
    ordered: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensor:
    """A tactile sensor: `phrases` are its names, the first one canonical."""

    name: str
    phrases: tuple[str, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Language:
    """Attributes, sensors and tags of the answers that the template writes and the parser reads.

    Raises:
      ValueError: an attribute of fewer than two levels; a phrase that is not lower-case words joined by single spaces
        or hyphens, or that means two things.
    """

    attributes: tuple[Attribute, ...]
    sensors: tuple[Sensor, ...]
    tags: tuple[str, str, str] = SEGMENTS

    def __post_init__(self) -> None:
        for attribute in self.attributes:
            if len(attribute.levels) < 2:
                raise ValueError(
                    f"attribute {attribute.name} has levels {attribute.levels}: must be two or more; add one"
                )
            owner: dict[str, int] = {}
            for level, words in enumerate(attribute.levels):
                for word in words:
                    _check_phrase(f"attribute {attribute.name}, level {level}", word)
                    if owner.setdefault(word, level) != level:
                        raise ValueError(
                            f"attribute {attribute.name}: {word!r} names levels {owner[word]} and {level}; "
                            "a word may name one level of an attribute: drop it from one of them"
                        )
        names: dict[str, str] = {}
        for sensor in self.sensors:
            for phrase in sensor.phrases:
                _check_phrase(f"sensor {sensor.name}", phrase)
                if names.setdefault(phrase, sensor.name) != sensor.name:
                    raise ValueError(
                        f"sensor phrase {phrase!r} names {names[phrase]} and {sensor.name}; drop it from one of them"
                    )

    def attribute_index(self, name: str) -> int:
        """Position of an attribute on the A axis."""
        names = [a.name for a in self.attributes]
        if name not in names:
            raise ValueError(f"attribute {name!r} is not in the language; choose from {', '.join(names)}")
        return names.index(name)


def _check_phrase(field: str, phrase: str) -> None:
    if _PHRASE.fullmatch(phrase) is None:
        raise ValueError(
            f"{field}: {phrase!r} must be lower-case ASCII words joined by single spaces or hyphens; rewrite it"
        )


HARDNESS = Attribute(name="hardness", levels=(("soft",), ("firm",), ("hard",)))
ROUGHNESS = Attribute(name="roughness", levels=(("smooth",), ("textured",), ("rough",)))
PROTRUSION = Attribute(name="protrusion", levels=(("flat",), ("bumpy",), ("protruding",)))
MATERIAL = Attribute(
    name="material",
    levels=tuple((w,) for w in ("plastic", "metal", "fabric", "food", "paper", "glass", "leather", "wood", "other")),
    ordinal=False,
)
ELASTICITY = Attribute(name="elasticity", levels=(("inelastic",), ("semi-elastic",), ("elastic",)))
FRICTION = Attribute(name="friction", levels=(("slippery",), ("medium",), ("sticky",)))

SENSORS = (
    Sensor(name="gelsight_mini", phrases=("gelsight_mini", "gelsight mini")),
    Sensor(name="xense", phrases=("xense",)),
    Sensor(name="tac3d", phrases=("tac3d",)),
    Sensor(name="dmtac_x", phrases=("dmtac_x", "dm-tac x")),
)

TOUCH_LANGUAGE = Language(attributes=(HARDNESS, ROUGHNESS, PROTRUSION, MATERIAL), sensors=SENSORS)

EXPLORED_ATTRIBUTES = (HARDNESS, ROUGHNESS, PROTRUSION, ELASTICITY, FRICTION)
"""Attributes that a policy which chooses its touches is asked for; no touch alone reveals all of them."""
