"""The bridge from records to the bench: contacts measured by every sensor, with a fingerprint of their recordings."""

import collections
from collections.abc import Callable

from sensors_io.measures import Measured, MeasureError, measure
from sensors_io.quality import recorded_digest
from sensors_io.records import RecordStore
from sensors_io.schema import UNKNOWN
from touchr1_jax.bench.items import Touch
from touchr1_jax.bench.questions.contacts import ContactError, MeasuredContact, SplitContacts
from touchr1_jax.bench.questions.generate import BenchSource
from touchr1_jax.bench.questions.thresholds import fit_thresholds


def read_source(store: RecordStore, after_each: Callable[[], None] = lambda: None) -> BenchSource:
    """Measure the contacts of the test and of the training split; `after_each` is called after every contact.

    `ContactError` without a labelled test contact, or with too few training contacts to fit thresholds on.
    """
    bench, train = measure_split(store, "test", after_each), measure_split(store, "train", after_each)
    if not bench.objects():
        raise ContactError("split is 'test': must hold labelled contacts that could be measured; use other records")
    return BenchSource(bench=bench, train=train, reader=fit_thresholds(train.contacts), sensors=store.meta.sensors)


def measure_split(store: RecordStore, split: str, after_each: Callable[[], None] = lambda: None) -> SplitContacts:
    """Read and measure all contacts of a split, those of unlabelled objects included; `after_each` is for a bar."""
    contacts, skipped = [], collections.Counter[str]()
    for i in store.contacts_of_split(split):
        key, recorded, measured = store.contacts[i], store.contact(int(i)), dict[str, Measured]()
        for sensor, sequence in recorded.items():
            try:
                measured[sensor] = measure(sequence)
            except MeasureError as error:
                skipped[f"{sensor}: {error}"] += 1
        if measured:
            card = store.objects[key.object_id]
            contacts.append(
                MeasuredContact(
                    touch=Touch(object=key.object_id, site=key.site, motion=key.motion, trial=key.trial),
                    labels={name: level for name, level in card.labels.items() if level != UNKNOWN},
                    deceptive=card.visual_lies,
                    measured=measured,
                    fingerprint=" ".join(recorded_digest(recorded[sensor]) for sensor in sorted(recorded)),
                )
            )
        after_each()
    return SplitContacts(contacts=tuple(contacts), skipped=dict(skipped))
