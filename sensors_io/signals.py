"""The signals that end a program: what it has begun is closed or removed, as after Ctrl-C."""

import contextlib
import os
import signal
import sys
from importlib.machinery import ExtensionFileLoader
from types import FrameType, TracebackType
from typing import TypeVar

E = TypeVar("E", bound=BaseException)

ENDING = (signal.SIGTERM, signal.SIGHUP)
"""The signal of a scheduler, and that of a terminal or a connection that was closed."""

AGAIN_S = 0.02  # until a signal that was lost comes again

_LOADING = {method.__code__ for method in (ExtensionFileLoader.create_module, ExtensionFileLoader.exec_module)}


class Ended(KeyboardInterrupt):
    """One of `ENDING` came; all that handles Ctrl-C handles it."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def end_as_interrupted() -> None:
    """Raise `Ended` at the first of `ENDING`, and KeyboardInterrupt at Ctrl-C; a signal that is ignored stays so.

    What is raised within a callback of the garbage collector, such as JAX's, Python only reports: it comes again.
    While an extension loads nothing is raised: some make an `ImportError` of it, and others abort.  The signal comes
    again; where an `ImportError` of one is caught nowhere, the program ends as by the signal.
    """
    for number in (signal.SIGINT, *ENDING):
        if signal.getsignal(number) is (signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL):
            signal.signal(number, _raise)
    report = sys.unraisablehook
    sys.unraisablehook = lambda lost: (
        _again(lost.exc_value) if isinstance(lost.exc_value, KeyboardInterrupt) else report(lost)
    )
    show = sys.excepthook

    def leave(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if (cause := hidden_in(error, KeyboardInterrupt)) is None:
            show(kind, error, trace)
        else:
            status = leave_interrupted(cause, "interrupted: run the same command again")
            with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, full, or gone
                sys.stdout.flush()
            os._exit(status)

    sys.excepthook = leave


def hidden_in(error: BaseException, kind: type[E]) -> E | None:
    """The exception of one kind that this is, or that an import turned into this `ImportError`."""
    cause: BaseException | None = error
    while isinstance(cause, ImportError):
        cause = cause.__cause__ or cause.__context__
    return cause if isinstance(cause, kind) else None


def leave_interrupted(error: KeyboardInterrupt, message: str) -> int:
    """Print a message, let another signal end the process at once, and return the exit status."""
    for number in (signal.SIGINT, *ENDING):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    say(message)
    return exit_status(error)


def exit_status(error: KeyboardInterrupt) -> int:
    """128 + the number of the signal, as shells have it."""
    return 128 + (error.number if isinstance(error, Ended) else signal.SIGINT)


def say(text: str) -> None:
    """Print to standard error, if there is one; nothing is imported for it."""
    try:
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
    except (OSError, ValueError, AttributeError):  # closed, full, or a terminal that is gone
        return


def loads_extension(frame: FrameType | None) -> bool:
    """True while an extension loads in this frame or around it."""
    while frame is not None and frame.f_code not in _LOADING:
        frame = frame.f_back
    return frame is not None


def _raise(number: int, frame: FrameType | None) -> None:
    if loads_extension(frame):
        _send_later(number)
        return
    raise KeyboardInterrupt if number == signal.SIGINT else Ended(number)


def _again(error: KeyboardInterrupt) -> None:
    _send_later(exit_status(error) - 128)


def _send_later(number: int) -> None:
    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(number))
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
