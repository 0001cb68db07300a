"""Independent parts of a run, such as its seeds, computed at the same time where one alone leaves cores idle."""

import concurrent.futures
import math
import resource
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import jax

from experiments.core import numerics
from experiments.core.context import Context
from experiments.core.memory import free_bytes
from touchr1_jax.distributed.processes import GIB

ONE_SEED_BYTES, SEED_BYTES = 4 * GIB, round(1.4 * GIB)
"""Memory of the first seed of a default study with its clips, and of each further one: arrays, and a compilation that
may run at the same time as another.  Measured: 2.8 and 4.3 GiB with one seed and two."""

THREADS = 2  # of `in_threads`

Item = TypeVar("Item")
T = TypeVar("T")


def concurrently(
    context: Context, title: str, items: Sequence[Item], work: Callable[[Item], T], *, at_once: int | None = None
) -> list[T]:
    """The results of independent work on each item, in the order of the items, under a progress bar.

    The steps of small policies use a part of the cores: two seeds on two cores train 1.6 times as fast at the same time
    as one after the other.  Results and log are the same to the bit.  A signal ends each item's work after its step.

    Args:
      context: the run.
      title: of the bar.
      items: of the work.
      work: reads and writes only what no other item does, besides the run and the cache.
      at_once: number of items at the same time, each in a thread; by default `idle_cores`.

    Raises:
      Exception: the first of an item, once the others have ended after the step at hand.
    """
    threads = min(idle_cores(context) if at_once is None else at_once, len(items))
    if threads <= 1:
        found = [work(item) for item in context.each(title, items)]
        context.sort_log()
        return found
    context.in_threads = True
    try:
        with (
            context.stopping.patient(),
            context.progress(title, len(items)) as advance,
            concurrent.futures.ThreadPoolExecutor(threads) as pool,
        ):
            futures = [pool.submit(work, item) for item in items]
            try:
                for future in concurrent.futures.as_completed(futures):
                    future.result()
                    advance()
            except BaseException:
                context.stopping.leave()
                pool.shutdown(cancel_futures=True)
                raise
    finally:
        context.in_threads = False
        context.stopping.leave(False)
    context.sort_log()
    return [future.result() for future in futures]


def in_threads(work: Callable[[Item], T], items: Iterable[Item], advance: Callable[[], object]) -> list[T]:
    """Results of all items, in their order; `advance` is called in this thread after each."""
    pool = concurrent.futures.ThreadPoolExecutor(THREADS)
    try:
        results = []
        for result in pool.map(work, items):
            results.append(result)
            advance()
        return results
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def idle_cores(context: Context) -> int:
    """Cores that may compute an item each: all of a machine without an accelerator, one where devices are shared.

    Not more than there is memory for.
    """
    alone = context.processes.count == 1 and math.prod(context.devices.shape) == 1
    if not alone or jax.default_backend() != "cpu":
        return 1
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    room = free_bytes() if limit == resource.RLIM_INFINITY else min(free_bytes(), limit)
    return min(numerics.cores(), 1 + max(0, room - ONE_SEED_BYTES) // SEED_BYTES)
