"""Ask a policy that chooses its touches: it asks for a contact, gets a recording, and goes on until it concludes.

A person who holds the sensor answers each request with RECORDS:CONTACT, a video or a folder of pictures; an empty line
says that the contact cannot be made.  `generated` answers for a generated object.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.active.contacts import ContactsConfig, kept_frames, one_contact, recorded_frames
from experiments.active.saved import Exploration, Explorer, is_explorer
from experiments.ask.inputs import GENERATED, UNSEEN_SEED, contact_row, filmed_sequence
from experiments.core.artifacts import read_json
from experiments.core.errors import DataError
from experiments.study.policies import FILE, require_own, run_policy
from sensors_io.index import INDEX
from sensors_io.records import RecordStore
from sensors_io.scenes.cards import solid_of
from sensors_io.schema import Sequence
from touchr1_jax.models.qwen.config import CONFIG_FILE
from touchr1_jax.text.language import EXPLORED_ATTRIBUTES
from touchr1_jax.text.plain_questions import read_question
from touchr1_jax.training.compilation import compiled_quickly

WORDS = {attribute.name: [level[0] for level in attribute.levels] for attribute in EXPLORED_ATTRIBUTES}
"""Attribute → words of its levels."""

SAID = {
    "press": "press it",
    "slide_x": "slide it along x",
    "slide_y": "slide it along y",
    "roll": "roll it",
    "twist": "twist it",
    "tap": "tap it",
    "hold": "press it and hold",
}
"""Motion → request to a person."""


def explorer_folder(name: str, runs_dir: Path) -> Path | None:
    """The folder of a policy that chooses its touches; `None` where the name is that of another policy or of none.

    Raises:
      PolicyError: a run without this policy, or with that of another run, arm or seed in its place.
    """
    own = run_policy(name, runs_dir)
    folder = own or Path(name)
    if not is_explorer(folder):
        return None
    if own is not None:
        require_own(own, read_json(own / CONFIG_FILE).get(FILE))
    return folder


def explored(
    explorer: Explorer, source: str, question: str, say: Callable[[str], None], listen: Callable[[], str]
) -> str:
    """Answer a question about one object by the contacts that the policy asks for; the answer as text.

    Args:
      explorer: the policy.
      source: `generated` or `generated:NUMBER`; empty for a person who answers.
      question: for one of the attributes.
      say: shows one line.
      listen: waits for the answer of a person.

    Raises:
      QuestionError: a question for no attribute, or for a difference.
      DataError: another source, or a question that compares.
    """
    asked = read_question(question, WORDS)
    if asked.compares:
        raise DataError(f"question is {question!r}: it compares two objects; ask about one")
    contacts = unseen_object(explorer.contacts, source) if source else explorer.contacts
    give = _generated(contacts) if source else _person(contacts, say, listen)
    unmade: list[int] = []

    def contact(choice: int) -> Any:
        say(f"now {request(explorer.contacts.choices[choice])}")
        frames = give(choice)
        unmade.extend([choice] if frames is None else ())
        return frames

    with compiled_quickly():  # programs that run a few times
        found = explorer.ask(list(WORDS).index(asked.name), contact)
    truth = WORDS[asked.name][solid_of(contacts.scenes, 0).levels()[asked.name]] if source else ""
    line = exploration_line(explorer, found, question, truth)
    return f"{line}; {len(unmade)} of them could not be made" if unmade else line


def request(choice: tuple[str, str, float]) -> str:
    """A choice as words to a person."""
    sensor, motion, force = choice
    return f"{SAID[motion]} with the {sensor}, {force:g} N"


def _generated(contacts: ContactsConfig) -> Callable[[int], np.ndarray]:
    """Contacts of the only object of a configuration."""
    return lambda choice: kept_frames(one_contact(contacts, 0, contacts.choices[choice]), contacts)


def unseen_object(contacts: ContactsConfig, source: str) -> ContactsConfig:
    """The configuration of one generated object, by its number.

    Raises:
      DataError: not `generated` or `generated:NUMBER`.
    """
    kind, _, number = source.partition(":")
    if kind != GENERATED or not (number.isdecimal() or source == GENERATED) or len(number) > 9:
        raise DataError(
            f"input is {source!r}: a policy that chooses its touches takes {GENERATED}, {GENERATED}:NUMBER, or none, "
            "and then asks for recordings; correct it"
        )
    drawn = int(number) if number else int(np.random.default_rng().integers(UNSEEN_SEED))
    return dataclasses.replace(contacts, objects=1, seed=UNSEEN_SEED + drawn)


def _person(
    contacts: ContactsConfig, say: Callable[[str], None], listen: Callable[[], str]
) -> Callable[[int], np.ndarray | None]:
    """Recordings that a person names; what cannot be read is reported and asked for again."""

    def give(choice: int) -> np.ndarray | None:
        sensor = contacts.choices[choice][0]
        while True:
            say("its recording (RECORDS:CONTACT, a video, or a folder of pictures; empty if it cannot be made):")
            try:
                line = listen()
            except UnicodeDecodeError:
                say("that is no text in UTF-8; name the recording again, or rename it")
                continue
            if not line:
                raise DataError("the answers ended before the policy concluded; answer each request, at least by Enter")
            if not (answer := line.strip()):
                return None
            try:
                return recorded_frames(recording(answer, sensor), contacts)
            except (DataError, ValueError, OSError) as error:
                say(f"{error}")

    return give


def recording(source: str, sensor: str) -> Sequence:
    """Recording of a contact by one sensor.

    Raises:
      DataError: no such recording, or one by other sensors.
    """
    path, _, which = (source, "", "") if Path(source).exists() else source.rpartition(":")
    if not path or not Path(path).exists():
        raise DataError(f"recording is {source!r}: no such file; give RECORDS:CONTACT, a video or a folder of pictures")
    if not (Path(path) / INDEX).exists():
        return filmed_sequence(Path(path), sensor)
    store = RecordStore(Path(path))
    found = store.contact(contact_row(store, which), fields=True)
    if sensor not in found:
        raise DataError(f"recording is {source!r}, by {', '.join(found)}: must be by {sensor}; give another")
    return found[sensor]


def exploration_line(explorer: Explorer, found: Exploration, question: str, truth: str = "") -> str:
    """The answer as text, with the truth where it is known."""
    words = WORDS[read_question(question, WORDS).name]
    shares = ", ".join(f"{word} {p:.0%}" for word, p in zip(words, found.probabilities, strict=True))
    number = f"{len(found.choices)} touch{'' if len(found.choices) == 1 else 'es'}"
    seconds = explorer.contacts.seconds[list(found.choices)].sum()
    line = f"{question} {words[int(found.probabilities.argmax())]} ({shares}), after {number}, {seconds:.1f} s"
    return f"{line}; truth {truth}" if truth else line
