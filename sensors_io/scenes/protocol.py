"""The generated data set: which contacts there are, in which order, and the records that come of them.

Contacts follow a `schedule`, each by all four sensors in turn.  Contact i depends on (config, i) alone, so that
generation may stop and go on anywhere.  Small strain is assumed and frames beyond it are flagged; the protocol does not
keep such contacts, unless it is asked to, but touches the object elsewhere instead, and counts how often in the
contact's `trial`.
"""

import collections
import concurrent.futures
import functools
import itertools
import threading
from collections.abc import Iterator

import numpy as np

from sensors_io.scenes import schedule, strength
from sensors_io.scenes.config import SceneConfig, require
from sensors_io.scenes.draws import site_of
from sensors_io.scenes.sensors import MODELS
from sensors_io.scenes.sequence import key_of, make_sequence
from sensors_io.schema import ContactKey, Flag, Sequence

ATTEMPTS = 8
"""Sites that a contact of the protocol is tried at before one past the strain limit is kept."""

_PLANNING = threading.Lock()  # the second thread waits for the first one's plan
_WORKERS = 2
_LOOKAHEAD = 4  # contacts in flight
_PRESS_SITE = (0, 0)  # site and trial at which every object's strength is looked at


def contacts(config: SceneConfig, start: int = 0, stop: int | None = None) -> Iterator[list[Sequence]]:
    """Generate contacts in order, from contact `start` on, up to `stop` or all.

    Each item holds one sequence per sensor, in the order of `schema.SENSORS`.  Two contacts are made at a time, on two
    threads; the order and the values do not depend on it.

    Raises:
      ValueError: a start outside the data set.
    """
    require(0 <= start <= config.contact_count, "start", start, f"must lie in [0, {config.contact_count}]")
    return _in_order(config, start, config.contact_count if stop is None else stop)


def make_contact(config: SceneConfig, index: int) -> list[Sequence]:
    """Contact `index`: the same patch of the same object, touched by every sensor in turn.

    Where the protocol replaces frames past the strain limit, a contact that passes it all the same is left out and
    replaced by another site of the same object, up to `ATTEMPTS` times; the last one is kept as it is, flagged.
    """
    what = slot(config, index)
    attempts = ATTEMPTS if config.replaces else 1
    orders = np.roll(np.arange(len(MODELS)), 2 * (index % 2)).tolist()  # two threads compile different sensors
    for trial in range(attempts):
        made = {order: make_sequence(config, index, what, order, trial) for order in orders}
        if not any(np.any(s.flags & np.uint32(Flag.STRAIN_LIMIT)) for s in made.values()):
            break
    return [made[order] for order in sorted(made)]


def contact_key(config: SceneConfig, index: int) -> ContactKey:
    """Identity of contact `index`, unless it has to be replaced: it is then made with a later `trial`."""
    return key_of(slot(config, index), 0)


def plan(config: SceneConfig) -> schedule.Schedule:
    """The protocol of a config with `sequences`; it looks at every object first, a second for 100 objects."""
    with _PLANNING:
        return _plan(config)


@functools.lru_cache(maxsize=8)
def _plan(config: SceneConfig) -> schedule.Schedule:
    sites = [site_of(config, i, *_PRESS_SITE) for i in range(config.objects)]
    limits = strength.look(
        [s.skin for s in sites],
        np.array([s.turn_rad for s in sites]),
        np.array([s.solid.modulus_mpa for s in sites]),
    )
    labels = [s.solid.labels() for s in sites]
    cell = np.array([3 * label["roughness"] + label["protrusion"] for label in labels])
    return schedule.protocol(config, limits, cell)


def slot(config: SceneConfig, index: int) -> schedule.Slot:
    """Plan of contact `index`."""
    return schedule.press_slot(config, index) if config.sequences is None else plan(config).slots[index]


def _in_order(config: SceneConfig, start: int, stop: int) -> Iterator[list[Sequence]]:
    """Contacts are the unit of work, a few of them in flight."""
    indices = iter(range(start, stop))
    pending: collections.deque[concurrent.futures.Future[list[Sequence]]] = collections.deque()
    pool = concurrent.futures.ThreadPoolExecutor(_WORKERS, thread_name_prefix="scenes")

    def submit(count: int) -> None:
        pending.extend(pool.submit(make_contact, config, index) for index in itertools.islice(indices, count))

    try:
        submit(_LOOKAHEAD)
        while pending:
            done = pending.popleft().result()
            submit(1)
            yield done
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
