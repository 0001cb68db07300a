"""Independent jobs on the two cores of a laptop, in order, given up at once when the run is stopped."""

import concurrent.futures
from collections.abc import Callable, Iterable
from typing import TypeVar

WORKERS = 2

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(work: Callable[[Item], Result], items: Iterable[Item], advance: Callable[[], object]) -> list[Result]:
    """Results of all items, in their order; `advance` is called in this thread after each."""
    pool = concurrent.futures.ThreadPoolExecutor(WORKERS)
    try:
        results = []
        for result in pool.map(work, items):
            results.append(result)
            advance()
        return results
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
