"""`python -m experiments`: run, continue, list, start and compare experiments."""

import multiprocessing
import os
import sys

from experiments.running.runner import main

SIGNALLED = 128
"""Exit statuses above it are those of a run that a signal stopped."""


def leave(status: int) -> None:
    """End the process; after a signal at once, without tearing JAX down.

    A signal may strike while XLA compiles on a thread of its own: the wait for it is broken off, the compiling is not,
    and would go on in a client that the interpreter frees at its end (a segmentation fault, or "free(): invalid
    pointer").  The run has closed its files by then.
    """
    if status > SIGNALLED:
        for child in multiprocessing.active_children():
            child.terminate()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


if __name__ == "__main__":
    leave(main())
