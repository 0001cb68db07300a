"""The bridge from records to the bench: contacts measured by every sensor, with a fingerprint of their recordings."""

import collections
import hashlib
from collections.abc import Callable, Mapping

import numpy as np

from sensors_io.measures import Measured, MeasureError, measure
from sensors_io.records import RecordStore
from sensors_io.schema import FRAME_ARRAYS, UNKNOWN, Sequence
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
                    fingerprint=_fingerprint(recorded),
                )
            )
        after_each()
    return SplitContacts(contacts=tuple(contacts), skipped=dict(skipped))


def _fingerprint(recorded: Mapping[str, Sequence]) -> str:
    """Hash of all recorded arrays but the clock: a copy under another name has the same."""
    digest = hashlib.sha256()
    for sensor, sequence in sorted(recorded.items()):
        digest.update(sensor.encode())
        for name in FRAME_ARRAYS:
            array = getattr(sequence, name)
            if array is not None and not name.endswith("time_ns"):
                digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
