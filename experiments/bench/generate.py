"""From records to items: draw the questions, word them, sift them, hold them to the data card."""

import dataclasses
from collections.abc import Callable

from experiments.bench.contacts import ContactError, SplitContacts, measure_split
from experiments.bench.draw import Quota, draw
from experiments.bench.rationales import compose_item
from experiments.bench.rules import CandidateItem, FilteredItems, apply_rules
from experiments.bench.thresholds import ThresholdReader, fit_thresholds
from experiments.bench.wording import answer_words, slots_of, understand
from sensors_io.records import RecordStore
from touchr1_jax.bench.items import Ask, Item


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchSource:
    """What questions are made from: the contacts to ask about, those that tell how to read numbers, the sensors."""

    bench: SplitContacts
    train: SplitContacts
    readings: ThresholdReader
    sensors: tuple[str, ...]


def read_source(store: RecordStore, split: str = "test", tell: Callable[[], None] = lambda: None) -> BenchSource:
    """Measure the contacts of the bench's split and of the training split.

    Args:
      store: the records.
      split: the bench's; its objects are in no other.
      tell: called after every contact.

    Raises:
      FactsError: no labelled contact to ask about, or too few training contacts to read numbers by.
    """
    bench, train = measure_split(store, split, tell), measure_split(store, "train", tell)
    if not bench.objects():
        raise ContactError(f"split is {split!r}: holds no labelled contact that measured something; choose another")
    return BenchSource(bench=bench, train=train, readings=fit_thresholds(train.contacts), sensors=store.meta.sensors)


def ask_about(source: BenchSource, quota: Quota, seed: int) -> tuple[Ask, ...]:
    """The questions of a seed, drawn anew from the records, so that no file can change what is right."""
    return draw(source.bench.contacts, source.sensors, quota, seed)


def generate(source: BenchSource, quota: Quota, seed: int) -> FilteredItems:
    """Items worded by rule; the same records, quota and seed give the same bytes."""
    contacts = source.bench.by_touch()
    items = [compose_item(ask, contacts, source.readings) for ask in ask_about(source, quota, seed)]
    return apply_rules([_candidate(item) for item in items], contacts)


def share_at_odds(items: tuple[Item, ...]) -> float:
    """Share of the items in which the sensors' numbers together do not say the answer; they stay in the bench.

    To remove them would leave only what a threshold on one number can answer.
    """
    odd = 0
    for item in items:
        reading, _ = understand(item.ask, item.rationale)
        odd += tuple(reading.compare[slot] for slot in slots_of(item.ask)) != item.ask.answer
    return odd / len(items)


def _candidate(item: Item) -> CandidateItem:
    return CandidateItem(
        ask=item.ask,
        question=item.question,
        answer=answer_words(item.ask),
        rationale=item.rationale,
        evidence=item.evidence,
    )
