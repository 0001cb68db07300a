"""Work in a process of its own, and word of how far it is."""

import concurrent.futures
import functools
import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from experiments.core.progress import ProgressCallback

T = TypeVar("T")


def in_own_process(work: Callable[..., T], *arguments: Any, tell: ProgressCallback | None = None) -> T:
    """The result of a function of a module, called in a fresh interpreter, whose peak memory is then the work's.

    Args:
      work: the function; where somebody listens it takes a `tell` of its own.
      arguments: all of its others.
      tell: called in this process with what the work tells in that one.

    Raises:
      BrokenProcessPool: the process ended without an answer, as one that the system stops for its memory does.
    """
    fresh = multiprocessing.get_context("spawn")
    hears, says = fresh.Pipe(duplex=False)
    with hears, says, concurrent.futures.ProcessPoolExecutor(1, mp_context=fresh) as pool:
        if tell is None:
            return pool.submit(work, *arguments).result()
        future = pool.submit(work, *arguments, tell=functools.partial(_say, says))
        future.add_done_callback(lambda _: says.send(None))
        for done, total in iter(hears.recv, None):
            tell(done, total)
        return future.result()


def _say(says: Connection, done: int, total: int) -> None:
    says.send((done, total))
