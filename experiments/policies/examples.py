"""A few answers for the report, with the touch that they are about."""

import re

import numpy as np

from experiments.policies.answers import Evaluated, reward_terms
from experiments.policies.assembly import Weights
from experiments.policies.study import Study
from experiments.reporting.results import RolloutExample, Slot
from sensors_io.pipeline import make_clip
from touchr1_jax.text.language import SEGMENTS
from touchr1_jax.text.template import QUESTIONS


def rollout_examples(study: Study, arm: str, weights: Weights) -> tuple[RolloutExample, ...]:
    """For each attribute, the first test question that the arm's first seed got right and the first it got wrong."""
    said = study.answers[arm][0]
    asked = said.label[np.arange(len(said.attribute)), said.attribute]
    right = said.parsed.conclude[np.arange(len(said.attribute)), said.attribute] == asked
    rows = []
    for a in range(len(study.assembly.language.attributes)):
        for outcome in (True, False):
            rows += np.flatnonzero((said.attribute == a) & (right == outcome))[:1].tolist()
    terms = reward_terms(study.assembly, said, weights, study.prior)
    return tuple(_example(study, arm, said, row, {name: float(v[row]) for name, v in terms.items()}) for row in rows)


def _example(study: Study, arm: str, said: Evaluated, row: int, terms: dict[str, float]) -> RolloutExample:
    data, assembly = study.data, study.assembly
    contact = int(data.parts["test"][said.contact[row]])
    card = data.store.objects[data.store.contacts[contact].object_id]
    clip = make_clip(data.store.contact(contact, fields=True), card, data.clip)
    attribute = assembly.language.attributes[said.attribute[row]]
    felt = [(s, name) for s, name in enumerate(data.clip.sensors) if clip.stream_mask[s]]
    trace = assembly.tokenizer.decode(said.tokens[row])
    return RolloutExample(
        arm=arm,
        object_id=card.object_id,
        question=f"{QUESTIONS[attribute.name]}?",
        label=f"{attribute.name}: {attribute.levels[said.label[row, said.attribute[row]]][0]}",
        trace=trace,
        slots=bodies(trace),
        reward=terms,
        total=sum(terms.values()),
        frames={name: clip.frames[s][clip.frame_mask[s]] for s, name in felt},
        force_n={name: clip.force_n[s][clip.frame_mask[s]] for s, name in felt},
        view=card.view,
    )


def bodies(trace: str) -> tuple[Slot, ...]:
    """Start, end and name of the body of each segment of a trace, in order of the text."""
    found = [
        (m.start(1), m.end(1), tag) for tag in SEGMENTS for m in re.finditer(rf"<{tag}>\s*(.*?)\s*</{tag}>", trace)
    ]
    slots: list[Slot] = []
    for start, end, tag in sorted(found):
        if not slots or start >= slots[-1][1]:
            slots.append((start, end, tag))
    return tuple(slots)
