"""Ambiguous languages are refused."""

import dataclasses

import pytest

from touchr1_jax.text.language import MATERIAL, TOUCH_LANGUAGE, Attribute, Language, Sensor

SENSORS = TOUCH_LANGUAGE.sensors


@pytest.mark.parametrize("phrase", ["Soft", "very  soft", " soft", "soft-", "so.ft", "ſoft", ""])
def test_phrases_are_lower_case_words(phrase):
    with pytest.raises(ValueError, match=r"attribute hardness, level 1: .* must be lower-case ASCII words joined by"):
        Language(attributes=(Attribute(name="hardness", levels=(("firm",), ("hard", phrase))),), sensors=SENSORS)
    with pytest.raises(ValueError, match=r"sensor xense: .* must be lower-case ASCII words joined by"):
        Language(attributes=(MATERIAL,), sensors=(Sensor(name="xense", phrases=("xense", phrase)),))


def test_a_phrase_names_one_level_and_one_sensor():
    twice = Attribute(name="hardness", levels=(("soft",), ("firm", "soft")))
    with pytest.raises(ValueError, match="attribute hardness: 'soft' names levels 0 and 1"):
        Language(attributes=(twice,), sensors=SENSORS)
    with pytest.raises(ValueError, match="sensor phrase 'xense' names xense and other; drop it"):
        Language(attributes=(MATERIAL,), sensors=(*SENSORS, Sensor(name="other", phrases=("xense",))))


def test_attributes_are_found_by_name():
    assert [TOUCH_LANGUAGE.attribute_index(a.name) for a in TOUCH_LANGUAGE.attributes] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="attribute 'weight' is not in the language; choose from hardness, rough"):
        TOUCH_LANGUAGE.attribute_index("weight")


def test_levels_are_ordinal_unless_they_say_otherwise():
    assert [a.ordinal for a in TOUCH_LANGUAGE.attributes] == [True, True, True, False]
    assert not any(a.ordered for a in TOUCH_LANGUAGE.attributes)


@pytest.mark.parametrize("part", [TOUCH_LANGUAGE, MATERIAL, SENSORS[0]], ids=lambda part: type(part).__name__)
def test_parts_of_a_language_are_given_by_name_and_never_change(part):
    assert all(field.kw_only for field in dataclasses.fields(part))
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(part, dataclasses.fields(part)[0].name, None)
