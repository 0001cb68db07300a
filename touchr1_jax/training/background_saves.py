"""Saves of Orbax in the background: errors that they log, and the end of one for which several processes wait."""

import concurrent.futures
import logging
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

FAILURES = (OSError, ValueError, KeyError, TypeError, RuntimeError, AssertionError, AttributeError, IndexError)
"""What Orbax and TensorStore raise where bytes cannot be read or written: they name no class of their own."""

LOOK_S = 0.2

_FAILED: list[tuple[str, Exception]] = []
"""What Orbax logged of each save that failed, and the error."""


def _not_of_a_failed_save(record: logging.LogRecord) -> bool:
    """False of what a save logs of its failure, which it raises in one line, and of a score that it lacks at a stop."""
    quiet = record.levelno < logging.ERROR and "tracked_metric" not in str(record.msg)
    if quiet or "/orbax/" not in record.pathname:
        return True
    error = record.exc_info and record.exc_info[1]
    if isinstance(error, FAILURES) and jax.process_count() > 1:  # kept, it holds the arrays of its traceback
        _FAILED.append((record.getMessage(), error))
    return False


def without_closed_loops(report: Callable[[Any], object]) -> Callable[[Any], object]:
    """A `sys.unraisablehook` that omits TensorStore's threads, which find the event loop of a failed save closed."""

    def hook(lost: Any) -> None:
        if not (lost.object is None and repr(lost.exc_value) == "RuntimeError('Event loop is closed')"):
            report(lost)

    return hook


logging.getLogger("absl").addFilter(_not_of_a_failed_save)
sys.unraisablehook = without_closed_loops(sys.unraisablehook)


def failed_save(directory: Path) -> Exception | None:
    """The error of a save into a directory that failed in this process."""
    return next((error for text, error in _FAILED if f"{directory}/" in text), None)


def wait_for_save(manager: ocp.CheckpointManager, directory: Path) -> None:
    """Wait for the save in the background, and raise its error.

    Where a save fails in one process of several, Orbax waits there for the others, which wait for it.  Then this raises
    at once, nothing may wait for the manager any more, and the process must end.
    """
    if jax.process_count() == 1:
        manager.wait_until_finished()
        return
    finished = concurrent.futures.Future[None]()

    def wait() -> None:
        try:
            finished.set_result(manager.wait_until_finished())
        except BaseException as error:
            finished.set_exception(error)

    threading.Thread(target=wait, daemon=True).start()
    while not finished.done():
        if error := failed_save(directory):
            raise error
        concurrent.futures.wait([finished], LOOK_S)
    finished.result()
