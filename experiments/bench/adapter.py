"""Any other author of questions, by files: requests go out, candidates come in, the rules sift them.

Both files are JSON Lines.  A request holds everything that its author may know,

    id, kind, attributes, sensors, task, answer, choices, touches: [{object, site, motion, trial, measured: {sensor:
    {quantities: {name: {value, unit}}, at, box}}}]

and a candidate has `id`, `question`, `answer`, `rationale` and `evidence`, as in `touchr1_jax.bench.items`.
Answers are told to the author and drawn anew when candidates come back, so that no file can change what is right.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from experiments.bench.contacts import MeasuredContact
from experiments.bench.rules import CandidateItem
from experiments.bench.wording import answer_words, choices
from sensors_io.measures import UNITS, Measured
from touchr1_jax.bench.items import KINDS, Ask, Touch, citation_of
from touchr1_jax.bench.json_lines import LinesError

TASK = (
    "Write one question about what the sensors felt, and its rationale. The rationale has three segments, "
    "<perceive> … </perceive> <compare> … </compare> <conclude> … </conclude>: what each named sensor measured and "
    "what it suggests, what all of them say together, the answer in exactly the given words. Ground it in the measured "
    "quantities, with numbers and units, and list each that you use as evidence with its touch, sensor, quantity, "
    "value, unit and place. Use no number that is not given, and do not give the answer away in the question."
)
"""What the author of a candidate is told."""

FIELDS = ("id", "question", "answer", "rationale", "evidence")
"""Of a candidate."""


def requests(asks: Iterable[Ask], contacts: Mapping[Touch, MeasuredContact]) -> Iterator[dict[str, Any]]:
    """One request per question."""
    for ask in asks:
        yield {
            "id": ask.id,
            "kind": ask.kind,
            "meaning": KINDS[ask.kind].meaning,
            "attributes": list(ask.attributes),
            "sensors": list(ask.sensors),
            "task": TASK,
            "answer": answer_words(ask),
            "choices": choices(ask),
            "touches": [_touch(contacts[touch], ask.sensors) for touch in ask.touches],
        }


def candidates(rows: Iterable[tuple[int, Mapping[str, Any]]], asks: Sequence[Ask]) -> Iterator[CandidateItem]:
    """What came back, in its order; questions without a candidate are simply missing.

    Args:
      rows: line numbers and objects, as `read_lines` gives them.
      asks: the questions that were sent.

    Raises:
      LinesError: a field that is missing, too many or of another type, an unknown id, or one that occurs twice.
    """
    known, seen = {ask.id: ask for ask in asks}, set[str]()
    for number, tree in rows:
        if set(tree) != set(FIELDS):
            raise LinesError(f"line {number} has fields {sorted(tree)}: must be {', '.join(FIELDS)}; correct it")
        if tree["id"] not in known or tree["id"] in seen:
            fix = (
                "answer each request once" if tree["id"] in seen else "use the records, quota and seed of the requests"
            )
            raise LinesError(f"line {number}: id is {tree['id']!r}: must be that of an open request; {fix}")
        seen.add(tree["id"])
        try:
            evidence = tuple(citation_of(citation) for citation in tree["evidence"])
            question, answer, rationale = (str.strip(tree[name]) for name in ("question", "answer", "rationale"))
        except (TypeError, KeyError, ValueError) as error:
            raise LinesError(f"line {number}: {error}; texts and a list of evidence are needed") from error
        yield CandidateItem(
            ask=known[tree["id"]], question=question, answer=answer, rationale=rationale, evidence=evidence
        )


def rejected(removed: Iterable[tuple[CandidateItem, str]]) -> Iterator[dict[str, Any]]:
    """Candidates that broke a rule, with the rule, for their author."""
    for candidate, rule in removed:
        yield {
            "id": candidate.ask.id,
            "rule": rule,
            "question": candidate.question,
            "answer": candidate.answer,
            "rationale": candidate.rationale,
        }


def _touch(contact: MeasuredContact, sensors: Sequence[str]) -> dict[str, Any]:
    touch = contact.touch
    measured = {sensor: _measured(contact.measured[sensor]) for sensor in sensors}
    return {
        "object": touch.object,
        "site": touch.site,
        "motion": touch.motion,
        "trial": touch.trial,
        "measured": measured,
    }


def _measured(measured: Measured) -> dict[str, Any]:
    quantities = {
        name: {"value": float(f"{value:.4g}"), "unit": UNITS[name]} for name, value in measured.quantities.items()
    }
    return {"quantities": quantities, "at": list(measured.at), "box": list(measured.box)}
