"""From records to items: draw the questions, word them by rule or by another author, keep those that pass the rules.

Another author, such as a language model, works on files of JSON Lines.  A request holds everything that the author may
know,

    id, kind, attributes, sensors, task, answer, choices, touches: [{object, site, motion, trial, measured: {sensor:
    {quantities: {name: {value, unit}}, at, box}}}]

and a candidate has `id`, `question`, `answer`, `rationale` and `evidence`, as in `touchr1_jax.bench.items`.  The right
answers are in the requests, but are drawn anew when candidates come back, so that no file can change them.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from touchr1_jax.bench.items import KINDS, Ask, Item, Touch, citation_of
from touchr1_jax.bench.json_lines import LinesError
from touchr1_jax.bench.questions.contacts import MeasuredContact, SplitContacts
from touchr1_jax.bench.questions.draw import Quota, draw
from touchr1_jax.bench.questions.rationales import compose_item
from touchr1_jax.bench.questions.rules import CandidateItem, FilteredItems, apply_rules
from touchr1_jax.bench.questions.thresholds import ThresholdReader
from touchr1_jax.bench.questions.wording import answer_choices, answer_words, read_answer, slots_of

TASK = (
    "Write one question about what the sensors felt, and its rationale. The rationale has three segments, "
    "<perceive> … </perceive> <compare> … </compare> <conclude> … </conclude>: what each named sensor measured and "
    "what it suggests, what all of them say together, the answer in exactly the given words. Ground it in the measured "
    "quantities, with numbers and units, and list each that you use as evidence with its touch, sensor, quantity, "
    "value, unit and place. Use no number that is not given, and do not give the answer away in the question."
)
"""Instructions to the author of a candidate."""

CANDIDATE_FIELDS = ("id", "question", "answer", "rationale", "evidence")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchSource:
    """Contacts to ask about, training contacts, thresholds fitted on these, and the sensors of the data set."""

    bench: SplitContacts
    train: SplitContacts
    reader: ThresholdReader
    sensors: tuple[str, ...]


def draw_questions(source: BenchSource, quota: Quota, seed: int) -> tuple[Ask, ...]:
    """The questions of a seed, drawn from the records."""
    return draw(source.bench.contacts, source.sensors, quota, seed)


def generate(source: BenchSource, quota: Quota, seed: int) -> FilteredItems:
    """Items worded by rule; the same records, quota and seed give the same bytes."""
    contacts = source.bench.by_touch()
    items = [compose_item(ask, contacts, source.reader) for ask in draw_questions(source, quota, seed)]
    return apply_rules(map(CandidateItem.of, items), contacts)


def share_at_odds(items: Sequence[Item]) -> float:
    """Share of the items whose `compare` segment does not give the right answer.

    They stay in the bench: without them it would hold only what a threshold on one number can answer.
    """
    compared = lambda item: read_answer(item.ask, item.rationale)[0].compare
    odd = sum(tuple(compared(item)[slot] for slot in slots_of(item.ask)) != item.ask.answer for item in items)
    return odd / len(items)


def author_requests(asks: Iterable[Ask], contacts: Mapping[Touch, MeasuredContact]) -> Iterator[dict[str, Any]]:
    """One request for each question."""
    for ask in asks:
        touches = []
        for touch in ask.touches:
            measured = {}
            for sensor in ask.sensors:
                m = contacts[touch].measured[sensor]
                quantities = {
                    name: {"value": float(f"{x:.4g}"), "unit": m.units[name]} for name, x in m.quantities.items()
                }
                measured[sensor] = {"quantities": quantities, "at": list(m.at), "box": list(m.box)}
            touches.append(dataclasses.asdict(touch) | {"measured": measured})
        yield {
            "id": ask.id,
            "kind": ask.kind,
            "meaning": KINDS[ask.kind].meaning,
            "attributes": list(ask.attributes),
            "sensors": list(ask.sensors),
            "task": TASK,
            "answer": answer_words(ask),
            "choices": answer_choices(ask),
            "touches": touches,
        }


def read_candidates(rows: Iterable[tuple[int, Mapping[str, Any]]], asks: Sequence[Ask]) -> Iterator[CandidateItem]:
    """The candidates to some questions, from the rows of `read_lines`; questions without a candidate are left out.

    Raises:
      LinesError: missing or additional fields, a field of another type, an unknown id, or one that occurs twice.
    """
    known, seen = {ask.id: ask for ask in asks}, set[str]()
    for number, row in rows:
        if set(row) != set(CANDIDATE_FIELDS):
            fields = ", ".join(CANDIDATE_FIELDS)
            raise LinesError(f"line {number} has fields {sorted(row)}: must be {fields}; correct it")
        if row["id"] not in known or row["id"] in seen:
            fix = "answer each request once" if row["id"] in seen else "use the records, quota and seed of the requests"
            raise LinesError(f"line {number}: id is {row['id']!r}: must be that of an open request; {fix}")
        seen.add(row["id"])
        try:
            evidence = tuple(citation_of(citation) for citation in row["evidence"])
            texts = {name: str.strip(row[name]) for name in ("question", "answer", "rationale")}
        except (TypeError, KeyError, ValueError) as error:
            raise LinesError(f"line {number}: {error}; texts and a list of evidence are needed") from error
        yield CandidateItem(ask=known[row["id"]], evidence=evidence, **texts)


def rejected_rows(removed: Iterable[tuple[CandidateItem, str]]) -> Iterator[dict[str, Any]]:
    """Removed candidates with the rule that each broke, for their author."""
    for c, rule in removed:
        yield {"id": c.ask.id, "rule": rule, "question": c.question, "answer": c.answer, "rationale": c.rationale}
