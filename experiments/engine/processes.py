"""Work in a separate process, and its progress."""

import concurrent.futures
import functools
import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from experiments.core.progress import ProgressCallback

T = TypeVar("T")


def in_own_process(work: Callable[..., T], *arguments: Any, progress: ProgressCallback | None = None) -> T:
    """The result of a function of a module, called in a fresh interpreter, whose peak memory is then the work's.

    A `progress` callback is called in this process; the function then takes one too, under that name.

    Raises:
      BrokenProcessPool: the process ended without an answer, as one that the system stops for its memory does.
    """
    fresh = multiprocessing.get_context("spawn")
    receiver, sender = fresh.Pipe(duplex=False)
    with receiver, sender, concurrent.futures.ProcessPoolExecutor(1, mp_context=fresh) as pool:
        if progress is None:
            return pool.submit(work, *arguments).result()
        future = pool.submit(work, *arguments, progress=functools.partial(_send, sender))
        future.add_done_callback(lambda _: sender.send(None))
        for done, total in iter(receiver.recv, None):
            progress(done, total)
        return future.result()


def _send(sender: Connection, done: int, total: int) -> None:
    sender.send((done, total))
