"""Stopping a run by a signal: at once, or, inside a training loop, after the step is done and saved."""

import contextlib
import os
import signal
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from types import FrameType

from sensors_io.signals import ENDING, hidden_in, loads_extension

SIGNALS = (signal.SIGINT, *ENDING)
"""Control-C, the signal that a scheduler sends before it takes the machine away, and that of a closed terminal."""

PATIENCE = b"\nstopping once this step is done and saved; a second signal ends at once, unsaved\n"
"""Written to standard error where a stop has to wait; a step that compiles takes minutes."""

STDERR = 2  # its descriptor; a replacement of `sys.stderr`, as in a notebook, may have none
AGAIN_S = 0.02  # interval of the checks whether the raised `Stopped` still propagates


class Stopped(BaseException):
    """A signal asked the run to stop; no `except Exception` may swallow it."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class Stopping:
    """The first of `SIGNALS` raises `Stopped`, at once or when a patient block ends; a second one ends the process.

    A signal may arrive within a callback of the garbage collector, of which JAX has one, or within a `__del__`.  Python
    only reports exceptions that are raised there; `Stopped` is then raised again a moment later.
    """

    def __init__(self) -> None:
        self._number: int | None = None
        self._patient, self._lock = 0, threading.Lock()  # open patient blocks, of all threads
        self._leaving = False
        self._raised: weakref.ref[Stopped] | None = None

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Handle the signals inside the block; only a process's main thread can."""
        heard = [n for n in SIGNALS if n != signal.SIGHUP or signal.getsignal(n) is not signal.SIG_IGN]  # as by nohup
        before = {n: signal.signal(n, self._handle) for n in heard}
        before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._again)
        report = sys.unraisablehook
        sys.unraisablehook = lambda lost: None if isinstance(lost.exc_value, Stopped) else report(lost)
        try:
            yield
        except ImportError as error:  # of an extension that was loading when the signal came
            if (stopped := hidden_in(error, Stopped)) is None:
                raise
            raise stopped from None
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            sys.unraisablehook = report
            for n, handler in before.items():
                signal.signal(n, handler)

    @contextlib.contextmanager
    def patient(self, agreed: Callable[[bool], bool] = bool) -> Iterator[Callable[[], bool]]:
        """Delay the stop: the block polls the function that it gets, and leaves when that returns True.

        Blocks of several threads may be open at a time; the main thread's must be the first and the last of them.

        Args:
          agreed: from "a signal came to this process" to "one came to any process of the run"; all processes call it
            equally often, so that all leave after the same step.

        Raises:
          Stopped: when the block ends, if a signal came to any process, or `leave` was called.
        """
        stop = False

        def poll() -> bool:
            nonlocal stop
            stop = stop or agreed(self._number is not None or self._leaving)
            return stop

        self._open(1)
        try:
            yield poll
            poll()  # one that came after the last step
        finally:
            self._open(-1)
        if stop or self._number is not None:
            raise self._stopped(self._number or signal.SIGTERM)

    def leave(self, leaving: bool = True) -> None:
        """Have all patient blocks end as if a signal had come, because another thread failed; or no longer."""
        self._leaving = leaving

    def _open(self, blocks: int) -> None:
        with self._lock:
            self._patient += blocks

    def _handle(self, number: int, frame: FrameType | None) -> None:
        for n in SIGNALS:
            if signal.getsignal(n) is not signal.SIG_IGN:
                signal.signal(n, signal.SIG_DFL)
        self._number = number
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S, AGAIN_S)
        if not self._patient:
            if loads_extension(frame):  # some abort at an exception; the signal comes again
                return
            raise self._stopped(number)
        with contextlib.suppress(OSError):  # nobody may be reading
            os.write(STDERR, PATIENCE)  # a print could strike within another

    def _again(self, number: int, frame: FrameType | None) -> None:
        """Raise another `Stopped` if the last one is gone; while it propagates, it is alive."""
        del number
        alive = self._raised is not None and self._raised() is not None
        if self._number is not None and not self._patient and not alive and not loads_extension(frame):
            raise self._stopped(self._number)

    def _stopped(self, number: int) -> Stopped:
        stopped = Stopped(number)
        self._raised = weakref.ref(stopped)
        return stopped
